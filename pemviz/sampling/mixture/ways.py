"""Several ways of failing: one proposal for each, by expectation and maximisation.

A proposal sees the state alone, and can make likely one chain of outcomes or another, not either
of two. Where the rollouts that it is fitted to scatter more than its own draws would, they are
split in two, and the mixture of proposals is fitted (Dempster, Laird, Rubin 1977), as long as
this raises their likelihood by more than its parameters cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.special import expit, logsumexp

from pemviz.arrays import FloatArray, IntArray
from pemviz.proposals.offset_logistic_fit import (
    WeightedOutcomes,
    fit_offset_logistic,
)

MOST_WAYS = 4
LEAST_SCATTER = 4.0
"""Variance of the fitted rollouts' scores along the worst direction; 1 if they were its draws."""
ROUNDS = 8
SAMPLE = 100
"""Rollouts by which ways are told apart: enough for a handful, and cheap."""


@dataclass(frozen=True)
class WeightedRollouts:
    """Rollouts to learn from.

    Attributes:
        outcomes: Their decisions; ``weight`` is that of the rollout.
        rollout: Which of E rollouts each decision belongs to, ``[M]``, ascending.
        weight: Of each rollout, ``[E]``.
    """

    outcomes: WeightedOutcomes
    rollout: IntArray
    weight: FloatArray

    @property
    def count(self) -> int:
        """Number of rollouts E."""
        return self.weight.size

    def weighted(self, weight: FloatArray) -> "WeightedRollouts":
        """The same rollouts with weights ``[E]``."""
        outcomes = self.outcomes
        changed = WeightedOutcomes(
            outcomes.basis, outcomes.missed, outcomes.offset, weight[self.rollout]
        )
        return WeightedRollouts(changed, self.rollout, weight)

    def resampled(self, count: int) -> "WeightedRollouts":
        """About ``count`` rollouts of equal weight, drawn systematically; all if they are fewer."""
        if self.count <= count:
            return self
        edges = np.cumsum(self.weight)
        places = (np.arange(count) + 0.5) / count * edges[-1]
        times = np.bincount(np.searchsorted(edges, places), minlength=self.count)
        kept = times[self.rollout] > 0
        number = np.cumsum(times > 0) - 1
        weight = times[times > 0] * (edges[-1] / count)
        rollout = number[self.rollout[kept]].astype(np.int64)
        outcomes = self.outcomes
        return WeightedRollouts(
            WeightedOutcomes(
                outcomes.basis[kept], outcomes.missed[kept], outcomes.offset[kept], weight[rollout]
            ),
            rollout,
            weight,
        )


@dataclass(frozen=True)
class Ways:
    """A mixture of C proposals.

    Attributes:
        coefficients: ``[C, B]``.
        share: ``[C]``, sums to 1.
    """

    coefficients: FloatArray
    share: FloatArray

    def log_joint(self, rollouts: WeightedRollouts) -> FloatArray:
        """Log of share times likelihood of each rollout under each proposal, ``[E, C]``."""
        columns = [_log_likelihood(rollouts, one) for one in self.coefficients]
        return np.stack(columns, axis=1) + np.log(self.share)

    def responsibilities(self, rollouts: WeightedRollouts) -> FloatArray:
        """How likely each rollout is to have come from each proposal, ``[E, C]``."""
        joint = self.log_joint(rollouts)
        return np.exp(joint - np.asarray(logsumexp(joint, axis=1))[:, None])


def ways_of(
    rollouts: WeightedRollouts,
    first: FloatArray,
    *,
    ridge: FloatArray,
    least_scatter: float = LEAST_SCATTER,
    price: float = 1.0,
) -> Ways:
    """As many proposals as the rollouts' likelihood asks for, the largest share first.

    Args:
        rollouts: What is learned from.
        first: Coefficients of the one proposal fitted to all of them, ``[B]``.
        ridge: Penalty of each coefficient, ``[B]``.
        least_scatter: Proposals whose rollouts scatter less are not split.
        price: Of another proposal, in units of the Bayesian information criterion.
    """
    ways = Ways(first[None, :], np.ones(1))
    if _scatter(rollouts, first, rollouts.weight, ridge)[0] < least_scatter:
        return ways
    few = rollouts.resampled(SAMPLE)
    while ways.share.size < MOST_WAYS:
        tried = _split(few, ways, ridge, least_scatter)
        if tried is None or _gain(few, ways, tried) <= price * _price(few, ridge):
            break
        ways = tried
    order = np.argsort(-ways.share, kind="stable")
    return Ways(ways.coefficients[order], ways.share[order])


def _price(rollouts: WeightedRollouts, ridge: FloatArray) -> float:
    """What one more proposal costs, by the Bayesian information criterion [nats]."""
    return 0.5 * ridge.size * float(np.log(max(rollouts.weight.sum(), np.e)))


def _gain(rollouts: WeightedRollouts, before: Ways, after: Ways) -> float:
    totals = [
        float(rollouts.weight @ np.asarray(logsumexp(ways.log_joint(rollouts), axis=1)))
        for ways in (before, after)
    ]
    return totals[1] - totals[0]


def _split(
    rollouts: WeightedRollouts, ways: Ways, ridge: FloatArray, least_scatter: float
) -> Ways | None:
    """One proposal more, fitted from a cut through the part that scatters most."""
    shares = ways.responsibilities(rollouts)
    scatter = [
        _scatter(rollouts, one, rollouts.weight * shares[:, index], ridge)
        for index, one in enumerate(ways.coefficients)
    ]
    worst = int(np.argmax([largest for largest, _ in scatter]))
    largest, place = scatter[worst]
    if largest < least_scatter or rollouts.count == 1:
        return None
    upper = place > _cut(place, rollouts.weight * shares[:, worst])
    shares = np.hstack([shares, (shares[:, worst] * upper)[:, None]])
    shares[upper, worst] = 0.0
    start = np.vstack([ways.coefficients, ways.coefficients[worst]])
    tried = ways
    for _ in range(ROUNDS):
        share = rollouts.weight @ shares
        if share.min() <= 0.0:
            return None
        start = np.stack(
            [
                fit_offset_logistic(
                    rollouts.weighted(rollouts.weight * shares[:, index]).outcomes,
                    ridge=ridge,
                    start=one,
                    steps=1,
                ).coefficients
                for index, one in enumerate(start)
            ]
        )
        tried = Ways(start, share / share.sum())
        shares = tried.responsibilities(rollouts)
    return tried


def _scatter(
    rollouts: WeightedRollouts, coefficients: FloatArray, weight: FloatArray, ridge: FloatArray
) -> tuple[float, FloatArray]:
    """Largest variance of the rollouts' scores relative to that of a model's draws.

    The score is the derivative of a rollout's log likelihood by the coefficients; its variance
    under the model is the Fisher information.

    Returns:
        The variance, and the scores along its direction ``[E]``.
    """
    outcomes = rollouts.outcomes
    miss = expit(outcomes.offset + outcomes.basis @ coefficients)
    residual = outcomes.missed - miss
    score = np.stack(
        [
            np.bincount(rollouts.rollout, weights=column * residual, minlength=rollouts.count)
            for column in outcomes.basis.T
        ],
        axis=1,
    )
    by_decision = weight[rollouts.rollout] * miss * (1.0 - miss)
    information = outcomes.basis.T @ (outcomes.basis * by_decision[:, None]) + np.diag(ridge)
    spread = score.T @ (score * weight[:, None])
    size = ridge.size
    variances, directions = eigh(spread, information, subset_by_index=[size - 1, size - 1])
    return float(variances[0]), score @ directions[:, 0]


def _cut(place: FloatArray, weight: FloatArray) -> float:
    """The value that splits weighted ``place [E]`` into two groups of least variance (Otsu)."""
    order = np.argsort(place, kind="stable")
    ordered, total = place[order], np.cumsum(weight[order])
    moment = np.cumsum(weight[order] * ordered)
    below, above = total[:-1], total[-1] - total[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (moment[:-1] / below - (moment[-1] - moment[:-1]) / above) ** 2
    best = int(np.nanargmax(np.where(np.isfinite(between), between, -1.0)))
    return float(0.5 * (ordered[best] + ordered[best + 1]))


def _log_likelihood(rollouts: WeightedRollouts, coefficients: FloatArray) -> FloatArray:
    outcomes = rollouts.outcomes
    logit = outcomes.offset + outcomes.basis @ coefficients
    against = np.where(outcomes.missed, -logit, logit)
    loss = np.logaddexp(0.0, against)
    return -np.bincount(rollouts.rollout, weights=loss, minlength=rollouts.count).astype(np.float64)


def shares_of_draws(share: FloatArray) -> Sequence[float]:
    """How rollouts are divided among ways ``[C]``: by share, none left with next to nothing."""
    least = 0.5 / share.size
    raised = np.maximum(share, least)
    return [float(one) for one in raised / raised.sum()]
