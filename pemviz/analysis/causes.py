"""What causes the violations: where and when the detector misses, and in which chains."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums
from pemviz.config.ranges import AtLeastZero, Count, Share, StepIndex
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.simulators.absorbing import VIOLATED
from pemviz.types import CERTAIN, RolloutBatch, ScoredRollouts

CHAINS = 10


@dataclass(frozen=True)
class Failures:
    """The violating rollouts, weighted by how likely each is given a violation.

    Attributes:
        rollouts: M rollouts.
        index: Where each stands in its batch, ``[M]``.
        share: Sums to 1, ``[M]``.
        deciding: Steps whose outcome may have mattered, ``[M, T-1]``.
    """

    rollouts: RolloutBatch
    index: IntArray
    share: FloatArray
    deciding: BoolArray

    @property
    def missed(self) -> BoolArray:
        """Misses at deciding steps, ``[M, T-1]``."""
        return ~self.rollouts.detected & self.deciding


@dataclass(frozen=True)
class BandMisses:
    """Misses within a band of distances.

    Attributes:
        low: Lower edge [unit of the signal], included.
        high: Upper edge, excluded.
        misses: How many a violating rollout has on average.
        share: Share of all its misses.
    """

    low: float
    high: float
    misses: AtLeastZero
    share: Share


@dataclass(frozen=True)
class Chain:
    """Violating rollouts that miss at the same deciding steps.

    Attributes:
        missed_steps: Which steps; with slots, that of each error.
        share: Share of the failure probability.
        rollouts: How many rollouts show it.
        nll: Negative log likelihood of the deciding outcomes under the error model [nats].
        likeliest: Index in its batch of the rollout that contributes most to it.
        slots: Names of the slots whose errors they are, as many; empty without several slots.
    """

    missed_steps: tuple[StepIndex, ...]
    share: Share
    rollouts: Count
    nll: float
    likeliest: Count | None = None
    slots: tuple[str, ...] = ()


def failures_of(
    scored: ScoredRollouts, *, features: StateFeatures | None = None
) -> Failures | None:
    """The violating rollouts of a batch; ``None`` if nothing failed.

    Args:
        scored: Rollouts with the weights they were drawn with.
        features: Says where outcomes may matter; without it they may everywhere. Steps after
            a violation do not count where the rollouts' memory knows of it.
    """
    chosen = np.flatnonzero(scored.violated)
    if chosen.size == 0:
        return None
    rollouts = scored.rollouts.take(chosen)
    states = rollouts.decision_states()
    deciding = np.ones(rollouts.detected.shape, dtype=np.bool_)
    if features is not None:
        deciding &= features.reacts(states)
    for over in (VIOLATED, CERTAIN):
        if over in states.memory:
            deciding &= ~np.asarray(states.memory[over], dtype=np.bool_)
    log_weight = rollouts.log_weight
    return Failures(rollouts, chosen, np.exp(log_weight - log_sum(log_weight)), deciding)


def misses_by_distance(
    failures: Failures, *, edges: Sequence[float], signal: str = "gap"
) -> tuple[BandMisses, ...]:
    """Average misses in each band between ``edges`` (ascending), by the signal's value."""
    signals = failures.rollouts.decision_states().signals
    every = float(failures.share @ failures.missed.sum(axis=1))
    bands: list[BandMisses] = []
    for low, high in itertools.pairwise(edges):
        value = signals[signal]
        inside = failures.missed & (value >= low) & (value < high)
        misses = float(failures.share @ inside.sum(axis=1))
        bands.append(BandMisses(low, high, misses, misses / every if every > 0.0 else 0.0))
    return tuple(bands)


def miss_probability_by_step(failures: Failures) -> FloatArray:
    """Probability of a miss that may matter at each step, given a violation, ``[T-1]``."""
    # a product's last digit depends on how the matrix lies in memory
    return failures.share @ np.ascontiguousarray(failures.missed)


def likeliest_chains(failures: Failures, *, count: int = CHAINS) -> tuple[Chain, ...]:
    """The ``count`` chains of misses that carry most of the failure probability."""
    missed = failures.missed
    packed = np.packbits(missed, axis=1)
    _, first, group = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    share = np.bincount(group, weights=failures.share)
    drawn = np.bincount(group)
    log_p = row_sums(np.where(failures.deciding, failures.rollouts.log_p, 0.0))
    order = np.argsort(-share, kind="stable")[:count]
    return tuple(
        Chain(
            missed_steps=tuple(int(step) for step in np.flatnonzero(missed[first[chain]])),
            share=float(share[chain]),
            rollouts=int(drawn[chain]),
            nll=float(-log_p[first[chain]]),
            likeliest=int(
                failures.index[np.argmax(np.where(group == chain, failures.share, -1.0))]
            ),
        )
        for chain in order
    )
