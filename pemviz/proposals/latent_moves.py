"""How a proposal moves latents, and its fit by weighted least squares.

Latents at the start get a constant mean each, and spreads for half of the rollouts: a violation may
need a start that is rare by itself, and the starts that it needs lie closer to each other than
those of the model do. With z, m and s vectors,

    q(z) = (N(z; m, 1) + N(z; m, s^2)) / 2

so that half keeps the model's own spread, and no weight grows without bound where s is too small.
Where violations lie on all sides s is above 1. Of many latents most means and spreads are alike;
each fitted to its own values would be off by so much that together they hardly sample others
(:mod:`pemviz.proposals.shrinkage`).

Latents of a step get, with a probability c, means that are a polynomial of the state, else none
(:class:`pemviz.latents.Latents`): c near 1 moves every step a little, a small c few steps far. The
logit of c is another such polynomial. Fitted by expectation and maximisation (Dempster, Laird,
Rubin 1977) with r the probability that a step's noise was moved, a that it could be, mu the means,
w weights:

    minimise sum w r (z - mu)^2 / 2 + ridge . beta^2 / 2
    minimise -sum w (r log c + (a - r) log(1 - c)) + ridge . gamma^2 / 2, by a Newton step a round

Where each step is moved by itself, a = 1 and

    r = c N(z; mu, 1) / (c N(z; mu, 1) + (1 - c) N(z; 0, 1))

Or one step of a rollout is moved and then no other; which one, nobody knows. Where a single error
far out decides, the rollouts to draw have that error at one step and nothing else moved. Were each
step moved by itself with a share c, their number would vary as a binomial does, and of the rollouts
only those with one would count. With h_t the probability that step t is moved given none before it,
l_t the log density of moved over unmoved noise there:

    log q / p = log( sum_t h_t exp(l_t) prod_{s<t} (1 - h_s)  +  prod_t (1 - h_t) )

Drawn step by step without knowing the sum: with a the probability, given the noise so far, that
none was moved, step t is moved with the share a h_t, and then

    a <- a (1 - h_t) / (1 - a h_t + a h_t exp(l_t))

h may depend on the state; it has the logit 0 in all states where, of the steps left, each is as
likely as the other (:func:`even_logit`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, Rows, log_sum_exp
from pemviz.latents import log_moved, log_share_moved, log_wide_and_narrow
from pemviz.proposals.offset_logistic import Monomials
from pemviz.proposals.shrinkage import Shrinkage, shrinkage

NEVER = 0.03
"""Of rollouts, with no step moved where all steps are as likely."""
START_SPREAD_RIDGE = 5.0
"""So many starts of spread 1 count beside those that a spread is fitted to."""
LARGEST_MEAN = 8.0
LEAST_SPREAD, LARGEST_SPREAD = 0.2, 3.0
SPREAD_RIDGE = 0.5
"""So many moved steps of spread 1 count beside those that a spread is fitted to."""
ROUNDS = 8
LARGEST_STEP = 2.0
"""Of a coefficient of the choice in a round."""
LARGEST_LOGIT = 5.0
"""Of the share of steps whose noise is moved, and of that drawn from the model, as a defence."""


def even_logit(step: IntArray, *, steps: int) -> FloatArray:
    """Logit of moving a step, given none before, by which all ``steps`` of a rollout are as likely.

    Steps count from 0 and have any shape.
    """
    return -np.log(steps - 1.0 - step + steps * NEVER / (1.0 - NEVER))


def log_waiting(log_waits: FloatArray, share: FloatArray, moved: FloatArray) -> FloatArray:
    """Log of the probability that no step was moved yet, after one more, ``[n]``.

    Before it, it is ``log_waits``; the step is moved with ``share``, given none before (h), and
    ``moved`` is the log density of moved over unmoved noise, ``[n]`` each.
    """
    stays = log_waits + np.log1p(-share)
    return stays - log_share_moved(moved, np.exp(log_waits) * share)


@dataclass(frozen=True)
class LatentDecisions:
    """The latents of N rollouts, as proposals see them.

    Attributes:
        start: ``[N, S]``.
        rollout: Of each step with noise that may be moved, ``[L]``, ascending.
        monomials: Of the state there, ``[L, B]``; of many rollouts not at once.
        noise: ``[L, M]``.
        even: :func:`even_logit` there, ``[L]``.
        broken: Which rules are broken there, ``[L, R]``; ``None`` without several rules.
    """

    start: FloatArray
    rollout: IntArray
    monomials: FloatArray | Monomials
    noise: FloatArray
    even: FloatArray
    broken: BoolArray | None = None

    @property
    def count(self) -> int:
        """Number of rollouts N."""
        return len(self.start)

    @cached_property
    def basis(self) -> FloatArray:
        """The monomials themselves, ``[L, B]``."""
        return self.monomials[:]

    def of(self, rollouts: IntArray) -> "LatentDecisions":
        """Of the chosen rollouts, which are ascending; their monomials are made."""
        number = np.full(self.count, -1)
        number[rollouts] = np.arange(rollouts.size)
        kept = number[self.rollout] >= 0
        return self._at(kept, number[self.rollout[kept]].astype(np.int64), self.start[rollouts])

    def between(self, first: int, stop: int) -> "LatentDecisions":
        """Of the rollouts from ``first`` on, before ``stop``; their monomials are made."""
        steps = slice(*np.searchsorted(self.rollout, [first, stop]).tolist())
        return self._at(steps, self.rollout[steps] - first, self.start[first:stop])

    def _at(self, steps: Rows, rollout: IntArray, start: FloatArray) -> "LatentDecisions":
        broken = None if self.broken is None else self.broken[steps]
        return LatentDecisions(
            start, rollout, self.monomials[steps], self.noise[steps], self.even[steps], broken
        )

    def where(self, kept: BoolArray | None) -> "LatentDecisions":
        """Of some of the steps, ``[L]``; ``None``: of all."""
        if kept is None or kept.all():
            return self
        known = self.monomials
        some = known.take(kept) if isinstance(known, Monomials) else known[kept]
        return LatentDecisions(
            self.start, self.rollout[kept], some, self.noise[kept], self.even[kept]
        )

    def joined(self, after: "LatentDecisions") -> "LatentDecisions":
        """These and those of more rollouts."""
        known, more = self.monomials, after.monomials
        if isinstance(known, Monomials) and isinstance(more, Monomials):
            monomials = Monomials.concatenate([known, more])
        else:
            monomials = np.concatenate([known[:], more[:]])
        broken = None
        if self.broken is not None and after.broken is not None:
            broken = np.concatenate([self.broken, after.broken])
        return LatentDecisions(
            np.concatenate([self.start, after.start]),
            np.concatenate([self.rollout, after.rollout + self.count]),
            monomials,
            np.concatenate([self.noise, after.noise]),
            np.concatenate([self.even, after.even]),
            broken,
        )

    def by_rollout(self, values: FloatArray) -> FloatArray:
        """Sums over each rollout's steps, ``[N]`` of ``[L]``."""
        sums = np.bincount(self.rollout, weights=values, minlength=self.count)
        return sums.astype(np.float64)

    @cached_property
    def place(self) -> IntArray:
        """Of each step among its rollout's, ``[L]``."""
        number = np.bincount(self.rollout, minlength=self.count)
        first = np.cumsum(number) - number
        return np.arange(self.rollout.size) - first[self.rollout]

    def table(self, values: FloatArray, *, empty: float) -> FloatArray:
        """Values ``[L]`` as ``[N, largest number of steps]``."""
        widest = int(self.place.max()) + 1 if self.place.size else 0
        found = np.full((self.count, widest), empty)
        found[self.rollout, self.place] = values
        return found

    def before(self, values: FloatArray) -> FloatArray:
        """Sums over a rollout's earlier steps, ``[L]`` of ``[L]``."""
        table = self.table(values, empty=0.0)
        return (np.cumsum(table, axis=1) - table)[self.rollout, self.place]


def _log_joint(
    moved: FloatArray, logit: FloatArray, latents: LatentDecisions
) -> tuple[FloatArray, FloatArray]:
    """Where one step is moved: log q / p jointly with which it is ``[L]``, and summed up ``[N]``.

    For logs of moved over unmoved density ``[L]``, and logits of moving a step, given none before.
    """
    stays = -np.logaddexp(0.0, logit)
    each = latents.before(stays) + stays + logit + moved
    largest, never = latents.table(each, empty=-np.inf), latents.by_rollout(stays)
    return each, np.asarray(log_sum_exp(np.hstack([largest, never[:, None]]), axis=1))


@dataclass(frozen=True, eq=False)
class StartMoves:
    """Means and spreads of the latents at the start.

    Attributes:
        mean: ``[S]``; of N rollouts each its own, ``[N, S]``.
        sd: Spreads of half of the rollouts, likewise; 1 is that of the model.
    """

    mean: FloatArray
    sd: FloatArray

    def rows(self, rows: slice) -> "StartMoves":
        """Of some of the rollouts."""
        return StartMoves(self.mean[rows], self.sd[rows])

    def log_ratio(self, start: FloatArray) -> FloatArray:
        """Log q / p of starts ``[N, S]``, ``[N]`` [nats]."""
        return log_moved(start, self.mean, self.sd)


def fit_start(start: FloatArray, weight: FloatArray, *, ridge: float) -> StartMoves:
    """The moves nearest to starts ``[N, S]`` of weights ``[N]``, not negative.

    So many starts at 0 as ``ridge`` says, above 0, count beside those that means are fitted to.
    """
    return _drawn_together(start, weight, ridge=ridge)[0]


def _drawn_together(
    start: FloatArray, weight: FloatArray, *, ridge: float
) -> tuple[StartMoves, Shrinkage, Shrinkage]:
    """The same, and how means and logs of spreads are drawn together."""
    total = float(weight.sum())
    mean = weight @ start / (total + ridge)
    spread = _start_spread(weight @ (start - mean) ** 2, total)
    of_means = shrinkage(mean, spread**2 / (total + ridge))
    mean = of_means.of(mean)
    log_spread = np.log(_start_spread(weight @ (start - mean) ** 2, total))
    error = np.full(mean.size, 0.5 / (total + START_SPREAD_RIDGE))
    of_spreads = shrinkage(log_spread, error)
    return StartMoves(mean, np.exp(of_spreads.of(log_spread))), of_means, of_spreads


def start_optimism(
    moves: StartMoves, start: FloatArray, weight: FloatArray, *, ridge: float
) -> FloatArray:
    """By how much each start is likelier than if the fit had been made without it, ``[N]`` [nats].

    ``moves`` are those fitted by :func:`fit_start` with the other arguments.
    """
    _, of_means, of_spreads = _drawn_together(start, weight, ridge=ridge)
    own = weight[:, None]
    total = (float(weight.sum()) - own).clip(0.0)
    sums, squares = weight @ start - own * start, weight @ start**2 - own * start**2
    mean = of_means.of(sums / (total + ridge))
    around_mean = (squares - 2.0 * mean * sums + total * mean**2).clip(0.0)
    log_spread = np.log(_start_spread(around_mean, total))
    without = StartMoves(mean, np.exp(of_spreads.of(log_spread)))
    return (moves.log_ratio(start) - without.log_ratio(start)).clip(0.0)


def _start_spread(squares: FloatArray, total: FloatArray | float) -> FloatArray:
    """From sums of weighted squares and of the weights."""
    variance = (squares + START_SPREAD_RIDGE) / (total + START_SPREAD_RIDGE)
    return np.sqrt(variance).clip(LEAST_SPREAD, LARGEST_SPREAD)


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

    @staticmethod
    def unmoved(*, start: int, noise: int, basis: int) -> "LatentMeans":
        """Means of 0 and spreads of 1, for S latents at the start, M of a step and B monomials."""
        at_start = StartMoves(np.zeros(start), np.ones(start))
        return LatentMeans(at_start, np.zeros((noise, basis)), np.zeros(basis), np.ones(noise))

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
            return of_start + _log_joint(moved, logit, latents)[1]
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


def fit_means(
    latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray
) -> tuple[LatentMeans, FloatArray, FloatArray]:
    """The means nearest to weighted rollouts' latents.

    From three beginnings, the best: all steps moved, or the farthest of each rollout, by itself or
    as the one that may be.

    Args:
        latents: Of N rollouts.
        weight: ``[N]``, not negative.
        ridge: Penalty of each coefficient, above 0, ``[B]``.

    Returns:
        The means; by how much the log likelihood of each rollout's start would fall without it,
        ``[N]`` [nats]; and of its noise: to first order, as
        :func:`pemviz.proposals.offset_logistic_fit.leave_one_out_loss`.
    """
    rollouts = np.flatnonzero(weight > 0.0)
    chosen, own = latents.of(rollouts), weight[rollouts]
    distance = np.sum(chosen.noise**2, axis=1)
    largest = np.full(chosen.count, -np.inf)
    np.maximum.at(largest, chosen.rollout, distance)
    farthest = (distance >= largest[chosen.rollout]).astype(np.float64)
    up_to_farthest = (chosen.before(farthest) == 0.0).astype(np.float64)
    all_steps = np.ones(chosen.rollout.size)
    none = LatentMeans.unmoved(
        start=latents.start.shape[1], noise=latents.noise.shape[1], basis=ridge.size
    )
    none = replace(none, start=fit_start(chosen.start, own, ridge=float(ridge[0])))
    tried: list[LatentMeans] = []
    for means, parts in (
        (none, (all_steps, all_steps)),
        (none, (farthest, all_steps)),
        (replace(none, once=True), (farthest, up_to_farthest)),
    ):
        found = _maximised(means, chosen, own, parts, ridge)
        for _ in range(ROUNDS if found.noise.size else 0):
            found = _maximised(found, chosen, own, _parts(found, chosen), ridge)
        tried.append(found)

    def penalised_likelihood(means: LatentMeans) -> float:
        likelihood = float(own @ means.log_ratio(chosen))
        return likelihood - 0.5 * float(np.sum(ridge * (means.noise**2).sum(axis=0)))

    best = max(tried, key=penalised_likelihood)
    at_start, of_noise = np.zeros(weight.size), np.zeros(weight.size)
    at_start[rollouts] = start_optimism(best.start, chosen.start, own, ridge=float(ridge[0]))
    if best.noise.size:
        of_noise[rollouts] = _leave_one_out(best, chosen, own, ridge)
    return best, at_start, of_noise


def next_round(
    means: LatentMeans, latents: LatentDecisions, weight: FloatArray, *, ridge: FloatArray
) -> LatentMeans:
    """One round of expectation and maximisation; arguments as above, weights may be 0."""
    found = _maximised(means, latents, weight, _parts(means, latents), ridge)
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
    precision = np.diag(0.5 + 0.5 / means.sd**2)
    found = np.zeros((at_start + moved * ridge.size,) * 2)
    found[:at_start, :at_start] = np.eye(at_start) * (weight.sum() + ridge[0])
    found[at_start:, at_start:] = np.kron(precision, one) + np.kron(np.eye(moved), np.diag(ridge))
    return found


def _parts(means: LatentMeans, latents: LatentDecisions) -> tuple[FloatArray, FloatArray]:
    """How likely it is that each step's noise was moved, and that it could be, ``[L]`` each."""
    moved, logit = means.moved(latents), means.logit(latents)
    if not means.once:
        return expit(moved + logit), np.ones(logit.size)
    each, of_all = _log_joint(moved, logit, latents)
    part = np.exp(each - of_all[latents.rollout])
    return part, np.maximum(1.0 - latents.before(part), part)


def _maximised(
    before: LatentMeans,
    latents: LatentDecisions,
    weight: FloatArray,
    parts: tuple[FloatArray, FloatArray],
    ridge: FloatArray,
) -> LatentMeans:
    """Moves of noise for given probabilities ``[L]`` that it was moved, and that it could be."""
    basis, by_step, (part, able) = latents.basis, weight[latents.rollout], parts
    moved = basis * (by_step * part)[:, None]
    solved = np.linalg.solve(moved.T @ basis + np.diag(ridge), moved.T @ latents.noise)
    coefficients = np.asarray(solved.T, dtype=np.float64)
    share, able = expit(before.logit(latents)), by_step * able
    curvature = _curvature(basis, able * share * (1.0 - share), ridge)
    gradient = basis.T @ (by_step * part - able * share) - ridge * before.choice
    change = np.linalg.solve(curvature, gradient).clip(-LARGEST_STEP, LARGEST_STEP)
    of_spread = by_step * part * _narrow(before, latents)
    squares = of_spread @ (latents.noise - noise_means(basis, coefficients)) ** 2
    spread = np.sqrt((squares + SPREAD_RIDGE) / (of_spread.sum() + SPREAD_RIDGE))
    return replace(
        before, noise=coefficients, choice=before.choice + change, sd=spread.clip(LEAST_SPREAD, 1.0)
    )


def _curvature(basis: FloatArray, by_step: FloatArray, ridge: FloatArray) -> FloatArray:
    return (basis * by_step[:, None]).T @ basis + np.diag(ridge)


def _narrow(means: LatentMeans, latents: LatentDecisions) -> FloatArray:
    """How likely it is that noise, if it was moved, is of the half with the spreads, ``[L]``."""
    wide, narrow = log_wide_and_narrow(latents.noise, means.at(latents.basis), means.sd)
    return expit(narrow - wide)


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
    (part, able), by_step = _parts(means, latents), weight[latents.rollout]
    pull = _by_coefficient(_residual(means, latents), latents)
    curved = _curvature(latents.basis, by_step * part, ridge)
    solved = np.linalg.solve(curved, pull.reshape(-1, ridge.size).T).T.reshape(pull.shape)
    found = np.sum(_noise_scores(means, latents) * solved, axis=(1, 2))
    share = expit(means.logit(latents))
    choice = _by_coefficient((part - able * share)[:, None], latents)[:, 0]
    curved = _curvature(latents.basis, by_step * able * share * (1.0 - share), ridge)
    found = found + np.sum(choice * np.linalg.solve(curved, choice.T).T, axis=1)
    # spreads by their logarithms, where they are free
    narrow = part * _narrow(means, latents)
    relative = ((latents.noise - means.at(latents.basis)) / means.sd) ** 2 - 1.0
    of_spread = np.stack([latents.by_rollout(narrow * one) for one in relative.T], axis=1)
    free = (means.sd > LEAST_SPREAD) & (means.sd < 1.0)
    known = 2.0 * (by_step @ narrow + SPREAD_RIDGE)
    return weight * (found + np.sum(of_spread**2 * free, axis=1) / known)
