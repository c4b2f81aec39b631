"""Arrays of a large archive, mapped where they lie on disk instead of read."""

import math
import mmap
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.errors import InputError
from pemviz.files.array_files import DAMAGE, ENDING, check_entry, read_array, read_header

LOCAL_HEADER = struct.Struct("<4s22xHH")
"""Of an archive's entry: its mark, then the lengths of its name and of what follows that."""
MARK = b"PK\x03\x04"
LARGEST_READ_BYTES = 4 * 1024**3


def map_arrays(path: Path) -> dict[str, AnyArray]:
    """All arrays of an archive by name; those of two or more dimensions are mapped if unpacked.

    Mapped arrays are read-only and need not be aligned. They take memory only for what is looked
    at, which the system may take back, and they keep the file open. Neither the archive's
    checksum nor their numbers are looked at: who reads rows of them checks what is read. A file
    that is cut short in place while it is mapped ends the process; this package's own writers
    replace files.

    Raises:
        InputError: It cannot be read, or is not such an archive.
    """
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            held = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
            arrays: dict[str, AnyArray] = {}
            for entry in archive.infolist():
                name = entry.filename.removesuffix(ENDING)
                check_entry(entry, archive_bytes=len(held))
                if name in arrays:
                    message = f"holds {name!r} twice"
                    raise ValueError(message)
                arrays[name] = _mapped(archive, entry, name, held)
            return arrays
    except DAMAGE as error:
        reason = str(error) or type(error).__name__
        message = f"arrays {path}: cannot be read ({reason})"
        raise InputError(message) from error


def let_go(array: AnyArray) -> None:
    """Have the system take back what a mapped array's file takes of the process's memory.

    It stays where the system keeps files for the next look; an array that is not mapped stays.
    """
    owner: Any = array
    while isinstance(owner, np.ndarray):
        owner = owner.base
    if isinstance(owner, memoryview):
        owner = owner.obj
    if isinstance(owner, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        owner.madvise(mmap.MADV_DONTNEED)


def _mapped(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, held: mmap.mmap
) -> AnyArray:
    """One array, mapped if it can be, else read.

    Raises:
        ValueError: Saying what is wrong.
    """
    with archive.open(entry) as content:
        dtype, order, shape, used = read_header(content, name)
    count = math.prod(shape)
    if len(shape) < 2 or not count or entry.compress_type != zipfile.ZIP_STORED:
        if entry.file_size > LARGEST_READ_BYTES:
            message = f"{name}: is packed and larger than 4 GB, too large to read"
            raise ValueError(message)
        with archive.open(entry) as content:
            return read_array(content, name, size=entry.file_size)
    if count * dtype.itemsize != entry.file_size - used:
        message = (
            f"{name}: its header asks for {count * dtype.itemsize} bytes, "
            f"there are {entry.file_size - used}"
        )
        raise ValueError(message)
    begin = _content_offset(entry, held) + used
    if begin + count * dtype.itemsize > len(held):
        message = f"{name}: is cut short"
        raise ValueError(message)
    flat = np.frombuffer(held, dtype=dtype, count=count, offset=begin)
    return flat.reshape(shape, order="F" if order == "True" else "C")


def _content_offset(entry: zipfile.ZipInfo, held: mmap.mmap) -> int:
    """Where an entry's bytes begin in its archive."""
    mark, name_bytes, extra_bytes = LOCAL_HEADER.unpack_from(held, entry.header_offset)
    if mark != MARK:
        message = f"its entry {entry.filename!r} is not where the archive says"
        raise ValueError(message)
    return entry.header_offset + LOCAL_HEADER.size + name_bytes + extra_bytes
