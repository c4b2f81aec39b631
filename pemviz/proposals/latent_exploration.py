"""A broad family of proposals that move latents: up and down, by a few strengths, nothing fitted.

It goes with :mod:`pemviz.proposals.exploration`: an exploration proposal's outcomes, latents at the
start and noise are drawn from a member of a family each, one independent of the other, so that
likelihoods multiply.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, log_sum_exp

STRENGTHS = (2.0, 4.0, 6.0)
"""By how much a latent at the start is moved; of noise, the sum over a window by the square root
of its steps: by so many standard deviations either way."""
UNMOVED_SHARE = 0.4
"""Of rollouts whose latents stay, at the start and likewise in the steps."""
MOST_SINGLE_STEPS = 128
QUARTERS = 4
CHUNK_ROLLOUTS = 512


@dataclass(frozen=True, eq=False)
class LatentFamily:
    """Members of the two families.

    Attributes:
        start: Means at the start, ``[G, S]``.
        start_share: How often each, ``[G]``; sums to 1.
        latent: Which of a step's latents each of F members moves, ``[F]``.
        mean: By how much, ``[F]``.
        first: First step of its window, ``[F]``.
        stop: The step after its last, ``[F]``.
        share: How often each, ``[F]``; sums to 1.
        noise: Latents of a step (M).
    """

    start: FloatArray
    start_share: FloatArray
    latent: IntArray
    mean: FloatArray
    first: IntArray
    stop: IntArray
    share: FloatArray
    noise: int

    @staticmethod
    def over(steps: int, *, start: int, noise: int) -> "LatentFamily":
        """The families for ``start`` latents at the start and ``noise`` in each of ``steps``."""
        moved = np.concatenate([np.eye(start) * s for s in _both_ways()]) if start else []
        means = np.vstack([np.zeros((1, start)), *moved])
        members = list(_members(steps, noise))
        latent, mean, first, stop, share = zip((0, 0.0, 0, steps, 1.0), *members, strict=True)
        shares = np.array(share)
        shares[1:] *= (1.0 - UNMOVED_SHARE) / max(float(shares[1:].sum()), 1e-300)
        shares[0] = UNMOVED_SHARE if members else 1.0
        return LatentFamily(
            start=means,
            start_share=_with_unmoved(len(means)),
            latent=np.array(latent, dtype=np.int64),
            mean=np.array(mean),
            first=np.array(first, dtype=np.int64),
            stop=np.array(stop, dtype=np.int64),
            share=shares,
            noise=noise,
        )

    def drawn(self, count: int, generator: np.random.Generator, *, of: int) -> "LatentExploration":
        """Members for the first ``count`` of N rollouts, systematically, in random order."""
        at_start = np.zeros((of, self.start.shape[1]))
        at_start[:count] = self.start[_systematic(self.start_share, count, generator)]
        member = np.zeros(of, dtype=np.int64)
        member[:count] = _systematic(self.share, count, generator)
        mean = np.zeros((of, self.noise))
        if self.noise:
            mean[np.arange(of), self.latent[member]] = self.mean[member]
        return LatentExploration(at_start, mean, self.first[member], self.stop[member])

    def log_ratio(self, start: FloatArray, noise: FloatArray, acts: BoolArray) -> FloatArray:
        """Log of the families' density over the model's, ``[N]``.

        Args:
            start: ``[N, S]``.
            noise: ``[N, T-1, M]``.
            acts: At which steps noise may be moved, ``[N, T-1]``.
        """
        squares = 0.5 * np.sum(self.start**2, axis=1)
        by_start = np.einsum("ns,gs->ng", start, self.start) - squares + np.log(self.start_share)
        found = np.asarray(log_sum_exp(by_start, axis=1))
        if self.noise:
            for begin in range(0, len(noise), CHUNK_ROLLOUTS):
                rows = slice(begin, begin + CHUNK_ROLLOUTS)
                found[rows] += self._of_noise(noise[rows], acts[rows])
        return found

    def _of_noise(self, noise: FloatArray, acts: BoolArray) -> FloatArray:
        steps = np.cumsum(np.pad(acts.T * 1.0, ((1, 0), (0, 0))), axis=0)
        each = steps[self.stop] - steps[self.first]
        by_member = -0.5 * self.mean[:, None] ** 2 * each + np.log(self.share)[:, None]
        for latent in range(self.noise):
            chosen = np.flatnonzero(self.latent == latent)
            values = np.where(acts, noise[..., latent], 0.0)
            sums = np.cumsum(np.pad(values.T, ((1, 0), (0, 0))), axis=0)
            within = sums[self.stop[chosen]] - sums[self.first[chosen]]
            by_member[chosen] += self.mean[chosen, None] * within
        return np.asarray(log_sum_exp(by_member, axis=0))


@dataclass(frozen=True, eq=False)
class LatentExploration:
    """Members for N rollouts.

    Attributes:
        start: Means at the start, ``[N, S]``.
        noise: Means within the window, ``[N, M]``.
        first: First step of the window, ``[N]``.
        stop: The step after its last, ``[N]``.
    """

    start: FloatArray
    noise: FloatArray
    first: IntArray
    stop: IntArray

    def rows(self, rows: slice) -> "LatentExploration":
        """Of some of the rollouts."""
        return LatentExploration(
            self.start[rows], self.noise[rows], self.first[rows], self.stop[rows]
        )

    def noise_mean(self, step: int) -> FloatArray:
        """Of the noise of a step, ``[N, M]``."""
        within = (self.first <= step) & (self.stop > step)
        return np.where(within[:, None], self.noise, 0.0)


def _both_ways() -> list[float]:
    return [sign * strength for strength in STRENGTHS for sign in (1.0, -1.0)]


def _with_unmoved(members: int) -> FloatArray:
    if members == 1:
        return np.ones(1)
    rest = (1.0 - UNMOVED_SHARE) / (members - 1)
    return np.array([UNMOVED_SHARE] + [rest] * (members - 1))


def _members(steps: int, noise: int) -> Iterator[tuple[int, float, int, int, float]]:
    """Latent, mean, window and share, not normalised, of members; each length has as much."""
    for windows in _lengths(steps):
        for first, stop in windows:
            for strength in _both_ways():
                for latent in range(noise):
                    mean = strength / (stop - first) ** 0.5
                    yield latent, mean, first, stop, 1.0 / len(windows)


def _lengths(steps: int) -> list[list[tuple[int, int]]]:
    """Windows of all steps, of a quarter of them, each overlapping the next, and single steps."""
    lengths = [[(0, steps)]]
    if steps >= 2 * QUARTERS:
        edges = [round(steps * place / (2 * QUARTERS)) for place in range(2 * QUARTERS + 1)]
        lengths.append(list(zip(edges[:-2], edges[2:], strict=True)))
    singles = np.unique(np.linspace(0, steps, min(steps, MOST_SINGLE_STEPS) + 1).astype(int))
    lengths.append(list(zip(singles[:-1].tolist(), singles[1:].tolist(), strict=True)))
    return lengths


def _systematic(share: FloatArray, count: int, generator: np.random.Generator) -> IntArray:
    """Which member each of ``count`` rollouts is drawn from; shares are kept, ``[count]``."""
    places = (np.arange(count) + generator.random()) / max(count, 1)
    edges = np.cumsum(share)
    member = np.searchsorted(edges, places * edges[-1], side="right")
    return generator.permutation(np.minimum(member, edges.size - 1)).astype(np.int64)
