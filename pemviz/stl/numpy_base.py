"""What the three metrics share in numpy: arithmetic on numbers, not on formulas."""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import numpy as np

from pemviz.arrays import FloatArray


class NumpySemantics:
    """The part of `Semantics` that is the same for all metrics."""

    def minimum(self, left: FloatArray, right: FloatArray) -> FloatArray:
        return np.minimum(left, right)

    def maximum(self, left: FloatArray, right: FloatArray) -> FloatArray:
        return np.maximum(left, right)

    def constant(self, value: float, like: FloatArray, steps: int) -> FloatArray:
        return np.full((steps, like.shape[1]), value)
