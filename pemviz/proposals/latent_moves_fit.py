"""Fits of how a proposal moves latents, by expectation and maximisation.

Moves of a step's noise (Dempster, Laird, Rubin 1977), with r the probability that it was moved, a
that it could be, mu the means, w weights:

    minimise sum w r (z - mu)^2 / 2 + ridge . beta^2 / 2
    minimise -sum w (r log c + (a - r) log(1 - c)) + ridge . gamma^2 / 2, by a Newton step a round

Where each step is moved by itself, a = 1 and

    r = c N(z; mu, 1) / (c N(z; mu, 1) + (1 - c) N(z; 0, 1))

Narrow noise has means and a share of its own where that makes rollouts likelier that were left out
of the fit; its part of what was moved is found likewise.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray, at_most
from pemviz.latents import log_wide_and_narrow
from pemviz.proposals.latent_moves import (
    LatentDecisions,
    LatentMeans,
    choice_logit,
    log_joint,
    narrow_moves,
    noise_means,
)
from pemviz.proposals.start_moves import LEAST_SPREAD, fit_start, start_optimism

SPREAD_RIDGE = 0.5
"""So many moved steps of spread 1 count beside those that a spread is fitted to."""
ROUNDS, ROUNDS_APART, LAST_ROUNDS = 8, 40, 3
FEW = 300
"""Rollouts that beginnings are followed with at most; the last rounds are with all."""
FAR = 2.0
"""Standard deviations of a single number, from which on noise counts as far at first."""
LEAST_GAIN = 0.2
"""By so much likelier rollouts that were left out must be where narrow noise is apart [nats]."""
LARGEST_STEP = 2.0
"""Of a coefficient of the choice in a round."""


def fit_means(
    latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray, independent: float = 1.0
) -> tuple[LatentMeans, FloatArray, FloatArray]:
    """The means nearest to weighted rollouts' latents.

    From three beginnings, the best: all steps moved, or the farthest of each rollout, by itself or
    as the one that may be. Narrow noise is apart where that is clearly better.

    Args:
        latents: Of N rollouts.
        weight: ``[N]``, not negative.
        ridge: Penalty of each coefficient, above 0, ``[B]``.
        independent: As how large a share of the rollouts so many independent ones would tell as
            much of starts, above 0, at most 1.

    Returns:
        The means; by how much the log likelihood of each rollout's start would fall without it,
        ``[N]`` [nats]; and of its noise: to first order, as
        :func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`.
    """
    rollouts = np.flatnonzero(weight > 0.0)
    fitting = _NoiseFit(latents.of(rollouts), weight[rollouts], ridge)
    start, own = fitting.latents.start, fitting.weight
    best = LatentMeans.unmoved(start=start.shape[1], noise=latents.noise.shape[1], basis=ridge.size)
    least = float(ridge[0])
    best = replace(best, start=fit_start(start, own, ridge=least, independent=independent))
    at_start, of_noise = np.zeros(weight.size), np.zeros(weight.size)
    at_start[rollouts] = start_optimism(
        best.start, start, own, ridge=least, independent=independent
    )
    if best.noise.size:
        few = fitting.of_few()
        best = _best_of_beginnings(best, few)
        best = best if best.once else _apart_if_better(best, few)
        best = best if few is fitting else fitting.after(LAST_ROUNDS, best)
        of_noise[rollouts] = fitting.pull(best)
    return best, at_start, of_noise


def _best_of_beginnings(none: LatentMeans, fitting: "_NoiseFit") -> LatentMeans:
    """From all steps moved, or the farthest of each rollout, by itself or as the one there is."""
    latents = fitting.latents
    distance = np.sum(latents.noise**2, axis=1)
    largest = np.full(latents.count, -np.inf)
    np.maximum.at(largest, latents.rollout, distance)
    farthest = (distance >= largest[latents.rollout]).astype(np.float64)
    up_to_farthest = (latents.before(farthest) == 0.0).astype(np.float64)
    all_steps = np.ones(distance.size)
    tried = [
        fitting.after(ROUNDS, fitting.maximised(means, parts))
        for means, parts in (
            (none, (all_steps, all_steps)),
            (none, (farthest, all_steps)),
            (replace(none, once=True), (farthest, up_to_farthest)),
        )
    ]

    def penalised_likelihood(means: LatentMeans) -> float:
        likelihood = float(fitting.weight @ means.log_ratio(latents))
        return likelihood - 0.5 * float(np.sum(fitting.ridge * (means.noise**2).sum(axis=0)))

    return max(tried, key=penalised_likelihood)


def _apart_if_better(together: LatentMeans, fitting: "_NoiseFit") -> LatentMeans:
    """With narrow noise apart from the other, where that is clearly better.

    What is far is narrow at first, and half of the rest is moved.
    """
    noise = fitting.latents.noise
    far = np.sum(noise**2, axis=1) > FAR**2 * noise.shape[1]
    none = np.zeros((noise.shape[1] + 1, fitting.ridge.size))
    apart = replace(together, choice=none[-1], sd=np.ones(noise.shape[1]), narrow=none)
    parts = np.where(far, 1.0, 0.5), np.ones(far.size)
    apart = fitting.maximised(apart, parts, narrow=far.astype(np.float64))
    least = fitting.left_out(together) + LEAST_GAIN * float(fitting.weight.sum())
    for rounds in (ROUNDS, ROUNDS_APART):  # many only where few promise something
        apart = fitting.after(rounds, apart)
        if fitting.left_out(apart) < least:
            return together
    return apart


def next_round(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray
) -> LatentMeans:
    """One round of expectation and maximisation; arguments as above, weights may be 0."""
    found = _NoiseFit(latents, weight, ridge).after(1, means)
    return replace(found, start=fit_start(latents.start, weight, ridge=float(ridge[0])))


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
    if means.once:  # of draws, given none before
        share = share * np.exp(latents.before(np.log1p(-share)))
    by_step = share * weight[latents.rollout]
    one = (latents.basis * by_step[:, None]).T @ latents.basis
    narrow = by_step * expit(narrow_moves(latents.basis, means.narrow_noise)[1])
    average = float(narrow.sum()) / max(float(by_step.sum()), np.finfo(float).tiny)
    precision = 1.0 - average + average / means.sd**2
    found = np.zeros((at_start + moved * ridge.size,) * 2)
    found[:at_start, :at_start] = np.eye(at_start) * (weight.sum() + ridge[0])
    found[at_start:, at_start:] = np.kron(np.diag(precision), one)
    found[at_start:, at_start:] += np.kron(np.eye(moved), np.diag(ridge))
    return found


def _parts(means: LatentMeans, latents: LatentDecisions) -> tuple[FloatArray, FloatArray]:
    """How likely it is that each step's noise was moved, and that it could be, ``[L]`` each."""
    moved, logit = means.moved(latents), means.logit(latents)
    if not means.once:
        return expit(moved + logit), np.ones(logit.size)
    each, of_all = log_joint(moved, logit, latents)
    part = np.exp(each - of_all[latents.rollout])
    return part, np.maximum(1.0 - latents.before(part), part)


@dataclass(frozen=True, eq=False)
class _NoiseFit:
    """What moves of noise are fitted to.

    Attributes:
        latents: Of N rollouts.
        weight: ``[N]``.
        ridge: Penalty of each coefficient, ``[B]``.
    """

    latents: LatentDecisions
    weight: FloatArray
    ridge: FloatArray

    @property
    def by_step(self) -> FloatArray:
        """The weights, ``[L]``."""
        return self.weight[self.latents.rollout]

    def of_few(self) -> "_NoiseFit":
        """Where rollouts are many, to some that stand for all."""
        if self.weight.size <= FEW:
            return self
        weight = at_most(self.weight, FEW)
        return _NoiseFit(self.latents.of(np.flatnonzero(weight)), weight[weight > 0.0], self.ridge)

    def after(self, rounds: int, means: LatentMeans) -> LatentMeans:
        """After so many rounds more."""
        for _ in range(rounds):
            means = self.maximised(means, _parts(means, self.latents))
        return means

    def maximised(
        self,
        before: LatentMeans,
        parts: tuple[FloatArray, FloatArray],
        *,
        narrow: FloatArray | None = None,
    ) -> LatentMeans:
        """Moves for given probabilities ``[L]`` that noise was moved, and that it could be.

        ``narrow`` is how likely it is narrow if it was moved; ``None``: by what was found before.
        """
        latents, basis, (part, able) = self.latents, self.latents.basis, parts
        narrow = _narrow(before, latents) if narrow is None else narrow
        of_moved = self.by_step * part
        of_narrow = of_moved * narrow
        if before.narrow is None:
            around = means = self._regression(of_moved)
            own = None
        else:
            around, means = self._regression(of_moved - of_narrow), self._regression(of_narrow)
            logits = before.narrow[-1]
            share = expit(choice_logit(basis, logits))
            own = np.vstack([means, self._newton_step(logits, of_narrow, of_moved, share)])
        squares = of_narrow @ (latents.noise - noise_means(basis, means)) ** 2
        spread = np.sqrt((squares + SPREAD_RIDGE) / (of_narrow.sum() + SPREAD_RIDGE))
        share = expit(before.logit(latents))
        choice = self._newton_step(before.choice, of_moved, self.by_step * able, share)
        sd = spread.clip(LEAST_SPREAD, 1.0)
        return replace(before, noise=around, choice=choice, sd=sd, narrow=own)

    def _regression(self, by_step: FloatArray) -> FloatArray:
        """Coefficients of means ``[M, B]`` of noise, by weights ``[L]``."""
        basis = self.latents.basis
        scaled = basis * by_step[:, None]
        moments = scaled.T @ self.latents.noise
        solved = np.linalg.solve(scaled.T @ basis + np.diag(self.ridge), moments)
        return np.asarray(solved.T, dtype=np.float64)

    def _newton_step(
        self, choice: FloatArray, chosen: FloatArray, able: FloatArray, share: FloatArray
    ) -> FloatArray:
        """A logit's coefficients a step on, where of ``able [L]`` so many are ``chosen``."""
        gradient = self.latents.basis.T @ (chosen - able * share) - self.ridge * choice
        more = np.linalg.solve(self._curvature(able * share * (1.0 - share)), gradient)
        return choice + more.clip(-LARGEST_STEP, LARGEST_STEP)

    def _curvature(self, by_step: FloatArray) -> FloatArray:
        basis = self.latents.basis
        return (basis * by_step[:, None]).T @ basis + np.diag(self.ridge)

    def left_out(self, means: LatentMeans) -> float:
        """Log likelihood of the rollouts, each left out of the fit once, by their weights."""
        return float(self.weight @ (means.log_ratio(self.latents) - self.pull(means)))

    def pull(self, means: LatentMeans) -> FloatArray:
        """Each rollout's pull on what was fitted, times what that is to its noise, ``[N]``."""
        latents, (part, able) = self.latents, _parts(means, self.latents)
        narrow = part * _narrow(means, latents)
        of_wide, of_narrow = _residuals(means, latents)
        found = self._pull_on_logit(part, able, expit(means.logit(latents)))
        if means.narrow is None:
            found = found + self._pull_on_means(
                of_wide + of_narrow, part, of_wide + of_narrow / means.sd**2
            )
        else:
            share = expit(narrow_moves(latents.basis, means.narrow)[1])
            found = found + self._pull_on_logit(narrow, part, share)
            found = found + self._pull_on_means(of_wide, part - narrow, of_wide)
            found = found + self._pull_on_means(of_narrow, narrow, of_narrow / means.sd**2)
        # on spreads by their logarithms, where they are free
        squares = of_narrow**2 / np.maximum(narrow, np.finfo(float).tiny)[:, None]
        relative = squares / means.sd**2 - narrow[:, None]
        of_spread = np.stack([latents.by_rollout(one) for one in relative.T], axis=1)
        free = (means.sd > LEAST_SPREAD) & (means.sd < 1.0)
        known = 2.0 * (self.by_step @ narrow + SPREAD_RIDGE)
        return self.weight * (found + np.sum(of_spread**2 * free, axis=1) / known)

    def _pull_on_logit(self, chosen: FloatArray, able: FloatArray, share: FloatArray) -> FloatArray:
        pull = _by_coefficient((chosen - able * share)[:, None], self.latents)[:, 0]
        curved = self._curvature(self.by_step * able * share * (1.0 - share))
        return np.sum(pull * np.linalg.solve(curved, pull.T).T, axis=1)

    def _pull_on_means(
        self, residual: FloatArray, part: FloatArray, score: FloatArray
    ) -> FloatArray:
        """By residuals and scores ``[L, M]`` of what is a ``part [L]`` of the steps."""
        pull = _by_coefficient(residual, self.latents)
        curved = self._curvature(self.by_step * part)
        solved = np.linalg.solve(curved, pull.reshape(-1, self.ridge.size).T).T
        scores = _by_coefficient(score, self.latents)
        return np.sum(scores * solved.reshape(pull.shape), axis=(1, 2))


def _narrow(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """How likely it is that noise, if it was moved, is of the part with the spreads, ``[L]``."""
    mean, (narrow_mean, logit) = (
        means.at(latents.basis),
        narrow_moves(latents.basis, means.narrow_noise),
    )
    wide, narrow = log_wide_and_narrow(latents.noise, mean, means.sd, narrow_mean=narrow_mean)
    return expit(logit + narrow - wide)


def _noise_scores(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """By a common shift of the means' coefficients, ``[N, M, B]``."""
    wide, narrow = _residuals(means, latents)
    return _by_coefficient(wide + narrow / means.sd**2, latents)


def _residuals(means: LatentMeans, latents: LatentDecisions) -> tuple[FloatArray, FloatArray]:
    """Of each step's noise from its means if it was moved, as far as it was, ``[L, M]`` each."""
    part, narrow = _parts(means, latents)[0][:, None], _narrow(means, latents)[:, None]
    mean, (own, _) = means.at(latents.basis), narrow_moves(latents.basis, means.narrow_noise)
    return part * (1.0 - narrow) * (latents.noise - mean), part * narrow * (latents.noise - own)


def _by_coefficient(values: FloatArray, latents: LatentDecisions) -> FloatArray:
    """Sums over each rollout's steps of values ``[L, M]`` times monomials, ``[N, M, B]``."""
    columns = [
        [latents.by_rollout(of_latent * monomial) for monomial in latents.basis.T]
        for of_latent in values.T
    ]
    shape = (values.shape[1], latents.basis.shape[1], latents.count)
    return np.moveaxis(np.array(columns).reshape(shape), -1, 0)
