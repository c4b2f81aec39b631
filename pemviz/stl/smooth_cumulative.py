"""Smooth cumulative robustness: Haghighi, Mehdipour, Bartocci & Belta, CDC 2019.

Two parts, neither the negative of the other: the positive part adds up how much and
for how long a formula holds, the negative part how much it fails. The positive part of
``always f`` is <= 0 exactly when sum_t sigmoid(-beta f_t) >= 1, so it ranks rollouts
and never decides a violation.
"""

# ruff: noqa: D102 (the operators are described by Metric)

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Literal

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import InputError
from pemviz.stl.formulas import Predicate
from pemviz.stl.metric import Metric, Parts, elementwise, fold, running, sliding

LARGEST_EXPONENT = 700.0
"""Exponentials beyond it (below minus it) leave double precision, at ten times the cost."""
NEGLIGIBLE_NATS = 38.0
"""Terms that all together are smaller by a factor of exp of this do not count."""
FEW = 4
"""Where at most one value in so many counts, they are picked out one by one."""
HUGE = 1e300
"""Stands for infinity where a difference must not be NaN."""


@dataclass(frozen=True)
class SmoothCumulative(Metric):
    """The smooth cumulative metric, in the unit of the predicates.

    Attributes:
        beta: sharpness, > 0, per unit of the predicates (per metre).
        part: which of the two parts.
    """

    beta: float = 75.0
    part: Literal["positive", "negative"] = "positive"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.beta) and self.beta > 0.0):
            raise InputError(f"smooth-cumulative: beta {self.beta} must be finite and > 0")
        if self.part not in ("positive", "negative"):
            raise InputError(f"smooth-cumulative: part {self.part!r}: positive or negative")

    @property
    def is_positive(self) -> bool:
        """Whether it is the positive part."""
        return self.part == "positive"

    def opposite(self) -> SmoothCumulative:
        return SmoothCumulative(self.beta, "negative" if self.is_positive else "positive")

    def truth(self) -> float:
        return math.inf if self.is_positive else 0.0

    def predicate(self, predicate: Predicate, margin: FloatArray) -> FloatArray:  # noqa: ARG002
        """log(1 + exp(beta x)) / beta in the positive part, without overflow."""
        sign = 1.0 if self.is_positive else -1.0
        values = sign * margin
        result = _exp(np.abs(values) * -self.beta)
        np.log1p(result, out=result)
        result /= self.beta
        result += np.maximum(values, 0.0)
        return sign * result

    def conjunction(self, values: Sequence[FloatArray]) -> FloatArray:
        least = reduce(np.minimum, values)
        total = reduce(np.add, [_exponentials(value, least, self.beta) for value in values])
        return _unshifted(least, total, self.beta)

    def always(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) > width:
            return _sliding_soft_minimum(value, self.beta, width)
        least = value.min(axis=0, keepdims=True)
        total = fold(np.add, _exponentials(value, least, self.beta))
        return _unshifted(least, total, self.beta)

    def always_predicate(self, predicate: Predicate, margin: FloatArray, width: int) -> FloatArray:
        if len(margin) > width:
            return self.always(self.predicate(predicate, margin), width)
        return _soft_minimum_near_the_least(margin, self.beta, self.is_positive)

    def eventually(self, value: FloatArray, width: int) -> FloatArray:
        if len(value) == width:
            return fold(np.add, value)
        return sliding(elementwise(np.add), (value,), width)[0]

    def until(self, left: FloatArray, right: FloatArray, first: int, last: int) -> FloatArray:
        beta, steps = self.beta, len(left) - last
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


def _exponentials(values: FloatArray, least: FloatArray, beta: float) -> FloatArray:
    """exp(-beta (values - least)), where ``least`` is infinite as if it were 0."""
    shift = np.where(np.isfinite(least), least, 0.0)
    exponents = (values - shift) * -beta
    if np.isinf(least).any():
        return np.exp(exponents)
    return _exp(exponents)


def _unshifted(least: FloatArray, total: FloatArray, beta: float) -> FloatArray:
    return np.where(np.isfinite(least), least, 0.0) - np.log(total) / beta


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


def _sliding_soft_minimum(values: FloatArray, beta: float, width: int) -> FloatArray:
    """The soft minimum of every window: pairs (shift, sum of exponentials) are combined."""

    def join(earlier: Parts, later: Parts) -> Parts:
        shift = np.minimum(earlier[0], later[0])
        total = earlier[1] * _exp((earlier[0] - shift) * -beta)
        total += later[1] * _exp((later[0] - shift) * -beta)
        return shift, total

    # Infinite values (from `true`) would meet as inf - inf: they go into the sum instead.
    total = np.where(np.isposinf(values), 0.0, np.where(np.isneginf(values), np.inf, 1.0))
    shift, total = sliding(join, (np.clip(values, -HUGE, HUGE), total), width)
    return shift - np.log(total) / beta


def _soft_minimum_near_the_least(margin: FloatArray, beta: float, positive: bool) -> FloatArray:
    """The soft minimum of a predicate over time, ``margin [width, n]`` to [1, n].

    For a predicate's value r, exp(-beta r) is 1 / (1 + exp(beta margin)) in the positive part and
    1 + exp(-beta margin) in the negative one, so that no logarithm is needed per step. Steps whose
    margin lies further above the least one than ``reach`` together make up less than half of a
    double's last digit of the sum, and are left out.
    """
    width, count = margin.shape
    # what margins are counted from, so that no exponential leaves double precision
    least = margin.min(axis=0)
    base = np.maximum(least, 0.0) if positive else np.minimum(least, 0.0)
    reach = (NEGLIGIBLE_NATS + math.log(width)) / beta
    near = margin <= base + reach  # the least one wherever that is rounded to
    shift = _both_ways(np.abs(base) * -beta)

    def terms(distance: FloatArray, shift: FloatArray) -> FloatArray:
        """exp(-beta (r - base)), in the negative part less what does not depend on the step."""
        powers = _both_ways(distance * -beta)
        return powers / (1.0 + powers * shift) if positive else powers

    # Both add the terms of a rollout from the first step to the last, so that which one is
    # taken, by all rollouts of a block together, shows in no digit.
    if FEW * np.count_nonzero(near) <= near.size:
        places = np.flatnonzero(near)
        rollouts = places % count
        some = terms(margin.ravel()[places] - base[rollouts], shift[rollouts])
        sums = np.bincount(rollouts, weights=some, minlength=count)
        total = sums.astype(np.float64, copy=False)  # of no terms at all it makes whole numbers
    else:
        every = terms(margin - base, shift)
        np.copyto(every, 0.0, where=~near)
        # one column numpy would take for a row, and add in another order
        total = np.add.accumulate(every)[-1] if count == 1 else np.add.reduce(every, axis=0)
    if not positive:
        total = total + width * shift
    return (base - np.log(total) / beta)[None]


def _both_ways(exponents: FloatArray) -> FloatArray:
    """Exponentials, none below 1e-304 or above 1e304, in place."""
    np.clip(exponents, -LARGEST_EXPONENT, LARGEST_EXPONENT, out=exponents)
    return np.exp(exponents, out=exponents)
