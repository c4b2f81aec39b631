"""Files that are either whole or not there, that one process holds, that a digest identifies."""

import hashlib
import json
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from filelock import FileLock, Timeout

from pemviz.errors import InputError


def is_file(path: Path) -> bool:
    """Whether ``path`` is a file; a name that no file can have is none."""
    return os.path.isfile(path)


def is_folder(path: Path) -> bool:
    """Whether ``path`` is a folder; a name that no folder can have is none."""
    return os.path.isdir(path)


def write_atomically(
    path: Path, write: Callable[[BinaryIO], None], *, durable: bool = True
) -> None:
    """Let ``write`` fill a neighbouring file, then rename it to ``path``.

    A kill at any moment leaves the old file, or the new one, never a part of it.

    Args:
        path: The file.
        write: Fills it.
        durable: Wait until the disk has it, so that the same holds if the machine loses power. Not
            worth its time for what is soon to be written anew.

    Raises:
        OSError: The folder is read-only, the disk is full.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("w+b") as stream:
            write(stream)
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, content: bytes, *, durable: bool = True) -> None:
    """Write ``content`` atomically; ``durable`` as :func:`write_atomically` has it."""

    def write(stream: BinaryIO) -> None:
        stream.write(content)

    write_atomically(path, write, durable=durable)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode("utf-8"))


def check_place(name: str, path: Path) -> None:
    """Refuse an option's ``path`` that no file can be written to.

    Raises:
        InputError: It is a folder, or lies in none.
    """
    if is_folder(path):
        message = f"{name} = {path}: must be a file, is a folder"
        raise InputError(message)
    if not is_folder(path.parent):
        message = f"{name} = {path}: must lie in a folder that exists"
        raise InputError(message)


def write_named(name: str, path: Path, text: str) -> None:
    """Write UTF-8 text atomically to an option's ``path``.

    Raises:
        InputError: It cannot be written.
    """
    try:
        write_text(path, text)
    except OSError as error:
        message = f"{name} = {path}: cannot be written ({error.strerror or error})"
        raise InputError(message) from error


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write strict JSON atomically.

    Raises:
        ValueError: The document holds NaN or an infinity.
    """
    write_text(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def file_digest(path: Path) -> str:
    """SHA-256 of a file of any size.

    Raises:
        InputError: It cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def document_digest(document: Mapping[str, Any]) -> str:
    """SHA-256 of a document in JSON whatever its spacing and order: keys sorted, ASCII.

    Raises:
        ValueError: The document holds NaN or an infinity.
    """
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


@contextmanager
def held(path: Path, *, busy: str, unusable: str) -> Generator[None, None, None]:
    """Hold the lock file ``path``, or fail at once; a process that dies gives it back.

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
        raise InputError(f"{unusable} ({error.strerror or error})") from error
    try:
        yield
    finally:
        lock.release()
