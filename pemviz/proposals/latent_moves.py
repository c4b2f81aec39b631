"""How a proposal moves latents; :mod:`pemviz.proposals.latent_moves_fit` fits it.

Latents at the start get means and spreads (:mod:`pemviz.proposals.start_moves`).

Latents of a step get, with a probability c, means that are a polynomial of the state, else none
(:class:`pemviz.latents.Latents`): c near 1 moves every step a little, a small c few steps far. The
logit of c is another such polynomial. Of what is moved a part is narrow: half, around the same
means; or it has means of its own and a share j, the logit of which is a third polynomial. A few
errors far out among many that are a little larger than usual no single mean tells apart.

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
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, Rows, log_sum_exp
from pemviz.latents import log_moved, log_share_moved
from pemviz.proposals.offset_logistic import Monomials
from pemviz.proposals.start_moves import StartMoves

NEVER = 0.03
"""Of rollouts, with no step moved where all steps are as likely."""
LARGEST_MEAN = 8.0
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


def log_joint(
    moved: FloatArray, logit: FloatArray, latents: LatentDecisions
) -> tuple[FloatArray, FloatArray]:
    """Where one step is moved: log q / p jointly with which it is ``[L]``, and summed up ``[N]``.

    For logs of moved over unmoved density ``[L]``, and logits of moving a step, given none before.
    """
    stays = -np.logaddexp(0.0, logit)
    each = latents.before(stays) + stays + logit + moved
    largest, never = latents.table(each, empty=-np.inf), latents.by_rollout(stays)
    return each, np.asarray(log_sum_exp(np.hstack([largest, never[:, None]]), axis=1))


@dataclass(frozen=True)
class NoiseMoves:
    """How the noise of a step of N rollouts is moved, see :class:`pemviz.latents.Latents`.

    Attributes:
        mean: ``[N, M]``.
        share: ``[N]``.
        narrow_mean: Of what is narrow, ``[N, M]``.
        narrow_share: How much of the moved noise that is, ``[N]``.
    """

    mean: FloatArray
    share: FloatArray
    narrow_mean: FloatArray
    narrow_share: FloatArray


@dataclass(frozen=True, eq=False)
class LatentMeans:
    """How a proposal moves latents.

    Attributes:
        start: Means and spreads at the start.
        noise: Coefficients of the means of a step, ``[M, B]``.
        choice: Coefficients of the logit of how often a step's noise is moved, ``[B]``.
        sd: Spreads of what is narrow of the noise that is moved, ``[M]``.
        once: Whether a rollout's noise is moved at one step at most.
        narrow: Coefficients of the means of narrow noise and, last, of the logit of its share,
            ``[M + 1, B]``; ``None``: half of what is moved, around the same means.
    """

    start: StartMoves
    noise: FloatArray
    choice: FloatArray
    sd: FloatArray
    once: bool = False
    narrow: FloatArray | None = None

    @staticmethod
    def unmoved(*, start: int, noise: int, basis: int) -> "LatentMeans":
        """Means of 0 and spreads of 1, for S latents at the start, M of a step and B monomials."""
        at_start = StartMoves.unmoved(start)
        return LatentMeans(at_start, np.zeros((noise, basis)), np.zeros(basis), np.ones(noise))

    @property
    def narrow_noise(self) -> FloatArray:
        """``narrow``, or what says that it is half, around the same means."""
        if self.narrow is not None:
            return self.narrow
        return np.vstack([self.noise, np.zeros_like(self.choice)])

    def at(self, basis: FloatArray) -> FloatArray:
        """Means ``[n, M]`` of moved noise at states with monomials ``[n, B]``."""
        return noise_means(basis, self.noise)

    def logit(self, latents: LatentDecisions) -> FloatArray:
        """Of how often each step's noise is moved, ``[L]``; with ``once`` given none before."""
        logit = choice_logit(latents.basis, self.choice)
        return logit + latents.even if self.once else logit

    def moved(self, latents: LatentDecisions) -> FloatArray:
        """Log of moved over unmoved density of each step's noise, ``[L]``."""
        mean = self.at(latents.basis)
        if self.narrow is None:
            return log_moved(latents.noise, mean, self.sd)
        narrow_mean, logit = narrow_moves(latents.basis, self.narrow)
        return log_moved(
            latents.noise, mean, self.sd, narrow_mean=narrow_mean, narrow_share=expit(logit)
        )

    def log_ratio(self, latents: LatentDecisions) -> FloatArray:
        """Log q / p of all latents of each rollout, ``[N]``."""
        of_start = self.start.log_ratio(latents.start)
        moved, logit = self.moved(latents), self.logit(latents)
        if self.once:
            return of_start + log_joint(moved, logit, latents)[1]
        return of_start + latents.by_rollout(log_share_moved(moved, expit(logit)))

    def arrays(self) -> Mapping[str, AnyArray]:
        """By name, as they are stored."""
        return {
            "start_mean": self.start.mean,
            "start_sd": self.start.sd,
            "start_axes": self.start.axes,
            "start_along": self.start.along,
            "noise_coefficients": self.noise,
            "noise_choice": self.choice,
            "noise_sd": self.sd,
            "noise_once": np.array(self.once),
            **({} if self.narrow is None else {"noise_narrow": self.narrow}),
        }


def narrow_moves(basis: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of narrow noise ``[n, M]`` and logits of its share ``[n]``, as the two below."""
    means, choice = coefficients[..., :-1, :], coefficients[..., -1, :]
    return noise_means(basis, means), choice_logit(basis, choice)


def noise_means(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Means ``[n, M]``; coefficients are ``[M, B]`` or, a row each, ``[n, M, B]``."""
    # einsum, unlike a library's matrix product, gives a row the same in any batch
    products = "nb,nmb->nm" if coefficients.ndim > 2 else "nb,mb->nm"
    return np.einsum(products, basis, coefficients).clip(-LARGEST_MEAN, LARGEST_MEAN)


def choice_logit(basis: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Logits ``[n]``; coefficients are ``[B]`` or, a row each, ``[n, B]``."""
    products = "nb,nb->n" if coefficients.ndim > 1 else "nb,b->n"
    return np.einsum(products, basis, coefficients).clip(-LARGEST_LOGIT, LARGEST_LOGIT)
