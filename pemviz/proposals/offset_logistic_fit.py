"""Weighted logistic regression with an offset and a ridge: convex, a few Newton steps."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray, softplus

NEWTON_STEPS = 40
SHORTEST_STEP = 1e-9
SUFFICIENT_DECREASE = 1e-4
GOOD_ENOUGH = 1e-4
STEADY = 1e-4
"""By how much weights may change, relative to the largest, and a fit stay good enough unasked."""
BY_OUTCOME = ("logit", "miss", "cross_entropy")
"""What a fit knows of each outcome by itself, whatever the weights."""
LARGEST_LEVERAGE = 0.8
"""Larger ones count as this: what a linear model suggests grows without bound towards 1."""


@dataclass(frozen=True)
class WeightedOutcomes:
    """Decisions to learn from.

    Attributes:
        basis: ``[M, B]``.
        missed: ``[M]``.
        offset: The error model's logit of a miss, ``[M]``.
        weight: ``[M]``, not negative.
    """

    basis: FloatArray
    missed: BoolArray
    offset: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class LogisticFit:
    """A model of outcomes, fitted to them or on the way there.

    What follows from the coefficients is computed when first needed: second derivatives take
    most of a fit's time, and many a fit's last ones nobody asks for.

    Attributes:
        coefficients: ``[B]``.
        outcomes: What is learned from.
        ridge: Penalty of each coefficient, ``[B]``.
    """

    coefficients: FloatArray
    outcomes: WeightedOutcomes = field(repr=False)
    ridge: FloatArray = field(repr=False)

    @property
    def loss(self) -> float:
        """Mean loss, penalty included [nats a decision]."""
        total = float(self.outcomes.weight.sum())
        return self.summed_loss / max(total, np.finfo(np.float64).tiny)

    @cached_property
    def logit(self) -> FloatArray:
        """Of each miss, ``[M]``."""
        return self.outcomes.offset + self.outcomes.basis @ self.coefficients

    @cached_property
    def miss(self) -> FloatArray:
        """Probability of each miss, ``[M]``."""
        return cast(FloatArray, expit(self.logit))

    @cached_property
    def cross_entropy(self) -> FloatArray:
        """Minus the log likelihood of each outcome, ``[M]`` [nats]."""
        return softplus(np.where(self.outcomes.missed, -self.logit, self.logit))

    @cached_property
    def summed_loss(self) -> float:
        """Weighted cross-entropy plus ``ridge . coefficients^2 / 2`` [nats]."""
        entropy = self.outcomes.weight @ self.cross_entropy
        return float(entropy + 0.5 * self.ridge @ self.coefficients**2)

    @cached_property
    def curvature(self) -> FloatArray:
        """Second derivatives of the summed loss, ``[B, B]``."""
        outcomes, miss = self.outcomes, self.miss
        scaled = outcomes.basis * np.sqrt(outcomes.weight * miss * (1.0 - miss))[:, None]
        # a matrix by its own transpose: half the work
        return scaled.T @ scaled + np.diag(self.ridge)

    def descent(self) -> FloatArray:
        """The summed loss's derivatives, downwards, ``[B]``."""
        outcomes = self.outcomes
        gradient = outcomes.basis.T @ (outcomes.weight * (outcomes.missed - self.miss))
        return gradient - self.ridge * self.coefficients

    def improved(self) -> "LogisticFit":
        """The fit after one of Newton's steps; itself if that would make little difference."""
        direction, decrease = self._step
        if decrease < GOOD_ENOUGH:
            return self
        return _lower(self, direction, decrease) or self

    @cached_property
    def _step(self) -> tuple[FloatArray, float]:
        """Newton's step ``[B]``, and by how much it promises to lower the summed loss, twice."""
        gradient = self.descent()
        direction = cast(FloatArray, np.linalg.solve(self.curvature, gradient))
        return direction, float(gradient @ direction)

    def adapted(self, weight: FloatArray) -> "LogisticFit":
        """The fit after one of Newton's steps for outcomes of other weights ``[M]``.

        Itself, where it was found good enough for weights that hardly differ.
        """
        known = vars(self).get("_step")
        if known is not None and known[1] < GOOD_ENOUGH:
            before = self.outcomes.weight
            if np.abs(weight - before).max(initial=0.0) <= STEADY * before.max(initial=0.0):
                return self
        return self.reweighted(weight).improved()

    def reweighted(self, weight: FloatArray) -> "LogisticFit":
        """The same coefficients for outcomes of other weights ``[M]``."""
        changed = replace(self, outcomes=replace(self.outcomes, weight=weight))
        known = {name: vars(self)[name] for name in BY_OUTCOME if name in vars(self)}
        vars(changed).update(known)
        return changed


def fit_offset_logistic(
    outcomes: WeightedOutcomes, *, ridge: FloatArray, start: FloatArray
) -> LogisticFit:
    """Minimise the weighted cross-entropy plus ``ridge . coefficients^2 / 2``.

    Newton's method with step halving (McCullagh & Nelder 1989, section 4.4).

    Args:
        outcomes: What is learned from.
        ridge: Penalty of each coefficient, above 0, ``[B]``.
        start: Coefficients to start from, ``[B]``.
    """
    fit = LogisticFit(start.copy(), outcomes, ridge)
    for _ in range(NEWTON_STEPS):
        better = fit.improved()
        if better is fit:
            break
        fit = better
    return fit


def _lower(fit: LogisticFit, direction: FloatArray, decrease: float) -> LogisticFit | None:
    """Along ``direction [B]`` to where the loss is lower by enough; ``None`` if nowhere lower."""
    length, tried = 1.0, fit
    while length > SHORTEST_STEP:
        tried = replace(fit, coefficients=fit.coefficients + length * direction)
        if tried.summed_loss <= fit.summed_loss - SUFFICIENT_DECREASE * length * decrease:
            break
        length /= 2.0
    return None if tried.summed_loss >= fit.summed_loss else tried


def group_sums(values: FloatArray, group: IntArray, *, count: int) -> FloatArray:
    """Sums ``[count, B]`` over each group of ``values [M, B]``, whose groups ``[M]`` ascend."""
    first = np.flatnonzero(np.diff(group, prepend=-1))
    sums = np.zeros((count, values.shape[1]))
    sums[group[first]] = np.add.reduceat(values, first, axis=0)
    return sums


def leave_one_out_loss(
    fit: LogisticFit, *, group: IntArray, count: int, first_order: bool = True
) -> FloatArray:
    """By how much each group's log likelihood falls if the model is fitted without it.

    To first order, weight * score' curvature^-1 score (infinitesimal jackknife: Cook &
    Weisberg 1982). A model likes what it was fitted to; importance weights must not.

    Args:
        fit: The model.
        group: Which of ``count`` groups each of its outcomes belongs to, ``[M]``, ascending;
            weights are equal within a group.
        count: Number of groups.
        first_order: Else times (1 - h / 2) / (1 - h)^2 with h the group's leverage in the direction
            in which it pulls: what the square of a residual e grows by if a linear model is fitted
            without it, e becoming e / (1 - h).

    Returns:
        ``[count]`` [nats]; 0 for groups that were not learned from.
    """
    outcomes = fit.outcomes
    residual = outcomes.missed - fit.miss
    score = group_sums(outcomes.basis * residual[:, None], group, count=count)
    weight = np.zeros(count)
    weight[group] = outcomes.weight
    pull = np.linalg.solve(fit.curvature, score.T).T
    found = weight * np.einsum("nb,nb->n", score, pull)
    if first_order:
        return found
    along = np.einsum("mb,mb->m", outcomes.basis, pull[group]) ** 2 * fit.miss * (1.0 - fit.miss)
    moved = weight**2 * np.bincount(group, weights=along, minlength=count)
    leverage = np.divide(moved, found, out=np.zeros(count), where=found > 0.0)
    leverage = leverage.clip(0.0, LARGEST_LEVERAGE)
    return found * (1.0 - 0.5 * leverage) / (1.0 - leverage) ** 2
