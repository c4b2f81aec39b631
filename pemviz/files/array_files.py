"""Reading arrays, ``.npz`` and safetensors, from files that may come from anywhere.

numpy reserves what an array's header asks for before it looks for the data, and evaluates the
header as a Python literal. Here a header must have the form that numpy writes, hold plain
numbers, and ask for exactly the bytes that are there.
"""

import math
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from pemviz.arrays import AnyArray
from pemviz.errors import InputError

ENDING = ".npy"
MAGIC = b"\x93NUMPY"
LONGEST_HEADER = 10_000
LARGEST_RATIO = 1100
"""Deflate turns one byte into at most 1032."""
PIECE_BYTES = 1 << 22

_HEADER = re.compile(
    r"\{'descr': '(?P<type>\|b1|[<>][if][48])', 'fortran_order': (?P<order>False|True), "
    r"'shape': \((?P<shape>[0-9]{0,15}(?:, ?[0-9]{1,15}){0,8},?)\), ?\}\s*"
)


def read_arrays(path: Path) -> dict[str, AnyArray]:
    """All arrays of an archive by name; truth values, whole numbers and floats of 4 or 8 bytes.

    Raises:
        InputError: It cannot be read, or is not such an archive.
    """
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            size = path.stat().st_size
            arrays: dict[str, AnyArray] = {}
            for entry in archive.infolist():
                name = entry.filename.removesuffix(ENDING)
                check_entry(entry, archive_bytes=size)
                if name in arrays:
                    message = f"holds {name!r} twice"
                    raise ValueError(message)
                with archive.open(entry) as content:
                    arrays[name] = read_array(content, name, size=entry.file_size)
            return arrays
    except DAMAGE as error:
        reason = str(error) or type(error).__name__
        message = f"arrays {path}: cannot be read ({reason})"
        raise InputError(message) from error


def load_tensors(path: Path) -> dict[str, AnyArray]:
    """All tensors of a safetensors file by name; real numbers and truth values.

    Raises:
        InputError: It cannot be read, or is not such a file.
    """
    try:
        tensors = load_file(str(path))
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        reason = str(error) or type(error).__name__
        message = f"tensors {path}: cannot be read ({reason})"
        raise InputError(message) from error
    for name, array in tensors.items():
        if array.dtype.kind not in "biuf":
            message = f"tensors {path}: {name!r} holds {array.dtype}, must hold real numbers"
            raise InputError(message)
    return tensors


DAMAGE = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, OverflowError,
    zipfile.BadZipFile, zlib.error, struct.error,
)  # fmt: skip


def check_entry(entry: zipfile.ZipInfo, *, archive_bytes: int) -> None:
    """Refuse an entry that is no array or claims more than the archive can hold.

    Raises:
        ValueError: Saying what is wrong.
    """
    if not entry.filename.endswith(ENDING):
        message = f"its entry {entry.filename!r} is no array ({ENDING})"
        raise ValueError(message)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        message = f"its entry {entry.filename!r} is packed in an unknown way"
        raise ValueError(message)
    most = archive_bytes * (1 if entry.compress_type == zipfile.ZIP_STORED else LARGEST_RATIO)
    if entry.file_size > most:
        message = f"its entry {entry.filename!r} claims more bytes than the archive can hold"
        raise ValueError(message)


def read_array(content: IO[bytes], name: str, *, size: int) -> AnyArray:
    """The array of an entry of ``size`` bytes.

    Raises:
        ValueError: Saying what is wrong.
    """
    dtype, order, shape, used = read_header(content, name)
    count = math.prod(shape)
    if count * dtype.itemsize != size - used:
        message = (
            f"{name}: its header asks for {count * dtype.itemsize} bytes, there are {size - used}"
        )
        raise ValueError(message)
    flat = np.empty(count, dtype=dtype)
    octets = flat.view(np.uint8)
    for start in range(0, octets.size, PIECE_BYTES):
        wanted = min(PIECE_BYTES, octets.size - start)
        piece = content.read(wanted)
        if len(piece) < wanted:
            message = f"{name}: is cut short"
            raise ValueError(message)
        octets[start : start + wanted] = np.frombuffer(piece, dtype=np.uint8)
    content.read(1)  # at its end the archive's checksum is compared
    return flat.reshape(shape, order="F" if order == "True" else "C")


def read_header(content: IO[bytes], name: str) -> tuple[np.dtype, str, tuple[int, ...], int]:
    """Type, order and shape, and how many bytes the header takes.

    Raises:
        ValueError: It is no header of an array of numbers.
    """
    start = content.read(8)
    if start[:6] != MAGIC or start[6:] not in (b"\x01\x00", b"\x02\x00"):
        message = f"{name}: is no array of numpy's format 1.0 or 2.0"
        raise ValueError(message)
    layout = "<H" if start[6] == 1 else "<I"
    (length,) = struct.unpack(layout, content.read(struct.calcsize(layout)))
    text = content.read(min(length, LONGEST_HEADER + 1)).decode("latin-1")
    header = _HEADER.fullmatch(text)
    if header is None or len(text) != length:
        message = f"{name}: its header does not describe an array of numbers"
        raise ValueError(message)
    shape = tuple(int(word) for word in header["shape"].split(",") if word.strip())
    return np.dtype(header["type"]), header["order"], shape, 8 + struct.calcsize(layout) + length
