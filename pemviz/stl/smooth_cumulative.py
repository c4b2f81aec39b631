"""Smooth cumulative robustness: Haghighi, Mehdipour, Bartocci & Belta, CDC 2019.

Two parts, neither the negative of the other: the positive part adds up how much and
for how long a formula holds, the negative part how much it fails. The positive part of
``always f`` is <= 0 exactly when sum_t sigmoid(-beta f_t) >= 1, so it ranks rollouts
and never decides a violation.
"""

# ruff: noqa: D102 (the operators are described by the Semantics protocol)

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal, TypeAlias

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.dominant import LARGEST_EXPONENT, DominantSteps
from pemviz.stl.expressions import Predicate
from pemviz.stl.numbers import NumberSemantics
from pemviz.stl.windows import fold, running, sliding

Part: TypeAlias = Literal["positive", "negative"]


@dataclass(frozen=True)
class SmoothCumulative:
    """The smooth cumulative metric, in the unit of the predicates.

    Attributes:
        beta: sharpness, > 0, per unit of the predicates (per metre).
        part: which of the two parts.
    """

    beta: float = 75.0
    part: Part = "positive"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.beta) and self.beta > 0.0):
            raise InputError(f"smooth-cumulative: beta {self.beta} must be finite and > 0")
        if self.part not in ("positive", "negative"):
            raise InputError(f"smooth-cumulative: part {self.part!r}: positive or negative")

    def opposite(self) -> SmoothCumulative:
        """The same metric's other part."""
        return SmoothCumulative(self.beta, "negative" if self.part == "positive" else "positive")


class SmoothCumulativeSemantics(NumberSemantics):
    """One part of the smooth cumulative robustness of every operator."""

    def __init__(self, metric: SmoothCumulative) -> None:
        self.metric = metric
        self.sign = 1.0 if metric.part == "positive" else -1.0

    def opposite(self) -> SmoothCumulativeSemantics:
        return SmoothCumulativeSemantics(self.metric.opposite())

    def truth(self, like: FloatArray, steps: int) -> FloatArray:
        return self.constant(math.inf if self.sign > 0.0 else 0.0, like, steps)

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:  # noqa: ARG002
        return self.sign * _softplus(self.sign * margin, self.metric.beta)

    def negate(self, value: FloatArray) -> FloatArray:
        return -value

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return _soft_minimum(values, self.metric.beta)

    def disjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        return -_soft_minimum([-value for value in values], self.metric.beta)

    def always(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) == width:
            return _soft_minimum_over_time(value, self.metric.beta)
        return _sliding_soft_minimum(value, self.metric.beta, width)

    def always_predicate(self, predicate: Predicate, margin: FloatArray, width: int) -> FloatArray:
        if len(margin) > width:
            return self.always(self.predicate(predicate, margin), width)
        return DominantSteps(self.metric.beta, self.sign > 0.0, width).always(margin)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) == width:
            return fold(np.add, value)
        return sliding(_add, (value,), width)[0]

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        beta, steps = self.metric.beta, len(left) - last
        if steps == 1:
            met = self.conjunction([right, _soft_minima_so_far(left, beta)[first:]])
            return self.eventually(met, last - first + 1)
        held = np.full((steps, left.shape[1]), -math.inf)  # log sum exp(-beta left) over [t, t']
        result = np.zeros_like(held)
        for offset in range(last + 1):
            held = np.logaddexp(held, -beta * left[offset : offset + steps])
            if offset >= first:
                target = right[offset - first : offset - first + steps]
                result -= np.logaddexp(held, -beta * target) / beta
        return result


def _exp(exponents: FloatArray) -> FloatArray:
    """Exponentials of what is at most 0, never below 1e-304; they are added to 1 or more."""
    np.maximum(exponents, -LARGEST_EXPONENT, out=exponents)
    return np.exp(exponents, out=exponents)


def _softplus(values: FloatArray, beta: float) -> FloatArray:
    """log(1 + exp(beta x)) / beta, without overflow."""
    result = _exp(np.abs(values) * -beta)
    np.log1p(result, out=result)
    result /= beta
    result += np.maximum(values, 0.0)
    return result


def _exponentials(values: FloatArray, least: FloatArray, beta: float) -> FloatArray:
    """exp(-beta (values - least)), where ``least`` is infinite as if it were 0."""
    shift = np.where(np.isfinite(least), least, 0.0)
    exponents = (values - shift) * -beta
    if np.isinf(least).any():
        return np.exp(exponents)
    return _exp(exponents)


def _soft_minimum(values: Sequence[FloatArray], beta: float) -> FloatArray:
    """-log(sum exp(-beta x)) / beta of several arrays, shifted by the minimum."""
    least = reduce(np.minimum, values)
    total = reduce(np.add, [_exponentials(value, least, beta) for value in values])
    return _unshifted(least, total, beta)


def _soft_minimum_over_time(values: FloatArray, beta: float) -> FloatArray:
    """The soft minimum over all steps, [T, n] -> [1, n]."""
    least = values.min(axis=0, keepdims=True)
    return _unshifted(least, fold(np.add, _exponentials(values, least, beta)), beta)


def _soft_minima_so_far(values: FloatArray, beta: float) -> FloatArray:
    """The soft minimum of the steps up to each, [T, n], each shifted by the minimum up to there."""
    least = running(np.minimum, values.copy())
    total = _exp((values - least) * -beta)
    kept = _exp(np.diff(least, axis=0) * beta)
    finite = np.isfinite(least)
    if not finite.all():
        total[~finite] = 0.0
        kept[np.isnan(kept)] = 0.0
    for step in range(len(kept)):
        kept[step] *= total[step]
        total[step + 1] += kept[step]
    return np.where(finite, least - np.log(total) / beta, least)


def _unshifted(least: FloatArray, total: FloatArray, beta: float) -> FloatArray:
    return np.where(np.isfinite(least), least, 0.0) - np.log(total) / beta


def _sliding_soft_minimum(values: FloatArray, beta: float, width: int) -> FloatArray:
    """The soft minimum of every window: pairs (shift, sum of exponentials) are combined."""

    def join(
        earlier: tuple[FloatArray, ...], later: tuple[FloatArray, ...]
    ) -> tuple[FloatArray, FloatArray]:
        shift = np.minimum(earlier[0], later[0])
        total = earlier[1] * _exp((earlier[0] - shift) * -beta)
        total += later[1] * _exp((later[0] - shift) * -beta)
        return shift, total

    # Infinite values (from `true`) would meet as inf - inf: they go into the sum instead.
    total = np.where(np.isposinf(values), 0.0, np.where(np.isneginf(values), np.inf, 1.0))
    shift, total = sliding(join, (np.clip(values, -HUGE, HUGE), total), width)
    return shift - np.log(total) / beta


HUGE = 1e300
"""Stands for infinity where a difference must not be NaN."""


def _add(earlier: tuple[FloatArray, ...], later: tuple[FloatArray, ...]) -> tuple[FloatArray]:
    return (earlier[0] + later[0],)
