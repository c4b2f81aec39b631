"""Damage to the two binary containers, with structure kept as far as the fault allows."""

import io
import json
import random
import struct
import warnings
import zipfile
from collections.abc import Mapping

import numpy as np
from safetensors.numpy import save

from tests.fuzz.mutate import WORDS, as_json, damage_bytes, damage_tree, number

DTYPES = ("F64", "F32", "F16", "BF16", "F8_E4M3", "F8_E5M2", "I64", "I32", "I16", "I8", "U8", "U16",
          "U32", "U64", "BOOL", "C64", "X", "F4")  # fmt: skip
ARRAY_TYPES = ("f8", "f4", "f2", "i8", "i4", "i1", "u1", "u8", "?", "c16", "S4", "U3", "M8[s]",
               "m8[s]", ">f8", "V8")  # fmt: skip
DESCRIPTIONS = (
    "'<f8'", "'>f8'", "'|O'", "'|b1'", "'<i8'", "'<U5'", "'|S0'", "'|V100'", "'<M8[ns]'", "'<c16'",
    "[('a', '<f8')]", "'<f8000000000'", "'x'", "1", "None", "()", "'|V99999999999'",
)  # fmt: skip
SHAPES = (
    "()", "(0,)", "(-1,)", "(10**9,)", "(1000000000000,)", "(99999999999999999999,)", "(True,)",
    "(1e3,)", "(5, 4611686018427387904)", "(0, 10)", "(10, 0)", "(2147483648, 4)", "[5]", "5",
    "(" * 150 + ")" * 150, "-" * 4000 + "1", "((5,),)", "('a',)",
)  # fmt: skip

Arrays = Mapping[str, np.ndarray]


def damage_arrays(rng: random.Random, arrays: Arrays) -> dict[str, np.ndarray]:
    """Valid arrays with other values, types, shapes or names."""
    made = dict(arrays)
    for _ in range(rng.choice((1, 1, 2, 3))):
        if not made:
            break
        name = rng.choice(list(made))
        kind = rng.randrange(10)
        if kind < 4:
            made[name] = _other_values(rng, made[name])
        elif kind == 4:
            with np.errstate(all="ignore"):
                made[name] = _as_type(rng, made[name])
        elif kind < 7:
            made[name] = _other_shape(rng, made[name])
        elif kind == 7:
            del made[name]
        elif kind == 8:
            made[rng.choice((*WORDS, name + "x", "members.²." + name))] = made.pop(name)
        else:
            made[name] = made[rng.choice(list(made))]
    return made


def _other_values(rng: random.Random, array: np.ndarray) -> np.ndarray:
    made = np.array(array)
    if not made.size:
        return made
    flat = made.reshape(-1)
    if made.dtype.kind not in "iufb":
        return made
    chosen = slice(None) if rng.random() < 0.2 else rng.randrange(flat.size)
    if made.dtype.kind == "f":
        with np.errstate(all="ignore"):
            try:
                flat[chosen] = number(rng) if rng.random() < 0.8 else flat[chosen] * -1e3
            except OverflowError:
                flat[chosen] = np.inf
    elif made.dtype.kind in "iu":
        limits = np.iinfo(made.dtype)
        flat[chosen] = rng.choice((limits.min, limits.max, 0, 1, limits.max - 1))
    else:
        flat[chosen] = not bool(flat[0])
    return made


def _as_type(rng: random.Random, array: np.ndarray) -> np.ndarray:
    try:
        with warnings.catch_warnings():  # complex to real, large to small: that is the damage
            warnings.simplefilter("ignore")
            return array.astype(rng.choice(ARRAY_TYPES))
    except (TypeError, ValueError):
        return array


def _other_shape(rng: random.Random, array: np.ndarray) -> np.ndarray:
    choices = [array.reshape(-1), array[None], array.T, array[..., None], np.empty(0), array[:0]]
    if array.ndim:
        choices += [array[:-1], np.concatenate([array, array]), array[::-1], array[..., :1]]
    else:
        choices = [array[None], np.empty(0)]
    return rng.choice(choices)


def damage_safetensors(
    rng: random.Random, tensors: Arrays, metadata: Mapping[str, str], others: list[bytes]
) -> bytes:
    """A file of tensors, damaged in its bytes, its header, its metadata or its numbers."""
    kind = rng.randrange(10)
    metadata = dict(metadata)
    if kind in (0, 1):
        return damage_bytes(rng, packed(tensors, metadata), others)
    if kind in (2, 3):
        return _forged_header(rng, packed(tensors, metadata))
    if kind in (4, 5, 6) and metadata:
        metadata = _damaged_metadata(rng, metadata)
        tensors = damage_arrays(rng, tensors) if kind == 6 else tensors
    else:
        tensors = damage_arrays(rng, tensors)
    return packed(tensors, metadata)


def packed(tensors: Arrays, metadata: Mapping[str, str]) -> bytes:
    """The bytes of a safetensors file; arrays that it cannot hold are left out."""
    kept = {
        name: np.ascontiguousarray(array)
        for name, array in tensors.items()
        if array.dtype.kind in "iufb" and array.dtype.isnative
    }
    return save(kept, metadata=dict(metadata) or None)


def _damaged_metadata(rng: random.Random, metadata: dict[str, str]) -> dict[str, str]:
    key = rng.choice(list(metadata))
    try:
        tree = json.loads(metadata[key])
    except ValueError:
        tree = metadata[key]
    kind = rng.randrange(8)
    if kind == 0:
        text = damage_bytes(rng, metadata[key].encode(), [b"{}"]).decode(errors="replace")
    elif kind == 1:
        text = rng.choice(("[" * 100_000, "9" * 5000, "{}", "null", '{"a":' * 50_000, "NaN"))
    else:
        text = as_json(damage_tree(rng, tree))
    return {**metadata, key: text.encode(errors="replace").decode()}


def _forged_header(rng: random.Random, content: bytes) -> bytes:
    """A header that says other types, shapes or offsets, or another length of itself."""
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    name = rng.choice(list(header))
    kind = rng.randrange(6)
    if kind == 0 and "dtype" in header[name]:
        header[name]["dtype"] = rng.choice(DTYPES)
    elif kind == 1 and "shape" in header[name]:
        header[name]["shape"] = rng.choice(
            ([2**62, 4], [0, 2**63], [-1], [10**12], [], [1e3], "x", [2**64])
        )
    elif kind == 2 and "data_offsets" in header[name]:
        header[name]["data_offsets"] = rng.choice(([0, 2**60], [8, 0], [-8, 0], [0], [0, 8], None))
    else:
        header = damage_tree(rng, header)
    text = as_json(header).encode(errors="replace")
    said = len(text) if rng.random() < 0.8 else rng.choice((0, 1, 2**40, 2**63, len(text) + 8))
    return struct.pack("<Q", said) + text + content[8 + length :]


def damage_npz(rng: random.Random, arrays: Arrays, others: list[bytes]) -> bytes:
    """An archive of arrays, damaged in its bytes, its entries' headers or its numbers."""
    kind = rng.randrange(10)
    if kind in (0, 1, 2):
        return damage_bytes(rng, archive(arrays), others)
    if kind in (3, 4, 5):
        return _forged_entries(rng, arrays)
    return archive(damage_arrays(rng, arrays), compress=rng.random() < 0.3)


def archive(arrays: Arrays, *, compress: bool = False) -> bytes:
    """The bytes of an .npz file."""
    stream = io.BytesIO()
    compression = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", compression) as made:
        for name, array in arrays.items():
            entry = io.BytesIO()
            np.save(entry, array, allow_pickle=array.dtype.hasobject)
            made.writestr(f"{name}.npy".replace("\x00", "_"), entry.getvalue())
    return stream.getvalue()


def _forged_entries(rng: random.Random, arrays: Arrays) -> bytes:
    """One entry's header says another type or shape, or the entry is no array at all."""
    chosen = rng.choice(list(arrays))
    stream = io.BytesIO()
    compression = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(stream, "w", compression) as made:
        for name, array in arrays.items():
            entry = io.BytesIO()
            np.save(entry, array)
            data = entry.getvalue()
            made.writestr(f"{name}.npy", _forged(rng, array, data) if name == chosen else data)
        if rng.random() < 0.1:
            made.writestr(rng.choice(("x.npy", "../x.npy", "note.txt", ".npy")), b"not an array")
    return stream.getvalue()


def _forged(rng: random.Random, array: np.ndarray, data: bytes) -> bytes:
    kind = rng.randrange(6)
    if kind == 0:
        return rng.choice((b"", b"\x93NUMPY", b"\x80\x04N.", b"x" * 100, b"\0" * 2_000_000))
    if kind == 1:
        return damage_bytes(rng, data, [data])
    description = rng.choice(DESCRIPTIONS) if kind in (2, 3) else repr(array.dtype.str)
    shape = rng.choice(SHAPES) if kind in (3, 4, 5) else repr(array.shape)
    text = f"{{'descr': {description}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    version = rng.choice((1, 1, 2, 3))
    size = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes((version, 0)) + size + text + array.tobytes()
