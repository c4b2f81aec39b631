"""Archives of arrays that hold a digest of themselves: one that was edited is found.

The digest is of the names, sizes and checksums of all arrays, which the archive has anyway: it
takes no further look at their bytes, and reading them compares the checksums. What the archive
belongs to enters it too, so that one that was put in another's place is found.
"""

import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pemviz.arrays import AnyArray, IntArray
from pemviz.errors import InputError
from pemviz.files.array_files import DAMAGE, ENDING, read_arrays

DIGEST = "digest"


def append_digest(stream: BinaryIO, *, of: bytes) -> None:
    """Add the digest to an archive that has just been written.

    Args:
        stream: The archive.
        of: What it belongs to.

    Raises:
        OSError: It cannot be written.
    """
    with zipfile.ZipFile(stream, mode="a") as archive:
        content = io.BytesIO()
        np.save(content, _digest(archive.infolist(), of))
        archive.writestr(f"{DIGEST}{ENDING}", content.getvalue())


def read_digested(path: Path, *, of: bytes) -> dict[str, AnyArray]:
    """All arrays of an archive by name.

    Raises:
        InputError: It cannot be read, is no such archive, belongs to something else, or was
            changed since it was written.
    """
    arrays = read_arrays(path)
    kept = arrays.pop(DIGEST, None)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [e for e in archive.infolist() if e.filename != f"{DIGEST}{ENDING}"]
    except DAMAGE as error:
        message = f"arrays {path}: cannot be read ({error})"
        raise InputError(message) from error
    if kept is None or not np.array_equal(kept, _digest(entries, of)):
        message = (
            f"arrays {path}: was changed since it was written, or is another run's: its digest "
        )
        message += "is none" if kept is None else "is another"
        raise InputError(message)
    return arrays


def _digest(entries: Sequence[zipfile.ZipInfo], of: bytes) -> IntArray:
    lines = sorted(f"{entry.filename} {entry.file_size} {entry.CRC:08x}\n" for entry in entries)
    listed = "".join(lines).encode("utf-8", "surrogateescape")
    found = hashlib.sha256(hashlib.sha256(of).digest() + listed).digest()
    return np.frombuffer(found, dtype="<i8").astype(np.int64)
