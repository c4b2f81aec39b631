"""Broad families of proposals that nothing is fitted to: they explore, and they stay as defence.

Of outcomes, each member raises the probability of a miss towards a ceiling, by a strength of its
own and within a window of steps of its own; of latents, it moves one up or down by a few strengths.
An exploration proposal's outcomes, latents at the start and noise come from a member of a family
each, one independent of the other, so that likelihoods multiply. A failure mode that fitted
proposals do not know of is still met by some member, which is what the families are for (defensive
importance sampling: Hesterberg 1995).
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, log_sum_exp, softplus
from pemviz.proposals.offset_logistic import StateFeatures, acting
from pemviz.types import RolloutBatch, StateBatch

CEILING_LOGIT = 3.0
"""Logit of the largest probability, 0.95, that an exploration proposal raises (or a detection's,
lowers) to."""
EVERYWHERE = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, -1.0)
"""Strengths of the members whose window is the whole rollout."""
WINDOWED = (0.6, 1.0)
"""Strengths within windows of a half, a quarter and an eighth of the rollout."""
HALVES = (4, 8, 16)
"""Of the windows of each length, in the rollout."""
WINDOWED_SHARE = 0.45
SLOT_SHARE = 0.5
"""Of a family where several slots take turns: of members that raise one slot's errors alone."""
LATENT_STRENGTHS = tuple(sign * size for size in (2.0, 4.0, 6.0) for sign in (1.0, -1.0))
"""By how much a latent at the start is moved; of noise, the sum over a window by the square root
of its steps: by so many standard deviations."""
UNMOVED_SHARE = 0.4
"""Of rollouts whose latents stay, at the start and likewise in the steps."""
MOST_SINGLE_STEPS = 128
CHUNK_ROLLOUTS = 512


@dataclass(frozen=True, eq=False)
class ExplorationFamily:
    """Members F, each a strength and a window of steps.

    A strength s in (0, 1] raises the logit u of a miss to u + s max(c - u, 0), one below 0 lowers
    it to u + s max(u + c, 0), with c = 3; 0 is the error model.

    Attributes:
        strength: ``[F]``, from -1 to 1.
        first: First step of the window, ``[F]``.
        stop: The step after its last, ``[F]``.
        share: How often a rollout is sampled from each, ``[F]``; sums to 1.
        slot: Whose turns it raises alone, ``[F]``, -1 for all; ``None`` where there is one slot.
        turns: Slots that take turns, each in one of so many steps.
    """

    strength: FloatArray
    first: IntArray
    stop: IntArray
    share: FloatArray
    slot: IntArray | None = None
    turns: int = 1

    @staticmethod
    def over(steps: int, *, turns: int = 1) -> "ExplorationFamily":
        """The family for rollouts of ``steps`` outcomes, of slots that take ``turns``."""
        lengths = [_overlapping(steps, halves=count) for count in HALVES if count <= steps]
        members = [(strength, 0, steps) for strength in EVERYWHERE]
        share = [(1.0 - WINDOWED_SHARE if lengths else 1.0) / len(members)] * len(members)
        for windows in lengths:
            equally = [(s, first, stop) for first, stop in windows for s in WINDOWED]
            members += equally
            share += [WINDOWED_SHARE / len(lengths) / len(equally)] * len(equally)
        strength, first, stop = (np.array(column) for column in zip(*members, strict=True))
        if turns == 1:
            return ExplorationFamily(strength, first, stop, np.array(share))
        alone = np.repeat(np.arange(turns), len(EVERYWHERE))
        return ExplorationFamily(
            strength=np.concatenate([strength, np.tile(EVERYWHERE, turns)]),
            first=np.pad(first, (0, alone.size)),
            stop=np.pad(stop, (0, alone.size), constant_values=steps),
            share=np.concatenate(
                [(1.0 - SLOT_SHARE) * np.array(share), np.full(alone.size, SLOT_SHARE / alone.size)]
            ),
            slot=np.concatenate([np.full(strength.size, -1), alone]),
            turns=turns,
        )

    def sampled(
        self,
        count: int,
        generator: np.random.Generator,
        *,
        features: StateFeatures,
        violated: str,
        of: int | None = None,
    ) -> "ExplorationProposal":
        """Members for ``count`` rollouts, systematically so that shares are kept, in random order.

        Args:
            count: Number of rollouts.
            generator: What they are sampled with.
            features: Tell where the scenario reacts.
            violated: Name of the memory that says whether a rollout has violated already.
            of: So many rollouts in all: those after the first ``count`` have no window.
        """
        member = _systematic(self.share, count, generator)
        rest = (0, (of or count) - count)
        return ExplorationProposal(
            strength=np.pad(self.strength[member], rest),
            first=np.pad(self.first[member], rest),
            stop=np.pad(self.stop[member], rest),
            features=features,
            violated=violated,
            slot=None if self.slot is None else np.pad(self.slot[member], rest),
            turns=self.turns,
        )

    def log_ratio(self, rollouts: RolloutBatch, acts: BoolArray) -> FloatArray:
        """Log of the family's likelihood over the error model's, ``[N]``.

        Args:
            rollouts: N rollouts.
            acts: Where proposals may leave the error model, ``[N, T-1]``.
        """
        count, steps = rollouts.detected.shape
        under_pem = -rollouts.pem_logit[acts]
        sign = np.where(rollouts.detected[acts], 1.0, -1.0)
        by_pem = softplus(sign * under_pem)
        by_member = np.zeros((self.strength.size, count))
        step = np.zeros((count, steps))
        sums = np.zeros((steps + 1, count))
        for strength in np.unique(self.strength[self.strength != 0.0]):
            step[acts] = by_pem - softplus(sign * raised(under_pem, strength))
            for raising, chosen in self._of_strength(strength):
                np.cumsum((step * raising).T if self.turns > 1 else step.T, axis=0, out=sums[1:])
                by_member[chosen] = sums[self.stop[chosen]] - sums[self.first[chosen]]
        return np.asarray(log_sum_exp(by_member + np.log(self.share)[:, None], axis=0))

    def _of_strength(self, strength: float) -> Iterator[tuple[BoolArray, IntArray]]:
        """Members of a strength by whose turns they raise: which steps ``[T-1]``, which members."""
        steps, same = int(self.stop.max()), self.strength == strength
        for slot in (-1,) if self.slot is None else range(-1, self.turns):
            chosen = np.flatnonzero(same if self.slot is None else same & (self.slot == slot))
            yield (np.arange(steps) % self.turns == slot) | (slot < 0), chosen


@dataclass(frozen=True, eq=False)
class ExplorationProposal:
    """Members of the family, one for each of N rollouts.

    Attributes:
        strength: ``[N]``.
        first: First step of the window, ``[N]``.
        stop: The step after its last, ``[N]``.
        features: Tell where the scenario reacts; elsewhere an exploration proposal is the error
            model.
        violated: Name of the memory that says whether a rollout has violated already.
        slot: As :class:`ExplorationFamily` has it, ``[N]``.
        turns: Likewise.
    """

    strength: FloatArray
    first: IntArray
    stop: IntArray
    features: StateFeatures
    violated: str
    slot: IntArray | None = None
    turns: int = 1

    def logit(self, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[N]``, at states ``[N]`` of the same N rollouts."""
        acts = acting(self.features, states, pem_logit.shape, violated=self.violated)
        return self.logit_where(acts, states, pem_logit)

    def logit_where(self, acts: BoolArray, states: StateBatch, pem_logit: FloatArray) -> FloatArray:
        """The same, of which ``acts [N]`` says who may leave the error model."""
        step = states.step * 1.0
        within = acts & (self.first <= step) & (self.stop > step)
        if self.slot is not None:
            within &= (self.slot < 0) | (self.slot == states.step % self.turns)
        raised_logit = -raised(-pem_logit, self.strength)
        return np.where(within, raised_logit, pem_logit)

    def rows(self, rows: slice) -> Self:
        """The members of some of the rollouts."""
        return replace(
            self,
            strength=self.strength[rows],
            first=self.first[rows],
            stop=self.stop[rows],
            slot=None if self.slot is None else self.slot[rows],
        )

    def arrays(self) -> Mapping[str, AnyArray]:
        """Strengths, windows and, where there are several, slots."""
        own = {"strength": self.strength, "first": self.first, "stop": self.stop}
        return own if self.slot is None else {**own, "slot": self.slot}


def raised(miss_logit: FloatArray, strength: FloatArray | float) -> FloatArray:
    """The logit of a miss under an exploration proposal of a strength."""
    up = (CEILING_LOGIT - miss_logit).clip(0.0)
    down = (miss_logit + CEILING_LOGIT).clip(0.0)
    return miss_logit + strength * np.where(strength > 0.0, up, down)


def _overlapping(steps: int, *, halves: int) -> list[tuple[int, int]]:
    """Windows of the steps, each overlapping the next by half: one fewer than ``halves``."""
    edges = [round(steps * place / halves) for place in range(halves + 1)]
    return list(zip(edges[:-2], edges[2:], strict=True))


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
        moved = np.concatenate([np.eye(start) * s for s in LATENT_STRENGTHS]) if start else []
        means = np.vstack([np.zeros((1, start)), *moved])
        rest = len(means) - 1
        at_start = np.array([UNMOVED_SHARE] + [(1.0 - UNMOVED_SHARE) / max(rest, 1)] * rest)
        members = list(_members(steps, noise))
        latent, mean, first, stop, share = zip((0, 0.0, 0, steps, 1.0), *members, strict=True)
        shares = np.array(share)
        shares[1:] *= (1.0 - UNMOVED_SHARE) / max(float(shares[1:].sum()), 1e-300)
        shares[0] = UNMOVED_SHARE if members else 1.0
        return LatentFamily(
            start=means,
            start_share=at_start if start else np.ones(1),
            latent=np.array(latent, dtype=np.int64),
            mean=np.array(mean),
            first=np.array(first, dtype=np.int64),
            stop=np.array(stop, dtype=np.int64),
            share=shares,
            noise=noise,
        )

    def sampled(
        self, count: int, generator: np.random.Generator, *, of: int
    ) -> "LatentExploration":
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
        start = np.ascontiguousarray(start)  # a row adds up the same however it lies in memory
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


def _members(steps: int, noise: int) -> Iterator[tuple[int, float, int, int, float]]:
    """Latent, mean, window and share, not normalised; windows of each length have as much.

    They are of all steps, of a quarter of them, each overlapping the next, and single steps.
    """
    singles = np.unique(np.linspace(0, steps, min(steps, MOST_SINGLE_STEPS) + 1).astype(int))
    pairs = list(itertools.pairwise(singles.tolist()))
    quarters = [_overlapping(steps, halves=8)] if steps >= 8 else []
    for windows in ([(0, steps)], *quarters, pairs):
        for first, stop in windows:
            for strength in LATENT_STRENGTHS:
                for latent in range(noise):
                    mean = strength / (stop - first) ** 0.5
                    yield latent, mean, first, stop, 1.0 / len(windows)


def _systematic(share: FloatArray, count: int, generator: np.random.Generator) -> IntArray:
    """Which member each of ``count`` rollouts is sampled from; shares are kept, ``[count]``."""
    places = (np.arange(count) + generator.random()) / max(count, 1)
    edges = np.cumsum(share)
    member = np.searchsorted(edges, places * edges[-1], side="right")
    return generator.permutation(np.minimum(member, edges.size - 1)).astype(np.int64)
