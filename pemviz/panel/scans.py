"""Looks at all rollouts of a run, in parts, beside what a person does meanwhile."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar, cast

Value = TypeVar("Value")
Report = Callable[[int], None]
"""Told after each part of how many rollouts have been looked at."""
Scan = Callable[[Report], Value]

PART_ROWS = 4096
"""Rollouts looked at in one go: some tens of megabytes."""
AT_ONCE = 20_000
"""As many rollouts are looked at before a person notices."""


@dataclass(frozen=True)
class Progress:
    """How far a scan is: ``done`` of ``count`` rollouts."""

    done: int
    count: int


def row_parts(count: int) -> Iterator[slice]:
    """Rows ``0`` to ``count`` in parts of :data:`PART_ROWS`."""
    for first in range(0, count, PART_ROWS):
        yield slice(first, min(first + PART_ROWS, count))


class Scans:
    """Results of scans by key, each computed once; one scan runs at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._turn = threading.Lock()
        self._results: dict[object, Future[Any]] = {}
        self._done: dict[object, int] = {}

    def value(self, key: object, scan: Scan[Value]) -> Value:
        """The scan's result, waited for; what it raised is raised again."""
        begun, mine = self._begun(key)
        if mine:
            self._carry_out(key, begun, scan)
        return cast(Value, begun.result())

    def begin(self, key: object, scan: Scan[Any], *, count: int) -> Progress | None:
        """Have the scan done on a thread of its own; ``None`` once it is, or has failed.

        A run of at most :data:`AT_ONCE` rollouts is left to :meth:`value`.
        """
        if count <= AT_ONCE:
            return None
        begun, mine = self._begun(key)
        if mine:
            threading.Thread(
                target=self._carry_out, args=(key, begun, scan), name="pemviz-scan", daemon=True
            ).start()
        return None if begun.done() else Progress(self._done.get(key, 0), count)

    def known(self, key: object) -> bool:
        """Whether a scan has come to its end."""
        with self._lock:
            found = self._results.get(key)
        return found is not None and found.done()

    def _begun(self, key: object) -> tuple[Future[Any], bool]:
        """The scan's result to come, and whether it is the caller who carries it out."""
        with self._lock:
            found = self._results.get(key)
            if found is not None:
                return found, False
            self._results[key] = made = Future[Any]()
            return made, True

    def _carry_out(self, key: object, result: Future[Any], scan: Scan[Any]) -> None:
        def report(done: int) -> None:
            self._done[key] = done

        try:
            with self._turn:
                result.set_result(scan(report))
        except BaseException as error:
            result.set_exception(error)
