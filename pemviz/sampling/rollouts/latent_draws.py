"""Latents of rollouts: standard normals from a source of their own, and the means they get."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray
from pemviz.latents import LatentCounts, Latents, StandardNormals, log_moved
from pemviz.proposals.latent_moves import log_waiting
from pemviz.types import MovesLatents, Proposal, StateBatch

SPAWN_KEY, CHOICE_KEY = 2**32 - 1, 2**32 - 2
"""Of the children of a stage's seeds that latents come from; others count from 0."""


@runtime_checkable
class ShapesLatents(MovesLatents, Protocol):
    """A proposal that says more of how it moves latents."""

    def start_sd(self, count: int) -> FloatArray:
        """Spreads of half of the starts, ``[N, S]``; 1 is that of the model."""
        ...

    def noise_sd(self, count: int) -> FloatArray:
        """Spreads of half of the noise that is moved, ``[N, M]``; 1 is that of the model."""
        ...

    def once(self, count: int) -> BoolArray:
        """Which of ``count`` rollouts have one step's noise moved at most, ``[N]``.

        Their shares are given that none was moved before.
        """
        ...


@runtime_checkable
class ChoosesStart(Proposal, Protocol):
    """A proposal that chooses where rollouts start."""

    def chosen_start(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latents ``[N, S]`` made of standard normals ``[N, S]``, and log p - log q, ``[N]``."""
        ...


class NormalSource:
    """Standard normals for a stage's rollouts, one batch after the other.

    They have a random generator of their own: outcomes are the same with latents and without.
    A rollout's do not depend on how many are drawn at a time.
    """

    def __init__(self, seeds: np.random.SeedSequence, *, counts: LatentCounts, steps: int) -> None:
        """Prepare.

        Args:
            seeds: Of the stage.
            counts: Latents of a rollout.
            steps: At so many, ``counts.noise`` each.
        """
        self._generator = np.random.default_rng(_child(seeds, SPAWN_KEY))
        self._choices = np.random.default_rng(_child(seeds, CHOICE_KEY))
        self._counts, self._steps = counts, steps

    def draw(self, count: int) -> StandardNormals | None:
        """For the next ``count`` rollouts; ``None`` if they take none."""
        if not self._counts:
            return None
        at_start, each = self._counts.at_start, self._counts.noise
        a_step = each + (each > 0)
        normals = self._generator.standard_normal((count, at_start + self._steps * a_step))
        by_step = normals[:, at_start:].reshape(count, self._steps, a_step)
        return StandardNormals(
            start=normals[:, :at_start],
            noise=by_step[..., :each],
            choice=by_step[..., each:].sum(-1),
            spread_choice=self._choices.standard_normal(count),
        )


def _child(seeds: np.random.SeedSequence, key: int) -> np.random.SeedSequence:
    keys = (*seeds.spawn_key, key)
    return np.random.SeedSequence(seeds.entropy, spawn_key=keys, pool_size=seeds.pool_size)


@dataclass(frozen=True)
class LatentTrack:
    """The latents of N rollouts while they are drawn, a step of all in one piece.

    Attributes:
        normals: Without their means.
        latents: As far as they are drawn; written to.
        turns: Outcomes of a step: noise comes with the last of them.
        once: In which rollouts one step's noise is moved at most, ``[N]``.
        log_waits: Log of how likely it is that none was yet, ``[N]``; written to.
    """

    normals: StandardNormals
    latents: Latents
    turns: int
    once: BoolArray
    log_waits: FloatArray

    @staticmethod
    def begun(normals: StandardNormals, proposal: Proposal, *, outcomes: int) -> "LatentTrack":
        """With those at the start.

        Args:
            normals: Of N rollouts.
            proposal: What the means come from.
            outcomes: Of a rollout.
        """
        count, steps, _ = normals.noise.shape
        mean, once = np.zeros(normals.start.shape), np.zeros(count, dtype=np.bool_)
        if isinstance(proposal, MovesLatents):
            moved = proposal.start_mean(count)  # seeds, which come after, stay
            mean[:, : moved.shape[1]] = moved
        none = np.zeros(normals.noise.shape)
        shares, one, sd = np.ones((count, steps)), np.ones(none.shape), np.ones(mean.shape)
        if isinstance(proposal, ShapesLatents):
            shaped = proposal.start_sd(count)
            sd[:, : shaped.shape[1]] = shaped
        narrow = ndtr(normals.spread_choice) < 0.5
        start = np.where(narrow[:, None], sd * normals.start, normals.start) + mean
        choice = None
        if isinstance(proposal, ChoosesStart):
            start, choice = proposal.chosen_start(normals.start)
        latents = Latents(start, mean, sd, none, none, shares, one, choice)
        blank = latents.map(lambda values: np.array(values, order="F"))
        if isinstance(proposal, ShapesLatents):
            once = proposal.once(count)
            blank.noise_sd[:] = proposal.noise_sd(count)[:, None, :]
        return LatentTrack(normals, blank, outcomes // steps, once, np.zeros(count))

    def noise(
        self, step: int, states: StateBatch, detected: BoolArray, proposal: Proposal
    ) -> FloatArray | None:
        """Of the step that follows an outcome, ``[N, M]``; ``None`` before a step's last outcome.

        Args:
            step: The outcome's index.
            states: At which it was, ``[N]``.
            detected: The outcome, ``[N]``.
            proposal: What the means come from.
        """
        if (step + 1) % self.turns:
            return None
        of_step, latents, normals = step // self.turns, self.latents, self.normals
        noise = normals.noise[:, of_step]
        if noise.shape[1] and isinstance(proposal, MovesLatents):
            mean, share = proposal.noise_mean(states, detected)
            due = np.where(self.once, share * np.exp(self.log_waits), share)
            latents.noise_mean[:, of_step], latents.noise_share[:, of_step] = mean, due
            chance, sd = ndtr(normals.choice[:, of_step]), latents.noise_sd[:, of_step]
            noise = np.where((chance < 0.5 * due)[:, None], sd * noise, noise)
            noise = noise + np.where((chance < due)[:, None], mean, 0.0)
            self._wait(share, log_moved(noise, mean, sd))
        latents.noise[:, of_step] = noise
        return latents.noise[:, of_step]

    def _wait(self, share: FloatArray, moved: FloatArray) -> None:
        """After a step that was moved with a share, given none before, whose log ratio is known."""
        if self.once.any():
            after = log_waiting(self.log_waits, np.where(self.once, share, 0.0), moved)
            self.log_waits[:] = after
