"""Files that a user names: opening text, and saying what could not be written."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pemviz.pem.errors import PemError


@contextmanager
def open_text(path: Path) -> Generator[TextIO, None, None]:
    """A file's text, what is not UTF-8 replaced; line ends are left to who reads.

    Raises:
        PemError: it is not there, or cannot be read.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            yield stream
    except OSError as error:
        raise PemError(f"{path}: cannot be read ({error.strerror or error})") from None


@contextmanager
def writing(path: Path) -> Generator[None, None, None]:
    """What is written to ``path``, or below it.

    Raises:
        PemError: it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise PemError(f"out = {path}: cannot be written ({error.strerror or error})") from None
