"""Viewers of recordings that are kept open while the panel serves."""

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

Viewer = Callable[[Path], AbstractContextManager[str]]


class Viewers:
    """Opens a viewer for a recording once, and closes the oldest when there are too many."""

    def __init__(self, viewer: Viewer, *, limit: int = 4) -> None:
        """Nothing is opened yet.

        Args:
            viewer: Serves a recording until left; gives the page's address.
            limit: How many viewers may be open.
        """
        self._viewer = viewer
        self._limit = limit
        self._lock = threading.Lock()
        self._open: dict[Path, tuple[str, ExitStack]] = {}

    def open(self, path: Path) -> str:
        """The address of a page that shows the recording."""
        with self._lock:
            if path not in self._open:
                stack = ExitStack()
                address = stack.enter_context(self._viewer(path))
                self._open[path] = (address, stack)
                while len(self._open) > self._limit:
                    self._open.pop(next(iter(self._open)))[1].close()
            return self._open[path][0]

    def close(self) -> None:
        """Close all viewers."""
        with self._lock:
            for _, stack in self._open.values():
                stack.close()
            self._open.clear()
