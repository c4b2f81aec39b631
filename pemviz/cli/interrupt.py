"""Ctrl-C and SIGTERM stop a run between batches, so that nothing finished is lost."""

import contextlib
import signal
import threading
from collections.abc import Callable, Generator
from types import FrameType


@contextlib.contextmanager
def stop_on_signals() -> Generator[Callable[[], bool], None, None]:
    """Yield a function that tells whether a signal asked to stop.

    Raises:
        KeyboardInterrupt: A second signal came.
    """
    requested = threading.Event()

    def request(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        if requested.is_set():
            raise KeyboardInterrupt
        requested.set()

    if threading.current_thread() is not threading.main_thread():
        yield requested.is_set
        return
    previous = {number: signal.signal(number, request) for number in _numbers()}
    try:
        yield requested.is_set
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _numbers() -> tuple[signal.Signals, ...]:
    return (signal.SIGINT, signal.SIGTERM)
