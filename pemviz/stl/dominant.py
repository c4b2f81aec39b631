"""The soft minimum of predicates over time, from the steps near the least margin alone.

For a predicate's smooth cumulative value r, exp(-beta r) is 1 / (1 + exp(beta margin)) in the
positive part and 1 + exp(-beta margin) in the negative one, so that no logarithm is needed per
step. Steps whose margin lies further above the least one than `DominantSteps.reach` together make
up less than half of a double's last digit of the sum, and are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray

LARGEST_EXPONENT = 700.0
"""Exponentials beyond it (below minus it) leave double precision, at ten times the cost."""

NEGLIGIBLE_NATS = 38.0
"""Terms that all together are smaller by a factor of exp of this do not count."""

FEW = 4
"""Where at most one value in so many counts, they are picked out one by one."""


@dataclass(frozen=True)
class DominantSteps:
    """How the soft minimum over ``width`` steps is put together, for arrays ``[n]`` of rollouts.

    Attributes:
        beta: Sharpness, per unit of the margin.
        positive: Which part.
        width: Steps.
    """

    beta: float
    positive: bool
    width: int

    def base(self, least: FloatArray) -> FloatArray:
        """What margins are counted from, so that no exponential leaves double precision."""
        return np.maximum(least, 0.0) if self.positive else np.minimum(least, 0.0)

    @property
    def reach(self) -> float:
        """How far above the base steps count."""
        return (NEGLIGIBLE_NATS + math.log(self.width)) / self.beta

    def shift(self, base: FloatArray) -> FloatArray:
        """exp(-beta abs(base))."""
        return exponentials(np.abs(base) * -self.beta)

    def result(self, base: FloatArray, total: FloatArray) -> FloatArray:
        """The soft minimum, from the sum of `_terms` over steps."""
        if not self.positive:
            total = total + self.width * self.shift(base)
        return base - np.log(total) / self.beta

    def always(self, margin: FloatArray) -> FloatArray:
        """The soft minimum over all of ``margin [width, n]``, [1, n]."""
        base = self.base(margin.min(axis=0))
        near = margin <= base + self.reach  # the least one wherever that is rounded to
        if FEW * np.count_nonzero(near) <= near.size:
            total = self._few(margin, base, near)
        else:
            total = self._many(margin, base, near)
        return self.result(base, total)[None]

    # Both add the terms of a rollout from the first step to the last, so that which one is
    # taken, by all rollouts of a block together, shows in no digit.

    def _few(self, margin: FloatArray, base: FloatArray, near: BoolArray) -> FloatArray:
        places = np.flatnonzero(near)
        rollouts = places % margin.shape[1]
        distance = margin.ravel()[places] - base[rollouts]
        terms = self._terms(distance, self.shift(base)[rollouts])
        sums = np.bincount(rollouts, weights=terms, minlength=margin.shape[1])
        return sums.astype(np.float64, copy=False)  # of no terms at all it makes whole numbers

    def _many(self, margin: FloatArray, base: FloatArray, near: BoolArray) -> FloatArray:
        terms = self._terms(margin - base, self.shift(base))
        np.copyto(terms, 0.0, where=~near)
        if terms.shape[1] == 1:  # which numpy would take for a row, and add in another order
            return np.add.accumulate(terms[:, 0])[-1:]
        return np.add.reduce(terms, axis=0)

    def _terms(self, distance: FloatArray, shift: FloatArray) -> FloatArray:
        """exp(-beta (r - base)), in the negative part less what does not depend on the step."""
        powers = exponentials(distance * -self.beta)
        return powers / (1.0 + powers * shift) if self.positive else powers


def exponentials(exponents: FloatArray) -> FloatArray:
    """Exponentials, none below 1e-304 or above 1e304, in place."""
    np.clip(exponents, -LARGEST_EXPONENT, LARGEST_EXPONENT, out=exponents)
    return np.exp(exponents, out=exponents)
