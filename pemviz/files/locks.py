"""A lock that two processes cannot hold at once; one that dies gives it back."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pemviz.errors import InputError


@contextmanager
def held(path: Path, *, busy: str, unusable: str) -> Generator[None, None, None]:
    """Hold the lock file ``path``, or fail at once.

    Args:
        path: Made if it is not there; it stays.
        busy: What to say if another process holds it.
        unusable: What to say if it cannot be made; the reason follows.

    Raises:
        InputError: It cannot be held.
    """
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(busy) from error
    except OSError as error:
        message = f"{unusable} ({error.strerror or error})"
        raise InputError(message) from error
    try:
        yield
    finally:
        lock.release()
