"""What is random beside perception's outcomes: standard normals at the start and at every step.

A scenario says how many of them it takes, and maps them to whatever it needs, such as a random
gap at the start or an error of a measured position (:mod:`pemviz.quantiles`). A proposal moves
their means; with z a latent drawn with mean m, its part of a rollout's weight is

    log p(z) - log q(z) = -z^2 / 2 + (z - m)^2 / 2

or, where it changes spreads or moves some steps' noise alone, what :class:`Latents` says, and of
starts what drew them (:class:`pemviz.proposals.start_moves.StartMoves`). They are drawn where
rollouts are simulated (:mod:`pemviz.sampling.rollouts.simulate`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import Batch, FloatArray, read_only, row_sums


@dataclass(frozen=True)
class LatentCounts:
    """How many standard normals a rollout takes, by default none.

    Attributes:
        start: So many once, for the state in which it starts (S).
        noise: So many at every step (M).
        seeds: So many more once, after those of the start, that no proposal moves: for seeds of a
            random generator that the scenario brings, whose draws are the model's and have no
            weight.
    """

    start: int = 0
    noise: int = 0
    seeds: int = 0

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self.at_start > 0 or self.noise > 0

    @property
    def at_start(self) -> int:
        """How many a rollout is given where it starts, seeds included."""
        return self.start + self.seeds

    def __str__(self) -> str:
        """In words: '1 at the start and 2 at every step'."""
        parts = [f"{self.start} at the start"] * (self.start > 0)
        parts += [f"{self.noise} at every step"] * (self.noise > 0)
        parts += [f"{self.seeds} for seeds"] * (self.seeds > 0)
        return " and ".join(parts) or "none"


NO_LATENTS = LatentCounts()
SEED_LATENTS = LatentCounts(seeds=1)


@dataclass(frozen=True)
class StandardNormals(Batch):
    """Independent draws from the standard normal, for N rollouts.

    Attributes:
        start: ``[N, S]``, seeds after them.
        noise: ``[N, T-1, M]``.
        choice: ``[N, T-1]``: they decide at which steps noise is moved, see :class:`Latents`.
    """

    start: FloatArray
    noise: FloatArray
    choice: FloatArray


@dataclass(frozen=True)
class Latents(Batch):
    """The latents of N rollouts, and the means that they were drawn with.

    What is not declared has no columns: S or M is 0 there. Noise of a step is moved with a
    probability c, its share, else not; of M together then, with z, m and s vectors,

        q(z) = (1 - c) N(z; 0, 1) + c ((1 - j) N(z; m, 1) + j N(z; n, s^2))

    An error that has to be above a limit far out is a little above it: the smaller s is, the more
    of the moved noise lies there, while the rest of it has the model's own tail. Where n is m and j
    a half, both lie around the same; or a few steps are moved far, to n, and others a little, to m.

    Attributes:
        start: ``[N, S]``, seeds after them, standard normal under the model.
        start_mean: ``[N, S]``; 0 where nothing is moved.
        start_log_weight: Log p - log q of the start, ``[N]`` [nats].
        noise: ``[N, T-1, M]``, likewise; steps are those of the scenario.
        noise_mean: ``[N, T-1, M]``.
        noise_share: ``[N, T-1]``, 1 unless a proposal says less.
        noise_sd: ``[N, T-1, M]``, 1 unless a proposal says less.
        noise_narrow_mean: That of what has this spread, ``[N, T-1, M]``; ``None``: the same.
        noise_narrow_share: How much of the moved noise that is, ``[N, T-1]``; ``None``: half.
    """

    start: FloatArray
    start_mean: FloatArray
    start_log_weight: FloatArray
    noise: FloatArray
    noise_mean: FloatArray
    noise_share: FloatArray
    noise_sd: FloatArray
    noise_narrow_mean: FloatArray | None = None
    noise_narrow_share: FloatArray | None = None

    @cached_property
    def log_weight(self) -> FloatArray:
        """Sum over all latents of log p - log q, ``[N]`` [nats]."""
        moved = log_moved(
            self.noise,
            self.noise_mean,
            self.noise_sd,
            narrow_mean=self.noise_narrow_mean,
            narrow_share=self.noise_narrow_share,
        )
        of_noise = row_sums(log_share_moved(moved, self.noise_share))
        return read_only(np.asarray(self.start_log_weight - of_noise))


def log_moved(
    noise: FloatArray,
    mean: FloatArray,
    sd: FloatArray,
    *,
    narrow_mean: FloatArray | None = None,
    narrow_share: FloatArray | None = None,
) -> FloatArray:
    """Log of moved over unmoved density of noise ``[..., M]`` with means and spreads, ``[...]``.

    Half of it has the spreads, or ``narrow_share [...]``, around the same means or ``narrow_mean``.
    """
    wide, narrow = log_wide_and_narrow(noise, mean, sd, narrow_mean=narrow_mean)
    if narrow_share is None:
        as_wide = np.all(sd == 1.0, axis=-1)
        return np.where(as_wide, wide, np.logaddexp(wide, narrow) - np.log(2.0))
    with np.errstate(divide="ignore"):  # nothing is narrow, or all
        log_shares = np.log1p(-narrow_share), np.log(narrow_share)
    return np.logaddexp(log_shares[0] + wide, log_shares[1] + narrow)


def log_wide_and_narrow(
    noise: FloatArray, mean: FloatArray, sd: FloatArray, *, narrow_mean: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Logs of N(z; m, 1) and of N(z; n, s^2) over N(z; 0, 1), of M together, ``[...]`` each.

    Without ``narrow_mean``, n is m.
    """
    wide = log_shifted(noise, mean)
    around = mean if narrow_mean is None else narrow_mean
    narrow = 0.5 * noise**2 - 0.5 * ((noise - around) / sd) ** 2 - np.log(sd)
    return wide, np.sum(narrow, axis=-1)


def log_shifted(values: FloatArray, mean: FloatArray) -> FloatArray:
    """Log of N(z; m, 1) over N(z; 0, 1), ``[...]`` of values and means ``[..., M]``."""
    return np.sum(mean * (values - 0.5 * mean), axis=-1)


def log_share_moved(log_ratio: FloatArray, share: FloatArray | float) -> FloatArray:
    """log(1 - c + c exp(l)) for a share c and a log ratio l of moved to unmoved, ``[...]``."""
    with np.errstate(divide="ignore"):  # a share of 1: nothing stays
        return np.logaddexp(np.log1p(-np.asarray(share)), np.log(share) + log_ratio)
