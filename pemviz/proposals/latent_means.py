"""Means of latents as a proposal moves them, and their fit by weighted least squares.

Latents at the start get a constant mean each. Those of a step get, with a probability c, means
that are a polynomial of the state, else none (:class:`pemviz.latents.Latents`): c near 1 moves
every step a little, a small c few steps far. The logit of c is another such polynomial. Or one step
is moved and then no other (:mod:`pemviz.proposals.single_moves`). Fitted by expectation and
maximisation (Dempster, Laird, Rubin 1977) with r the probability that a step's noise was moved, a
that it could be, mu the means, w weights:

    minimise sum w r (z - mu)^2 / 2 + ridge . beta^2 / 2
    minimise -sum w (r log c + (a - r) log(1 - c)) + ridge . gamma^2 / 2, by a Newton step a round

Where each step is moved by itself, a = 1 and

    r = c N(z; mu, 1) / (c N(z; mu, 1) + (1 - c) N(z; 0, 1))
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, FloatArray
from pemviz.latents import log_moved, log_share_moved, log_wide_and_narrow
from pemviz.proposals.latent_decisions import LatentDecisions
from pemviz.proposals.single_moves import (
    log_ratio_of_one,
    posterior_of_one,
    share_of_one,
)
from pemviz.proposals.start_moves import StartMoves, fit_start, start_optimism

LARGEST_MEAN = 8.0
LEAST_SPREAD = 0.2
SPREAD_RIDGE = 0.5
"""So many moved steps of spread 1 count beside those that a spread is fitted to."""
ROUNDS = 8
LARGEST_STEP = 2.0
"""Of a coefficient of the choice in a round."""
LARGEST_LOGIT = 5.0
"""Of the share of steps whose noise is moved, and of that drawn from the model, as a defence."""


@dataclass(frozen=True, eq=False)
class LatentMeans:
    """How a proposal moves latents.

    Attributes:
        start: Means and spreads at the start.
        noise: Coefficients of the means of a step, ``[M, B]``.
        choice: Coefficients of the logit of how often a step's noise is moved, ``[B]``.
        sd: Spreads of half of the noise that is moved, ``[M]``.
        once: Whether a rollout's noise is moved at one step at most.
    """

    start: StartMoves
    noise: FloatArray
    choice: FloatArray
    sd: FloatArray
    once: bool = False

    def at(self, basis: FloatArray) -> FloatArray:
        """Means ``[n, M]`` of moved noise at states with monomials ``[n, B]``."""
        return noise_means(basis, self.noise)

    def logit(self, latents: LatentDecisions) -> FloatArray:
        """Of how often each step's noise is moved, ``[L]``; with ``once`` given none before."""
        logit = choice_logit(latents.basis, self.choice)
        return logit + latents.even if self.once else logit

    def moved(self, latents: LatentDecisions) -> FloatArray:
        """Log of moved over unmoved density of each step's noise, ``[L]``."""
        return log_moved(latents.noise, self.at(latents.basis), self.sd)

    def log_ratio(self, latents: LatentDecisions) -> FloatArray:
        """Log q / p of all latents of each rollout, ``[N]``."""
        of_start = self.start.log_ratio(latents.start)
        moved, logit = self.moved(latents), self.logit(latents)
        if self.once:
            return of_start + log_ratio_of_one(moved, logit, latents.steps)
        return of_start + latents.by_rollout(log_share_moved(moved, expit(logit)))

    def arrays(self) -> Mapping[str, AnyArray]:
        """By name, as they are stored."""
        return {
            "start_mean": self.start.mean,
            "start_sd": self.start.sd,
            "noise_coefficients": self.noise,
            "noise_choice": self.choice,
            "noise_sd": self.sd,
            "noise_once": np.array(self.once),
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
        optimism: By how much the log likelihood of each rollout's start would fall without it,
            ``[N]`` [nats].
        noise_optimism: Of its noise: to first order, as
            :func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`.
    """

    means: LatentMeans
    optimism: FloatArray
    noise_optimism: FloatArray


def fit_means(latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray) -> MeansFit:
    """The means nearest to weighted rollouts' latents.

    From three beginnings, the best: all steps moved, or the farthest of each rollout, by itself or
    as the one that may be.

    Args:
        latents: Of N rollouts.
        weight: ``[N]``, not negative.
        ridge: Penalty of each coefficient, above 0, ``[B]``.
    """
    rollouts = np.flatnonzero(weight > 0.0)
    chosen, own = latents.of(rollouts), weight[rollouts]
    all_steps, farthest = np.ones(chosen.rollout.size), _farthest(chosen)
    none = unmoved(start=latents.start.shape[1], noise=latents.noise.shape[1], basis=ridge.size)
    tried = [
        _rounds(_maximised(like, chosen, own, parts, ridge), chosen, own, ridge)
        for like, parts in (
            (none, (all_steps, all_steps)),
            (none, (farthest, all_steps)),
            (replace(none, once=True), (farthest, chosen.steps.up_to(farthest))),
        )
    ]
    best = max(tried, key=lambda means: _penalised(means, chosen, own, ridge))
    at_start, of_noise = np.zeros(weight.size), np.zeros(weight.size)
    at_start[rollouts] = start_optimism(best.start, chosen.start, own, ridge=float(ridge[0]))
    of_noise[rollouts] = _leave_one_out(best, chosen, own, ridge)
    return MeansFit(best, at_start, of_noise)


def next_round(
    means: LatentMeans,
    latents: LatentDecisions,
    weight: FloatArray,
    *,
    ridge: FloatArray,
) -> LatentMeans:
    """One round of expectation and maximisation; arguments as above, weights may be 0."""
    return _maximised(means, latents, weight, _parts(means, latents), ridge)


def scores(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """Derivatives of each rollout's log likelihood by the means, ``[N, S + M B]``."""
    of_noise = _noise_scores(means, latents)
    return np.hstack([latents.start - means.start.mean, of_noise.reshape(latents.count, -1)])


def information(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray
) -> FloatArray:
    """Their variance over the means' own draws, ``[S + M B, S + M B]``, with the ridge."""
    at_start, moved = means.start.mean.size, len(means.noise)
    share = expit(means.logit(latents))
    if means.once:
        share = share_of_one(share, latents.steps)
    by_step = share * weight[latents.rollout]
    one = (latents.basis * by_step[:, None]).T @ latents.basis
    precision = np.diag(0.5 + 0.5 / means.sd**2)
    found = np.zeros((at_start + moved * ridge.size,) * 2)
    found[:at_start, :at_start] = np.eye(at_start) * (weight.sum() + ridge[0])
    found[at_start:, at_start:] = np.kron(precision, one) + np.kron(np.eye(moved), np.diag(ridge))
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


def _parts(means: LatentMeans, latents: LatentDecisions) -> tuple[FloatArray, FloatArray]:
    """How likely it is that each step's noise was moved, and that it could be, ``[L]`` each."""
    moved, logit = means.moved(latents), means.logit(latents)
    if means.once:
        return posterior_of_one(moved, logit, latents.steps)
    return expit(moved + logit), np.ones(logit.size)


def _maximised(
    before: LatentMeans,
    latents: LatentDecisions,
    weight: FloatArray,
    parts: tuple[FloatArray, FloatArray],
    ridge: FloatArray,
) -> LatentMeans:
    """Means for given probabilities ``[L]`` that noise was moved, and that it could be."""
    basis, by_step, (part, able) = latents.basis, weight[latents.rollout], parts
    moved = basis * (by_step * part)[:, None]
    solved = np.linalg.solve(moved.T @ basis + np.diag(ridge), moved.T @ latents.noise)
    coefficients = np.asarray(solved.T, dtype=np.float64)
    narrow = _narrow(before, latents)
    share, able = expit(before.logit(latents)), by_step * able
    curvature = (basis * (able * share * (1.0 - share))[:, None]).T @ basis + np.diag(ridge)
    gradient = basis.T @ (by_step * part - able * share) - ridge * before.choice
    change = np.linalg.solve(curvature, gradient).clip(-LARGEST_STEP, LARGEST_STEP)
    return LatentMeans(
        start=fit_start(latents.start, weight, ridge=float(ridge[0])),
        noise=coefficients,
        choice=before.choice + change,
        sd=_spread(latents, noise_means(basis, coefficients), by_step * part * narrow),
        once=before.once,
    )


def _narrow(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """How likely it is that noise, if it was moved, is of the half with the spreads, ``[L]``."""
    wide, narrow = log_wide_and_narrow(latents.noise, means.at(latents.basis), means.sd)
    return expit(narrow - wide)


def _spread(latents: LatentDecisions, mean: FloatArray, by_step: FloatArray) -> FloatArray:
    """Spreads ``[M]`` around means ``[L, M]``, for how much each step's noise says of them."""
    squares = by_step @ (latents.noise - mean) ** 2
    known = by_step.sum() + SPREAD_RIDGE
    return np.sqrt((squares + SPREAD_RIDGE) / known).clip(LEAST_SPREAD, 1.0)


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
    narrow = _narrow(means, latents)[:, None]
    residual = _residual(means, latents) * (1.0 - narrow + narrow / means.sd**2)
    return _by_coefficient(residual, latents)


def _residual(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """Of each step's noise from its mean if it was moved, as far as it was, ``[L, M]``."""
    return _parts(means, latents)[0][:, None] * (latents.noise - means.at(latents.basis))


def _by_coefficient(values: FloatArray, latents: LatentDecisions) -> FloatArray:
    """Sums over each rollout's steps of values ``[L, M]`` times monomials, ``[N, M, B]``."""
    columns = [
        [latents.by_rollout(of_latent * monomial) for monomial in latents.basis.T]
        for of_latent in values.T
    ]
    shape = (values.shape[1], latents.basis.shape[1], latents.count)
    return np.moveaxis(np.array(columns).reshape(shape), -1, 0)


def _leave_one_out(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, ridge: FloatArray
) -> FloatArray:
    """Each rollout's pull on what was fitted, times what that is to its noise, ``[N]`` [nats]."""
    if not means.noise.size:
        return np.zeros(weight.size)
    (part, able), by_step = _parts(means, latents), weight[latents.rollout]
    pull = _by_coefficient(_residual(means, latents), latents)
    curved = _curvature(latents.basis, by_step * part, ridge)
    solved = np.linalg.solve(curved, pull.reshape(-1, ridge.size).T).T.reshape(pull.shape)
    found = np.sum(_noise_scores(means, latents) * solved, axis=(1, 2))
    share = expit(means.logit(latents))
    choice = _by_coefficient((part - able * share)[:, None], latents)[:, 0]
    curved = _curvature(latents.basis, by_step * able * share * (1.0 - share), ridge)
    found = found + np.sum(choice * np.linalg.solve(curved, choice.T).T, axis=1)
    return weight * (found + _of_spreads(means, latents, part, by_step))


def _curvature(basis: FloatArray, by_step: FloatArray, ridge: FloatArray) -> FloatArray:
    return (basis * by_step[:, None]).T @ basis + np.diag(ridge)


def _of_spreads(
    means: LatentMeans, latents: LatentDecisions, part: FloatArray, by_step: FloatArray
) -> FloatArray:
    """The spreads' part in it, ``[N]``: by their logarithms, where they are free."""
    narrow = part * _narrow(means, latents)
    relative = ((latents.noise - means.at(latents.basis)) / means.sd) ** 2 - 1.0
    scores = np.stack([latents.by_rollout(narrow * one) for one in relative.T], axis=1)
    free = (means.sd > LEAST_SPREAD) & (means.sd < 1.0)
    return np.sum(scores**2 * free, axis=1) / (2.0 * (by_step @ narrow + SPREAD_RIDGE))


def unmoved(*, start: int, noise: int, basis: int) -> LatentMeans:
    """Means of 0."""
    return LatentMeans(
        StartMoves.none(start), np.zeros((noise, basis)), np.zeros(basis), np.ones(noise)
    )
