"""What the three metrics share: arithmetic on numbers, not on formulas."""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import numpy as np

from pemviz.arrays import FloatArray


class NumberSemantics:
    """The part of `Semantics` that is the same for all metrics."""

    def minimum(self, left: FloatArray | float, right: FloatArray | float) -> FloatArray:
        return np.asarray(np.minimum(left, right), dtype=np.float64)

    def maximum(self, left: FloatArray | float, right: FloatArray | float) -> FloatArray:
        return np.asarray(np.maximum(left, right), dtype=np.float64)

    def constant(self, value: float, like: FloatArray, steps: int) -> FloatArray:
        return np.full((steps, like.shape[1]), value)
