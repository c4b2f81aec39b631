"""What the three metrics share: arithmetic on numbers, not on formulas."""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

from typing import Any

from pemviz.arrays import FloatArray, namespace


class NumberSemantics:
    """The part of `Semantics` that is the same for all metrics; it takes tensors too."""

    def minimum(self, left: FloatArray | float, right: FloatArray | float) -> FloatArray:
        xp, one, other = _alike(left, right)
        return xp.minimum(one, other)

    def maximum(self, left: FloatArray | float, right: FloatArray | float) -> FloatArray:
        xp, one, other = _alike(left, right)
        return xp.maximum(one, other)

    def constant(self, value: float, like: FloatArray, steps: int) -> FloatArray:
        xp, shape = namespace(like), (steps, like.shape[1])
        return xp.full(shape, value, dtype=xp.float64, device=like.device)


def _alike(left: FloatArray | float, right: FloatArray | float) -> tuple[Any, Any, Any]:
    """The namespace of whichever is an array, if any, and both as its arrays."""
    like: Any = right if isinstance(left, float) else left
    xp, device = namespace(like), getattr(like, "device", None)
    one, other = (xp.asarray(value, dtype=xp.float64, device=device) for value in (left, right))
    return xp, one, other
