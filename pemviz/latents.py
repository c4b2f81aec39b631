"""What is random beside perception's outcomes: standard normals at the start and at every step.

A scenario says how many of them it takes, and maps them to whatever it needs, such as a random
gap at the start or an error of a measured position (:mod:`pemviz.quantiles`). A proposal moves
their means; with z a latent drawn with mean m, its part of a rollout's weight is

    log p(z) - log q(z) = -z^2 / 2 + (z - m)^2 / 2
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
    """

    start: int = 0
    noise: int = 0

    def __bool__(self) -> bool:
        """Whether there are any."""
        return self.start > 0 or self.noise > 0

    def __str__(self) -> str:
        """In words: '1 at the start and 2 at every step'."""
        parts = [f"{self.start} at the start"] * (self.start > 0)
        parts += [f"{self.noise} at every step"] * (self.noise > 0)
        return " and ".join(parts) or "none"


NO_LATENTS = LatentCounts()


@dataclass(frozen=True)
class StandardNormals(Batch):
    """Independent draws from the standard normal, for N rollouts.

    Attributes:
        start: ``[N, S]``.
        noise: ``[N, T-1, M]``.
    """

    start: FloatArray
    noise: FloatArray


@dataclass(frozen=True)
class Latents(Batch):
    """The latents of N rollouts, and the means that they were drawn with.

    What is not declared has no columns: S or M is 0 there.

    Attributes:
        start: ``[N, S]``, standard normal under the model.
        start_mean: ``[N, S]``; 0 where nothing is moved.
        noise: ``[N, T-1, M]``, likewise; steps are those of the scenario.
        noise_mean: ``[N, T-1, M]``.
    """

    start: FloatArray
    start_mean: FloatArray
    noise: FloatArray
    noise_mean: FloatArray

    @cached_property
    def log_weight(self) -> FloatArray:
        """Sum over all latents of log p - log q, ``[N]`` [nats]."""
        of_start = row_sums(self.start_mean * (0.5 * self.start_mean - self.start))
        of_noise = row_sums(self.noise_mean * (0.5 * self.noise_mean - self.noise))
        return read_only(np.asarray(of_start + of_noise))
