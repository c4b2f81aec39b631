"""What the three metrics share in numpy: arithmetic on numbers, not on formulas."""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pemviz.arrays import FloatArray


class NumpySemantics:
    """The part of `Semantics` that is the same for all metrics."""

    def minimum(self, left: FloatArray, right: FloatArray) -> FloatArray:
        return np.minimum(left, right)

    def maximum(self, left: FloatArray, right: FloatArray) -> FloatArray:
        return np.maximum(left, right)

    def constant(self, value: float, like: FloatArray, steps: int) -> FloatArray:
        return np.full((like.shape[0], steps), value)


CHUNK_VALUES = 1 << 17
"""Most values held at once while a window is laid out in full."""


def window_chunks(windows: FloatArray) -> Iterator[slice]:
    """Slices of the step axis of [n, steps, width] that keep a chunk in the cache."""
    n, steps, width = windows.shape
    size = max(1, CHUNK_VALUES // max(1, n * width))
    for start in range(0, steps, size):
        yield slice(start, start + size)
