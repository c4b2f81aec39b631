"""Files that are either whole or not there."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO


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


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write strict JSON atomically.

    Raises:
        ValueError: The document holds NaN or an infinity.
    """
    write_text(path, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
