"""Runs on a few processes of this machine."""

import multiprocessing
import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import Self

from pemviz.errors import RunError
from pemviz.processes import ALL_STOPS, end_with_parent, one_thread_each, signals_held_back
from pemviz.sweep.runs import RunOutcome, RunTask, carry_out

DIED = "its worker process died: killed, or the machine is out of memory"
SCRATCH_PREFIX = "pemviz-sweep-"


@dataclass
class _Slot:
    """One process, so that it is known whose death failed which run."""

    pool: ProcessPoolExecutor
    processes: list[BaseProcess] = field(default_factory=list[BaseProcess])


class LocalWorkers:
    """Processes that are started when they are first needed, and anew if they die."""

    def __init__(self, count: int) -> None:
        """Plan for ``count`` processes; none is started yet."""
        self._count = count
        self._idle: list[_Slot] = []
        self._busy: dict[Future[RunOutcome], tuple[_Slot, RunTask]] = {}
        self._scratch: Path | None = None

    def __enter__(self) -> Self:
        """Make a folder for what the runs need while they last."""
        try:
            self._scratch = Path(tempfile.mkdtemp(prefix=SCRATCH_PREFIX))
        except OSError as error:
            message = f"no temporary folder can be made ({error.strerror or error})"
            raise RunError(message) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Kill the processes and remove the folder."""
        slots = [*self._idle, *(slot for slot, _ in self._busy.values())]
        for slot in slots:
            _end(slot)
        self._idle, self._busy = [], {}
        if self._scratch is not None:
            shutil.rmtree(self._scratch, ignore_errors=True)

    @property
    def capacity(self) -> int:
        """One run a process."""
        return self._count

    def submit(self, task: RunTask) -> None:
        """Give the run to a process that has none."""
        slot = self._idle.pop() if self._idle else self._new_slot()
        before = set(multiprocessing.active_children())
        # a process that stops at the terminal's signals would look like one that died
        with one_thread_each(), signals_held_back(ALL_STOPS):
            future = slot.pool.submit(carry_out, task, scratch=self._scratch)
        slot.processes += set(multiprocessing.active_children()) - before
        self._busy[future] = (slot, task)

    def finished(self, *, timeout_s: float) -> Sequence[RunOutcome]:
        """The outcomes since the last call, waiting for one if need be."""
        done, _ = wait(self._busy, timeout=timeout_s, return_when=FIRST_COMPLETED)
        return [self._outcome(future) for future in done]

    def _outcome(self, future: Future[RunOutcome]) -> RunOutcome:
        slot, task = self._busy.pop(future)
        try:
            outcome = future.result()
        except BrokenProcessPool:
            _end(slot)
            return RunOutcome(task.name, message=DIED)
        self._idle.append(slot)
        return outcome

    def _new_slot(self) -> _Slot:
        pool = ProcessPoolExecutor(
            1,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=end_with_parent,
            initargs=(self._scratch,),
        )
        return _Slot(pool)


def _end(slot: _Slot) -> None:
    for process in slot.processes:
        process.kill()
    slot.pool.shutdown(wait=True, cancel_futures=True)
