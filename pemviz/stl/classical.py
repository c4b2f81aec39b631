"""Classical (space) robustness: Donze & Maler, FORMATS 2010.

Minimum for and/always, maximum for or/eventually; in the unit of the predicates.
"""

# ruff: noqa: D102 (the operators are described by Metric)

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.stl.formulas import Predicate
from pemviz.stl.metric import Metric, Parts, elementwise, fold, sliding_idempotent


@dataclass(frozen=True)
class Classical(Metric):
    """The metric by which violations are decided; ``true`` is +inf."""

    def truth(self) -> float:
        return math.inf

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:  # noqa: ARG002
        return margin

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return reduce(np.minimum, values)

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return reduce(np.maximum, values)

    def always(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) == width:
            return fold(np.minimum, value)
        return sliding_idempotent(elementwise(np.minimum), (value,), width)[0]

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) == width:
            return fold(np.maximum, value)
        return sliding_idempotent(elementwise(np.maximum), (value,), width)[0]

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        width = last - first + 1
        if len(right) == width:
            return _until_once(left, right, first)
        # Over [t, t'] with t' >= t + first: [t, t + first - 1] is common to all t'.
        later = left[first:]
        reached = sliding_idempotent(_then, (later, np.minimum(later, right)), width)[1]
        return reached if first == 0 else np.minimum(self.always(left[:-width], first), reached)


def _then(earlier: Parts, later: Parts) -> Parts:
    """Two stretches of time after one another: (left held throughout, right reached)."""
    held, reached = earlier
    return np.minimum(held, later[0]), np.maximum(reached, np.minimum(held, later[1]))


def _until_once(left: FloatArray, right: FloatArray, first: int) -> FloatArray:
    """Until at a single step, by a running minimum: [1, n]."""
    held = np.amin(left[: first + 1], 0)
    reached = np.minimum(held, right[0])
    met = np.empty_like(held)
    for now, target in zip(left[first + 1 :], right[1:], strict=True):
        np.minimum(held, now, out=held)
        np.minimum(held, target, out=met)
        np.maximum(reached, met, out=reached)
    return reached[None]
