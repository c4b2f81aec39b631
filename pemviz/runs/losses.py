"""Rollouts of a run that could not be simulated: how many, and how likely one is lost.

With w_i the weights that the estimate averages, or each rollout's own where it averages none of
what holds::

    P(lost) = 1 / N sum_i 1[i is lost before it violates] w_i
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.runs.result import LostRollout, LostRollouts
from pemviz.sampling.estimates.diagnostics import lost_rollouts
from pemviz.sampling.problem import Problem, violated_before
from pemviz.sampling.rollouts.losing import lost_at, lost_rows
from pemviz.types import Estimate, StageResult, numbers_of

LISTED = 20


@dataclass(frozen=True)
class LostWeights:
    """What is lost of some repetitions.

    Attributes:
        simulated: Rollouts, lost ones among them.
        count: Of these, lost ones.
        weight: Sum of the weights of those that had not violated before.
        square: Sum of their squares.
        first: The first of the lost ones.
    """

    simulated: int = 0
    count: int = 0
    weight: float = 0.0
    square: float = 0.0
    first: tuple[LostRollout, ...] = ()

    def __add__(self, other: "LostWeights") -> "LostWeights":
        return LostWeights(
            self.simulated + other.simulated,
            self.count + other.count,
            self.weight + other.weight,
            self.square + other.square,
            (*self.first, *other.first)[:LISTED],
        )

    def told(self, problem: Problem) -> LostRollouts | None:
        """What a result says of it; ``None`` if nothing is lost."""
        if self.count == 0:
            return None
        mean = self.weight / self.simulated
        variance = max(self.square / self.simulated - mean**2, 0.0) / self.simulated
        return LostRollouts(
            counts_as="none" if problem.lost == "none" else "violation",
            count=self.count,
            simulated=self.simulated,
            probability=mean,
            std_error=math.sqrt(variance),
            first=self.first,
        )


@dataclass(frozen=True)
class LostOfRepetition:
    """What is lost of a repetition's stages so far.

    Attributes:
        simulated: Rollouts.
        count: Of these, lost ones.
        row: Index in the repetition of each that had not violated before, ``[L]``.
        log_weight: Of each its own, ``[L]`` [nats].
        first: The first of the lost ones.
    """

    simulated: int = 0
    count: int = 0
    row: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    log_weight: FloatArray = field(default_factory=lambda: np.empty(0))
    first: tuple[LostRollout, ...] = ()

    def with_stage(self, stage: StageResult, problem: Problem) -> "LostOfRepetition":
        """With what is lost of one more."""
        rollouts, simulated = stage.scored.rollouts, self.simulated + stage.count
        place = np.flatnonzero(lost_rows(rollouts))
        if place.size == 0:
            return replace(self, simulated=simulated)
        lost, row = rollouts.take(place), numbers_of(rollouts.count, stage.sampled)[place]
        holds = ~violated_before(problem.monitor, lost)
        steps = lost_at(lost)[:LISTED] // problem.turns
        listed = zip(row[:LISTED].tolist(), steps.tolist(), strict=True)
        own = tuple(LostRollout(stage.repetition, stage.stage, n, step) for n, step in listed)
        return LostOfRepetition(
            simulated,
            self.count + place.size,
            np.concatenate([self.row, self.simulated + row[holds]]),
            np.concatenate([self.log_weight, lost.log_weight[holds]]),
            (*self.first, *own)[:LISTED],
        )

    def weighed(self, pooled: FloatArray | None = None) -> LostWeights:
        """By the log weights of all rollouts ``[N]``, unless some are not known, or their own."""
        log_weight = self.log_weight
        if pooled is not None and not np.isnan(pooled[self.row]).any():
            log_weight = pooled[self.row]
        weight = np.exp(log_weight)
        square = float((weight**2).sum())
        return LostWeights(self.simulated, self.count, float(weight.sum()), square, self.first)


def with_lost(estimate: Estimate, lost: LostRollouts | None) -> Estimate:
    """An estimate with what is to be said of the rollouts that were lost."""
    if lost is None:
        return estimate
    low, high = lost.ends(estimate.probability)
    found = lost_rollouts(
        counts_as=lost.counts_as,
        count=lost.count,
        rollouts=lost.simulated,
        otherwise=low if lost.counts_as == "violation" else high,
        std_error=estimate.std_error or 0.0,
        probability=lost.probability,
    )
    return replace(estimate, diagnostics=(*found, *estimate.diagnostics))
