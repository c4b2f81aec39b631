"""What a network learns from a large stage, kept batch by batch while its rollouts are drawn."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from pemviz.arrays import Batch, BoolArray, FloatArray
from pemviz.proposals.gap_network_fit import OutcomeTable, table_of
from pemviz.proposals.outcome_sums import OutcomeSums
from pemviz.sampling.elite_threshold import VIOLATION_THRESHOLD, elite_threshold, elites
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.types import ScoredRollouts


@dataclass(frozen=True)
class Learned:
    """What a stage teaches.

    Attributes:
        table: Weighted outcomes.
        threshold: The level of robustness below which they lie; ``None``: all are learned from.
        elites: How many rollouts do.
    """

    table: OutcomeTable
    threshold: float | None
    elites: int


class Lesson(Protocol):
    """What is learned from a stage, as far as it is drawn."""

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        ...

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        ...


@dataclass(frozen=True)
class FromAll:
    """All rollouts are learned from alike, each as soon as it is drawn.

    Attributes:
        weight: Of each.
        sums: Of their outcomes.
    """

    weight: float
    sums: OutcomeSums

    @staticmethod
    def of(count: int) -> "FromAll":
        """Before the first of ``count`` rollouts."""
        weight = float(smoothed_weights(np.zeros(count), alpha=0.0)[0])
        return FromAll(weight, OutcomeSums.of_none())

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        count = batch.rollouts.count
        sums = self.sums.with_rollouts(
            gap_m=_gap_m(batch),
            detected=batch.rollouts.detected,
            rollout_weight=np.full(count, self.weight),
        )
        return replace(self, sums=sums)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        return Learned(table_of(self.sums), None, robustness.size)


@dataclass(frozen=True)
class Candidate(Batch):
    """Rollouts that may turn out to be elites.

    Attributes:
        robustness: ``[M]``.
        log_weight: ``[M]`` [nats].
        gap_m: At which perception acted, ``[M, T-1]``.
        detected: Its outcomes there, ``[M, T-1]``.
    """

    robustness: FloatArray
    log_weight: FloatArray
    gap_m: FloatArray
    detected: BoolArray


@dataclass(frozen=True)
class FromElites:
    """Elites are learned from; who is one is known once all are drawn.

    A rollout above the level of those drawn so far is none whatever comes.

    Attributes:
        sigma: Elite quantile.
        alpha: Exponent of the weights.
        least: So many rollouts at least are elites.
        held: Candidates, in the order in which they were drawn.
        level: No rollout above it is one.
        settled: How many candidates there were when the level was last lowered.
    """

    sigma: float
    alpha: float
    least: int
    held: tuple[Candidate, ...] = ()
    level: float = np.inf
    settled: int = 0

    @staticmethod
    def of(count: int, *, sigma: float, alpha: float) -> "FromElites":
        """Before the first of ``count`` rollouts."""
        places = np.arange(count, dtype=np.float64)
        least = int(elites(places, threshold=elite_threshold(places, sigma=sigma)).sum())
        return FromElites(sigma=sigma, alpha=alpha, least=least)

    def extended(self, batch: ScoredRollouts) -> Self:
        """With the next rollouts."""
        rollouts = batch.rollouts
        rows = np.flatnonzero(batch.robustness <= self.level)
        some = Candidate(
            robustness=batch.robustness[rows],
            log_weight=rollouts.log_weight[rows],
            gap_m=_gap_m(batch)[rows],
            detected=rollouts.detected[rows],
        )
        grown = replace(self, held=(*self.held, some))
        known = sum(part.robustness.size for part in grown.held)
        return grown if known < max(self.least, 2 * self.settled) else grown._lowered()

    def _lowered(self) -> Self:
        """With the level of those drawn so far, and the candidates at or below it."""
        robustness = np.concatenate([part.robustness for part in self.held])
        level = float(np.partition(robustness, self.least - 1)[self.least - 1])
        level = max(level, VIOLATION_THRESHOLD)
        held = tuple(part.take(part.robustness <= level) for part in self.held)
        left = sum(part.robustness.size for part in held)
        return replace(self, held=held, level=level, settled=left)

    def learned(self, robustness: FloatArray) -> Learned:
        """What the stage teaches, once all its rollouts ``[N]`` are drawn."""
        threshold = elite_threshold(robustness, sigma=self.sigma)
        chosen = [part.take(elites(part.robustness, threshold=threshold)) for part in self.held]
        log_weight = np.concatenate([part.log_weight for part in chosen])
        weight = smoothed_weights(log_weight, alpha=self.alpha)
        sums, parts = OutcomeSums.of_none(), _split(weight, chosen)
        for part, rollout_weight in zip(chosen, parts, strict=True):
            sums = sums.with_rollouts(
                gap_m=part.gap_m, detected=part.detected, rollout_weight=rollout_weight
            )
        return Learned(table_of(sums), threshold, log_weight.size)


def _split(weight: FloatArray, parts: list[Candidate]) -> Iterator[FloatArray]:
    ends = np.cumsum([part.robustness.size for part in parts])
    return iter(np.split(weight, ends[:-1]))


def _gap_m(batch: ScoredRollouts) -> FloatArray:
    return batch.rollouts.decision_states().signals["gap"]
