"""Several failure modes: one proposal for each, by expectation and maximisation.

A proposal sees the state alone, and can make likely one chain of outcomes or another, not either
of two. Where the rollouts that it is fitted to scatter more than its own draws would, they are
split in two, and the mixture of proposals is fitted (Dempster, Laird, Rubin 1977), as long as
this raises their likelihood by more than its parameters cost.

They are looked for among a bounded number of weighted rollouts in place of very many. Of N with
weights w_i that sum to W, those are taken on which the places (j + 1/2) W / M, j = 0 .. M - 1, fall
when the weights are laid end to end (systematic resampling: Kitagawa 1996). Each that is taken
counts W / M for every place on it: a weighted sum over the rollouts changes by its spread over
sqrt(M) at most, and by less where neighbours are equal.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, eigh
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray, log_sum_exp, times_sampled
from pemviz.proposals.latent_moves import LatentDecisions, LatentMeans
from pemviz.proposals.latent_moves_fit import information, next_round, scores
from pemviz.proposals.offset_logistic_fit import LogisticFit, WeightedOutcomes, group_sums

MOST_MODES = 4
LEAST_SCATTER = 4.0
"""Variance of the fitted rollouts' scores along the worst direction; 1 if they were its draws."""
ROUNDS = 8
SAMPLE = 100
"""Rollouts by which failure modes are told apart: enough for a handful, and cheap."""
Ridges = tuple[FloatArray, FloatArray]
"""Penalties of the coefficients, ``[B]``, and of those of the means of noise, ``[B']``."""


@dataclass(frozen=True)
class WeightedRollouts:
    """Rollouts to learn from.

    Attributes:
        outcomes: Their decisions; ``weight`` is that of the rollout.
        rollout: Which of E rollouts each decision belongs to, ``[M]``, ascending.
        weight: Of each rollout, ``[E]``.
        latents: Of each, where there are any.
    """

    outcomes: WeightedOutcomes
    rollout: IntArray
    weight: FloatArray
    latents: LatentDecisions | None = None

    @property
    def count(self) -> int:
        """Number of rollouts E."""
        return self.weight.size

    def resampled(self, count: int) -> "WeightedRollouts":
        """About ``count`` rollouts of equal weight, drawn systematically; all if they are fewer."""
        if self.count <= count:
            return self
        times = times_sampled(self.weight, count)
        kept = times[self.rollout] > 0
        number = np.cumsum(times > 0) - 1
        weight = times[times > 0] * (np.cumsum(self.weight)[-1] / count)
        rollout = number[self.rollout[kept]].astype(np.int64)
        outcomes = self.outcomes
        return WeightedRollouts(
            WeightedOutcomes(
                outcomes.basis[kept], outcomes.missed[kept], outcomes.offset[kept], weight[rollout]
            ),
            rollout,
            weight,
            None if self.latents is None else self.latents.of(np.flatnonzero(times > 0)),
        )


@dataclass(frozen=True)
class FailureModes:
    """A mixture of C proposals.

    Attributes:
        coefficients: ``[C, B]``.
        share: ``[C]``, sums to 1.
        means: How each moves latents; ``None`` where there are none.
    """

    coefficients: FloatArray
    share: FloatArray
    means: tuple[LatentMeans | None, ...]

    @property
    def each(self) -> Sequence[tuple[FloatArray, LatentMeans | None]]:
        """Coefficients and means of each proposal."""
        return list(zip(self.coefficients, self.means, strict=True))

    def log_joint(
        self, rollouts: WeightedRollouts, cross_entropies: Sequence[FloatArray] | None = None
    ) -> FloatArray:
        """Log of share times likelihood of each of E rollouts under each proposal, ``[E, C]``.

        ``cross_entropies`` are those of their decisions under each, ``[M]``, where they are known.
        """
        known = cross_entropies or [
            LogisticFit(one, rollouts.outcomes, np.zeros_like(one)).cross_entropy
            for one in self.coefficients
        ]
        columns: list[FloatArray] = []
        for entropy, means in zip(known, self.means, strict=True):
            found = -np.bincount(rollouts.rollout, weights=entropy, minlength=rollouts.count)
            if means is not None and rollouts.latents is not None:
                found = found + means.log_ratio(rollouts.latents)
            columns.append(found.astype(np.float64))
        return np.stack(columns, axis=1) + np.log(self.share)

    def responsibilities(
        self, rollouts: WeightedRollouts, cross_entropies: Sequence[FloatArray] | None = None
    ) -> FloatArray:
        """How likely each rollout is to have come from each proposal, ``[E, C]``."""
        joint = self.log_joint(rollouts, cross_entropies)
        return np.exp(joint - np.asarray(log_sum_exp(joint, axis=1))[:, None])


def failure_modes_of(
    rollouts: WeightedRollouts,
    first: FloatArray,
    *,
    ridge: FloatArray,
    means: LatentMeans | None = None,
    noise_ridge: FloatArray | None = None,
    least_scatter: float = LEAST_SCATTER,
    price: float = 1.0,
) -> FailureModes:
    """As many proposals as the rollouts' likelihood asks for, the largest share first.

    Args:
        rollouts: What is learned from.
        first: Coefficients of the one proposal fitted to all of them, ``[B]``.
        ridge: Penalty of each coefficient, ``[B]``.
        means: How that proposal moves latents.
        noise_ridge: Penalty of the coefficients of their means, ``[B']``.
        least_scatter: Proposals whose rollouts scatter less are not split.
        price: Of another proposal, in units of the Bayesian information criterion.
    """
    modes = FailureModes(first[None, :], np.ones(1), (means,))
    ridges = ridge, np.empty(0) if noise_ridge is None else noise_ridge
    if _scatter(rollouts, *modes.each[0], rollouts.weight, ridges)[0] < least_scatter:
        return modes
    few, size = rollouts.resampled(SAMPLE), ridge.size
    if few.latents is not None:
        size += few.latents.start.shape[1] + few.latents.noise.shape[1] * ridges[1].size
    price *= 0.5 * size * float(np.log(max(few.weight.sum(), np.e)))

    def likelihood(modes: FailureModes) -> float:
        return float(few.weight @ np.asarray(log_sum_exp(modes.log_joint(few), axis=1)))

    while modes.share.size < MOST_MODES:
        tried = _split(few, modes, ridges, least_scatter)
        if tried is None or likelihood(tried) - likelihood(modes) <= price:
            break
        modes = tried
    order = np.argsort(-modes.share, kind="stable")
    ordered = tuple(modes.means[place] for place in order)
    return FailureModes(modes.coefficients[order], modes.share[order], ordered)


def _split(
    rollouts: WeightedRollouts, modes: FailureModes, ridges: Ridges, least_scatter: float
) -> FailureModes | None:
    """One proposal more, fitted from a cut through the part that scatters most."""
    shares = modes.responsibilities(rollouts)
    scatter = [
        _scatter(rollouts, *one, rollouts.weight * shares[:, index], ridges)
        for index, one in enumerate(modes.each)
    ]
    worst = int(np.argmax([largest for largest, _ in scatter]))
    largest, place = scatter[worst]
    if largest < least_scatter or rollouts.count == 1:
        return None
    upper = place > _cut(place, rollouts.weight * shares[:, worst])
    shares = np.hstack([shares, (shares[:, worst] * upper)[:, None]])
    shares[upper, worst] = 0.0
    start = (*modes.coefficients, modes.coefficients[worst])
    fits = [LogisticFit(one, rollouts.outcomes, ridges[0]) for one in start]
    means, tried = (*modes.means, modes.means[worst]), modes
    for _ in range(ROUNDS):
        weights = (rollouts.weight[:, None] * shares).T
        share = weights.sum(axis=1)
        if share.min() <= 0.0:
            return None
        fits = [
            fit.adapted(weight[rollouts.rollout]) for fit, weight in zip(fits, weights, strict=True)
        ]
        if rollouts.latents is not None:
            means = tuple(
                None if one is None else next_round(one, rollouts.latents, weight, ridge=ridges[1])
                for one, weight in zip(means, weights, strict=True)
            )
        tried = FailureModes(np.stack([f.coefficients for f in fits]), share / share.sum(), means)
        shares = tried.responsibilities(rollouts, [fit.cross_entropy for fit in fits])
    return tried


def _scatter(
    rollouts: WeightedRollouts,
    coefficients: FloatArray,
    means: LatentMeans | None,
    weight: FloatArray,
    ridges: Ridges,
) -> tuple[float, FloatArray]:
    """Largest variance of the rollouts' scores relative to that of a model's draws.

    The score is the derivative of a rollout's log likelihood by the coefficients, and by the means
    of latents; its variance under the model is the Fisher information.

    Returns:
        The variance, and the scores along its direction ``[E]``.
    """
    outcomes = rollouts.outcomes
    miss = expit(outcomes.offset + outcomes.basis @ coefficients)
    residual = outcomes.missed - miss
    score = group_sums(outcomes.basis * residual[:, None], rollouts.rollout, count=rollouts.count)
    by_decision = weight[rollouts.rollout] * miss * (1.0 - miss)
    scaled = outcomes.basis * np.sqrt(by_decision)[:, None]
    known = scaled.T @ scaled + np.diag(ridges[0])
    if means is not None and rollouts.latents is not None:
        score = np.hstack([score, scores(means, rollouts.latents)])
        of_means = information(means, rollouts.latents, weight, ridge=ridges[1])
        known = np.asarray(block_diag(known, of_means))
    spread = score.T @ (score * weight[:, None])
    last = score.shape[1] - 1
    variances, directions = eigh(spread, known, subset_by_index=[last, last])
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


def shares_of_rollouts(share: FloatArray) -> Sequence[float]:
    """How rollouts are divided among ways ``[C]``: by share, none left with next to nothing."""
    least = 0.5 / share.size
    raised = np.maximum(share, least)
    return [float(one) for one in raised / raised.sum()]
