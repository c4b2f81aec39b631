"""Whether work in a thread goes on: it says so at every step, however long the whole may take."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")
_OF_THREAD = threading.local()


class StalledError(Exception):
    """Nothing was heard of a call for longer than it may take for a step."""


class _Pulse:
    """When a call was last heard of [s]."""

    def __init__(self) -> None:
        self.last_s = time.monotonic()


def beat() -> None:
    """Say that a step is done, to whoever watches this thread."""
    pulse: _Pulse | None = getattr(_OF_THREAD, "pulse", None)
    if pulse is not None:
        pulse.last_s = time.monotonic()


def watched(call: Callable[[], Result], *, limit_s: float) -> Result:
    """What ``call`` returns or raises, in a thread of its own, while it goes on.

    A call that stalls is left behind in its thread, which does not keep the process alive: Python
    cannot end it.

    Raises:
        StalledError: There was no :func:`beat` for ``limit_s``.
    """
    pulse = _Pulse()
    results: list[Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        _OF_THREAD.pulse = pulse
        try:
            results.append(call())
        except BaseException as error:  # handed on to the caller
            errors.append(error)

    thread = threading.Thread(target=work, name="pemviz-batch", daemon=True)
    thread.start()
    while thread.is_alive():
        left_s = pulse.last_s + limit_s - time.monotonic()
        if left_s <= 0.0:
            raise StalledError
        thread.join(left_s)
    if errors:
        raise errors[0]
    return results[0]
