"""Whether work in a thread goes on: it says so at every step, however long the whole may take."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")
POLL_S = 0.2
SILENT_S = 60.0
"""Without a step, after which that is told."""
GRACE_S = 2.0
"""For the step at hand, once nobody waits for the call any more."""
_OF_THREAD = threading.local()


class StalledError(Exception):
    """Nothing was heard of a call for longer than it may take for a step."""


class _UnwantedError(BaseException):
    """Ends a call that nobody waits for any more, at its next step."""


class _Pulse:
    """When a call was last heard of [s], and whether somebody waits for it."""

    def __init__(self) -> None:
        self.last_s = time.monotonic()
        self.is_wanted = True


def beat() -> None:
    """Say that a step is done, to whoever watches this thread.

    Raises:
        _UnwantedError: Nobody does any more: the call is to end.
    """
    pulse: _Pulse | None = getattr(_OF_THREAD, "pulse", None)
    if pulse is None:
        return
    pulse.last_s = time.monotonic()
    if not pulse.is_wanted:
        raise _UnwantedError


def watched(
    call: Callable[[], Result],
    *,
    limit_s: float,
    pause: Callable[[], None] = lambda: None,
    on_silence: Callable[[], None] = lambda: None,
) -> Result:
    """What ``call`` returns or raises, in a thread of its own, while it goes on.

    A call that stalls is left behind in its thread, which does not keep the process alive: Python
    cannot end it.

    Args:
        call: Says at every step that it goes on, by :func:`beat`.
        limit_s: It may be silent for so long [s].
        pause: Called several times a second; what it raises ends the call at its next step.
        on_silence: Called once if it is silent for :data:`SILENT_S`.

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
    told = False
    while thread.is_alive():
        silent_s = time.monotonic() - pulse.last_s
        if silent_s >= limit_s:
            raise StalledError
        if silent_s >= SILENT_S and not told:
            on_silence()
            told = True
        try:
            pause()
            thread.join(min(POLL_S, limit_s - silent_s))
        except BaseException:
            pulse.is_wanted = False
            thread.join(GRACE_S)
            raise
    if errors:
        raise errors[0]
    return results[0]
