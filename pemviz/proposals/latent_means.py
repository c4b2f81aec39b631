"""Means of latents as a proposal moves them, and their fit by weighted least squares.

Latents at the start get a constant mean each. Those of a step get, with a probability c, means
that are a polynomial of the state, else none (:class:`pemviz.latents.Latents`): c near 1 moves
every step a little, a small c few steps far. The logit of c is another such polynomial. Fitted by
expectation and maximisation (Dempster, Laird, Rubin 1977) with r the probability that noise was
moved, mu the means, w weights:

    r = c N(z; mu, 1) / (c N(z; mu, 1) + (1 - c) N(z; 0, 1))
    minimise sum w r (z - mu)^2 / 2 + ridge . beta^2 / 2
    minimise -sum w (r log c + (1 - r) log(1 - c)) + ridge . gamma^2 / 2, by a Newton step a round
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.latents import log_share_moved

LARGEST_MEAN = 8.0
ROUNDS = 8
LARGEST_STEP = 2.0
"""Of a coefficient of the choice in a round."""
LARGEST_LOGIT = 5.0
"""Of the share of steps whose noise is moved, and of that drawn from the model, as a defence."""


@dataclass(frozen=True)
class LatentDecisions:
    """The latents of N rollouts, as proposals see them.

    Attributes:
        start: ``[N, S]``.
        rollout: Of each step with noise that may be moved, ``[L]``, ascending.
        basis: Monomials of the state there, ``[L, B]``.
        noise: ``[L, M]``.
    """

    start: FloatArray
    rollout: IntArray
    basis: FloatArray
    noise: FloatArray

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return len(self.start)

    def of(self, rollouts: IntArray) -> "LatentDecisions":
        """Of the chosen rollouts, which are ascending."""
        number = np.full(self.count, -1)
        number[rollouts] = np.arange(rollouts.size)
        kept = number[self.rollout] >= 0
        return LatentDecisions(
            self.start[rollouts],
            number[self.rollout[kept]].astype(np.int64),
            self.basis[kept],
            self.noise[kept],
        )

    def joined(self, after: "LatentDecisions") -> "LatentDecisions":
        """These and those of more rollouts."""
        return LatentDecisions(
            np.concatenate([self.start, after.start]),
            np.concatenate([self.rollout, after.rollout + self.count]),
            np.concatenate([self.basis, after.basis]),
            np.concatenate([self.noise, after.noise]),
        )

    def by_rollout(self, values: FloatArray) -> FloatArray:
        """Sums over each rollout's steps, ``[N]`` of ``[L]``."""
        sums = np.bincount(self.rollout, weights=values, minlength=self.count)
        return sums.astype(np.float64)


@dataclass(frozen=True, eq=False)
class LatentMeans:
    """How a proposal moves latents.

    Attributes:
        start: Means at the start, ``[S]``.
        noise: Coefficients of the means of a step, ``[M, B]``.
        choice: Coefficients of the logit of how often a step's noise is moved, ``[B]``.
    """

    start: FloatArray
    noise: FloatArray
    choice: FloatArray

    def at(self, basis: FloatArray) -> FloatArray:
        """Means ``[n, M]`` of moved noise at states with monomials ``[n, B]``."""
        return noise_means(basis, self.noise)

    def logit(self, basis: FloatArray) -> FloatArray:
        """Of how often noise is moved at states with monomials ``[n, B]``, ``[n]``."""
        return choice_logit(basis, self.choice)

    def moved(self, latents: LatentDecisions) -> FloatArray:
        """Log of moved over unmoved density of each step's noise, ``[L]``."""
        mean = self.at(latents.basis)
        return np.sum(mean * (latents.noise - 0.5 * mean), axis=1)

    def log_ratio(self, latents: LatentDecisions) -> FloatArray:
        """Log q / p of all latents of each rollout, ``[N]``."""
        of_start = np.sum(self.start * (latents.start - 0.5 * self.start), axis=1)
        of_steps = log_share_moved(self.moved(latents), expit(self.logit(latents.basis)))
        return of_start + latents.by_rollout(of_steps)

    def arrays(self) -> Mapping[str, AnyArray]:
        """By name, as they are stored."""
        return {
            "start_mean": self.start,
            "noise_coefficients": self.noise,
            "noise_choice": self.choice,
        }


def noise_means(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Means ``[n, M]``; coefficients are ``[M, B]`` or, a row each, ``[n, M, B]``."""
    # einsum, unlike a library's matrix product, gives a row the same in any batch
    products = "nb,nmb->nm" if coefficients.ndim > 2 else "nb,mb->nm"
    return np.einsum(products, basis, coefficients).clip(-LARGEST_MEAN, LARGEST_MEAN)


def choice_logit(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Logits ``[n]``; coefficients are ``[B]`` or, a row each, ``[n, B]``."""
    products = "nb,nb->n" if coefficients.ndim > 1 else "nb,b->n"
    return np.einsum(products, basis, coefficients).clip(-LARGEST_LOGIT, LARGEST_LOGIT)


@dataclass(frozen=True)
class MeansFit:
    """Fitted means.

    Attributes:
        means: What was fitted.
        optimism: By how much each rollout's log likelihood would fall without it, ``[N]``: to first
            order, as :func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`.
    """

    means: LatentMeans
    optimism: FloatArray


def fit_means(latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray) -> MeansFit:
    """The means nearest to weighted rollouts' latents.

    From two beginnings, all steps moved or the farthest of each rollout alone, the better.

    Args:
        latents: Of N rollouts.
        weight: ``[N]``, not negative.
        ridge: Penalty of each coefficient, above 0, ``[B]``.
    """
    rollouts = np.flatnonzero(weight > 0.0)
    chosen, own = latents.of(rollouts), weight[rollouts]
    even = np.zeros(ridge.size)
    tried = [
        _rounds(_maximised(even, chosen, own, part, ridge), chosen, own, ridge)
        for part in (np.ones(chosen.rollout.size), _farthest(chosen))
    ]
    best = max(tried, key=lambda means: _penalised(means, chosen, own, ridge))
    optimism = np.zeros(weight.size)
    optimism[rollouts] = _leave_one_out(best, chosen, own, ridge)
    return MeansFit(best, optimism)


def next_round(
    means: LatentMeans,
    latents: LatentDecisions,
    weight: FloatArray,
    *,
    ridge: FloatArray,
) -> LatentMeans:
    """One round of expectation and maximisation; arguments as above, weights may be 0."""
    return _maximised(means.choice, latents, weight, _part(means, latents), ridge)


def scores(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """Derivatives of each rollout's log likelihood by the means, ``[N, S + M B]``."""
    of_noise = _noise_scores(means, latents)
    return np.hstack([latents.start - means.start, of_noise.reshape(latents.count, -1)])


def information(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray
) -> FloatArray:
    """Their variance over the means' own draws, ``[S + M B, S + M B]``, with the ridge."""
    at_start, moved = means.start.size, len(means.noise)
    by_step = expit(means.logit(latents.basis)) * weight[latents.rollout]
    one = (latents.basis * by_step[:, None]).T @ latents.basis + np.diag(ridge)
    found = np.zeros((at_start + moved * ridge.size,) * 2)
    found[:at_start, :at_start] = np.eye(at_start) * (weight.sum() + ridge[0])
    found[at_start:, at_start:] = np.kron(np.eye(moved), one)
    return found


def _rounds(
    means: LatentMeans,
    latents: LatentDecisions,
    weight: FloatArray,
    ridge: FloatArray,
) -> LatentMeans:
    for _ in range(ROUNDS if means.noise.size else 0):
        means = next_round(means, latents, weight, ridge=ridge)
    return means


def _part(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """How likely it is that each step's noise was moved, ``[L]``."""
    return expit(means.moved(latents) + means.logit(latents.basis))


def _maximised(
    choice: FloatArray,
    latents: LatentDecisions,
    weight: FloatArray,
    part: FloatArray,
    ridge: FloatArray,
) -> LatentMeans:
    """Means for given probabilities ``part [L]`` that noise was moved; ``choice`` as it was."""
    basis, by_step = latents.basis, weight[latents.rollout]
    moved = basis * (by_step * part)[:, None]
    coefficients = np.linalg.solve(moved.T @ basis + np.diag(ridge), moved.T @ latents.noise)
    share = expit(choice_logit(basis, choice))
    curvature = (basis * (by_step * share * (1.0 - share))[:, None]).T @ basis + np.diag(ridge)
    gradient = basis.T @ (by_step * (part - share)) - ridge * choice
    return LatentMeans(
        start=weight @ latents.start / (float(weight.sum()) + ridge[0]),
        noise=np.asarray(coefficients.T, dtype=np.float64),
        choice=choice + np.linalg.solve(curvature, gradient).clip(-LARGEST_STEP, LARGEST_STEP),
    )


def _farthest(latents: LatentDecisions) -> FloatArray:
    """1 at the step of each rollout whose noise is farthest from 0, else 0, ``[L]``."""
    distance = np.sum(latents.noise**2, axis=1)
    largest = np.full(latents.count, -np.inf)
    np.maximum.at(largest, latents.rollout, distance)
    return (distance >= largest[latents.rollout]).astype(np.float64)


def _penalised(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, ridge: FloatArray
) -> float:
    likelihood = float(weight @ means.log_ratio(latents))
    return likelihood - 0.5 * float(np.sum(ridge * (means.noise**2).sum(axis=0)))


def _noise_scores(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """By the coefficients, ``[N, M, B]``."""
    residual = _part(means, latents)[:, None] * (latents.noise - means.at(latents.basis))
    columns = [
        [latents.by_rollout(of_latent * monomial) for monomial in latents.basis.T]
        for of_latent in residual.T
    ]
    shape = (len(means.noise), latents.basis.shape[1], latents.count)
    return np.moveaxis(np.array(columns).reshape(shape), -1, 0)


def _leave_one_out(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, ridge: FloatArray
) -> FloatArray:
    residual = latents.start - means.start
    found = np.sum(residual**2, axis=1) / (float(weight.sum()) + ridge[0])
    if means.noise.size:
        by_step = _part(means, latents) * weight[latents.rollout]
        curvature = (latents.basis * by_step[:, None]).T @ latents.basis + np.diag(ridge)
        score = _noise_scores(means, latents)
        solved = np.linalg.solve(curvature, score.reshape(-1, ridge.size).T).T
        found = found + np.sum(score * solved.reshape(score.shape), axis=(1, 2))
    return weight * found


def unmoved(*, start: int, noise: int, basis: int) -> LatentMeans:
    """Means of 0."""
    return LatentMeans(np.zeros(start), np.zeros((noise, basis)), np.zeros(basis))
