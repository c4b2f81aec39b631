"""Checks and digests of a model's tensors."""

import hashlib
from collections.abc import Mapping

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError


def check_finite(tensors: Mapping[str, AnyArray], *, where: str) -> None:
    """Refuse tensors with NaN or infinity.

    Raises:
        PemError: naming the first such tensor.
    """
    for name in sorted(tensors):
        if not np.isfinite(tensors[name]).all():
            raise PemError(f"{where}: tensor {name!r} holds values that are not finite")


def as_double(array: AnyArray) -> FloatArray:
    """The numbers in double precision; what is no number stays none, without a warning."""
    with np.errstate(invalid="ignore"):
        return np.asarray(array, dtype=np.float64)


def tensors_digest(kind: str, tensors: Mapping[str, AnyArray]) -> str:
    """SHA-256 (hex) over a model's kind and its tensors: names, types, shapes and bytes."""
    digest = hashlib.sha256(kind.encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"|{name}|{array.dtype.str}|{list(array.shape)}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
