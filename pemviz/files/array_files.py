"""Arrays, ``.npz`` and safetensors, from files that may come from anywhere: read, mapped, sealed.

numpy reserves what an array's header asks for before it looks for the data, and evaluates the
header as a Python literal. Here a header must have the form that numpy writes, hold plain
numbers, and ask for exactly the bytes that are there.

An archive may hold a digest of itself: of the names, sizes and checksums of all arrays, which it
has anyway, and of what it belongs to. One that was edited, or put in another's place, is found
without a further look at its bytes: reading them compares the checksums.
"""

import hashlib
import io
import math
import mmap
import re
import struct
import zipfile
import zlib
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from pemviz.arrays import AnyArray, IntArray
from pemviz.errors import InputError

ENDING = ".npy"
MAGIC = b"\x93NUMPY"
LONGEST_HEADER = 10_000
LARGEST_RATIO = 1100
"""Deflate turns one byte into at most 1032."""
PIECE_BYTES = 1 << 22
LARGEST_READ_BYTES = 4 * 1024**3
DIGEST = "digest"
LOCAL_HEADER = struct.Struct("<4s22xHH")
"""Of an archive's entry: its mark, then the lengths of its name and of what follows that."""
MARK = b"PK\x03\x04"

_HEADER = re.compile(
    r"\{'descr': '(?P<type>\|b1|[<>][if][48])', 'fortran_order': (?P<order>False|True), "
    r"'shape': \((?P<shape>[0-9]{0,15}(?:, ?[0-9]{1,15}){0,8},?)\), ?\}\s*"
)
_DAMAGE = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, OverflowError,
    zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip


def read_arrays(path: Path) -> dict[str, AnyArray]:
    """All arrays of an archive by name; truth values, whole numbers and floats of 4 or 8 bytes.

    Raises:
        InputError: It cannot be read, or is not such an archive.
    """
    with _refusing_damage(path), path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        size = path.stat().st_size
        return {name: _read(archive, entry, name) for name, entry in _entries(archive, size)}


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
    with _refusing_damage(path), path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
        held = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        entries = _entries(archive, len(held))
        return {name: _mapped(archive, entry, name, held) for name, entry in entries}


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


def append_digest(stream: BinaryIO, *, of: bytes) -> None:
    """Add the digest to an archive that has just been written.

    Args:
        stream: The archive.
        of: What it belongs to.
    """
    with zipfile.ZipFile(stream, mode="a") as archive:
        content = io.BytesIO()
        np.save(content, _digest(archive.infolist(), of))
        archive.writestr(f"{DIGEST}{ENDING}", content.getvalue())


def read_digested(path: Path, *, of: bytes) -> dict[str, AnyArray]:
    """All arrays of an archive by name, but for its digest.

    Raises:
        InputError: It cannot be read, is no such archive, belongs to something else, or was
            changed since it was written.
    """
    arrays = read_arrays(path)
    kept = arrays.pop(DIGEST, None)
    with _refusing_damage(path), zipfile.ZipFile(path) as archive:
        entries = [e for e in archive.infolist() if e.filename != f"{DIGEST}{ENDING}"]
    if kept is None or not np.array_equal(kept, _digest(entries, of)):
        raise InputError(
            f"arrays {path}: was changed since it was written, or is another run's: its digest "
            f"is {'none' if kept is None else 'another'}"
        )
    return arrays


def load_tensors(path: Path) -> dict[str, AnyArray]:
    """All tensors of a safetensors file by name; real numbers and truth values.

    Raises:
        InputError: It cannot be read, or is not such a file.
    """
    try:
        tensors = load_file(str(path))
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        reason = str(error) or type(error).__name__
        raise InputError(f"tensors {path}: cannot be read ({reason})") from error
    for name, array in tensors.items():
        if array.dtype.kind not in "biuf":
            raise InputError(
                f"tensors {path}: {name!r} holds {array.dtype}, must hold real numbers"
            )
    return tensors


@contextmanager
def _refusing_damage(path: Path) -> Generator[None, None, None]:
    try:
        yield
    except _DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise InputError(f"arrays {path}: cannot be read ({reason})") from error


def _entries(archive: zipfile.ZipFile, archive_bytes: int) -> Iterator[tuple[str, zipfile.ZipInfo]]:
    """Each array's name and entry, unless it claims more than the archive can hold."""
    names = set[str]()
    for entry in archive.infolist():
        where, name = f"its entry {entry.filename!r}", entry.filename.removesuffix(ENDING)
        if not entry.filename.endswith(ENDING):
            raise ValueError(f"{where} is no array ({ENDING})")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{where} is packed in an unknown way")
        ratio = 1 if entry.compress_type == zipfile.ZIP_STORED else LARGEST_RATIO
        if entry.file_size > archive_bytes * ratio:
            raise ValueError(f"{where} claims more bytes than the archive can hold")
        if name in names:
            raise ValueError(f"holds {name!r} twice")
        names.add(name)
        yield name, entry


def _read(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> AnyArray:
    with archive.open(entry) as content:
        dtype, order, shape, begin = _header(content, name, size=entry.file_size)
        octets = np.empty(entry.file_size - begin, dtype=np.uint8)
        for start in range(0, octets.size, PIECE_BYTES):
            wanted = min(PIECE_BYTES, octets.size - start)
            piece = content.read(wanted)
            if len(piece) < wanted:
                raise ValueError(f"{name}: is cut short")
            octets[start : start + wanted] = np.frombuffer(piece, dtype=np.uint8)
        content.read(1)  # at its end the archive's checksum is compared
    return octets.view(dtype).reshape(shape, order=order)


def _mapped(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str, held: mmap.mmap
) -> AnyArray:
    """One array, mapped if it can be, else read."""
    with archive.open(entry) as content:
        dtype, order, shape, used = _header(content, name, size=entry.file_size)
    count = math.prod(shape)
    if len(shape) < 2 or not count or entry.compress_type != zipfile.ZIP_STORED:
        if entry.file_size > LARGEST_READ_BYTES:
            raise ValueError(f"{name}: is packed and larger than 4 GB, too large to read")
        return _read(archive, entry, name)
    mark, name_bytes, extra_bytes = LOCAL_HEADER.unpack_from(held, entry.header_offset)
    if mark != MARK:
        raise ValueError(f"its entry {entry.filename!r} is not where the archive says")
    begin = entry.header_offset + LOCAL_HEADER.size + name_bytes + extra_bytes + used
    if begin + count * dtype.itemsize > len(held):
        raise ValueError(f"{name}: is cut short")
    flat = np.frombuffer(held, dtype=dtype, count=count, offset=begin)
    return flat.reshape(shape, order=order)


def _header(
    content: IO[bytes], name: str, *, size: int
) -> tuple[np.dtype, Any, tuple[int, ...], int]:
    """Type, order and shape of an entry of ``size`` bytes, and where its numbers begin."""
    start = content.read(8)
    if start[:6] != MAGIC or start[6:] not in (b"\x01\x00", b"\x02\x00"):
        raise ValueError(f"{name}: is no array of numpy's format 1.0 or 2.0")
    layout = "<H" if start[6] == 1 else "<I"
    (length,) = struct.unpack(layout, content.read(struct.calcsize(layout)))
    text = content.read(min(length, LONGEST_HEADER + 1)).decode("latin-1")
    header = _HEADER.fullmatch(text)
    if header is None or len(text) != length:
        raise ValueError(f"{name}: its header does not describe an array of numbers")
    shape = tuple(int(word) for word in header["shape"].split(",") if word.strip())
    dtype, begin = np.dtype(header["type"]), 8 + struct.calcsize(layout) + length
    claimed = math.prod(shape) * dtype.itemsize
    if claimed != size - begin:
        raise ValueError(f"{name}: its header asks for {claimed} bytes, there are {size - begin}")
    return dtype, "F" if header["order"] == "True" else "C", shape, begin


def _digest(entries: Sequence[zipfile.ZipInfo], of: bytes) -> IntArray:
    lines = sorted(f"{entry.filename} {entry.file_size} {entry.CRC:08x}\n" for entry in entries)
    listed = "".join(lines).encode("utf-8", "surrogateescape")
    found = hashlib.sha256(hashlib.sha256(of).digest() + listed).digest()
    return np.frombuffer(found, dtype="<i8").astype(np.int64)
