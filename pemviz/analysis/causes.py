"""What causes the violations: which rollouts, where and when the detector misses, in which bursts.

A burst is a run of misses in neighbouring frames. Those are counted in which at least one miss is
at a state where the outcome matters, up to the violation. The decisive burst of a violation is the
one with the most such misses, of equals the last; all of its misses belong to it, also those
before the outcome matters, since a memory carries them on.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray, row_sums
from pemviz.config.ranges import AtLeastZero, Count, Share, StepIndex
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.types import CERTAIN, VIOLATED, RolloutBatch, ScoredRollouts

CARRIED = 0.99
"""The part of an estimate that its carrying rollouts make up together."""
CHAINS = 10
LOW, HIGH = 0.1, 0.9


def contributions(log_weight: FloatArray, *, violated: BoolArray) -> FloatArray:
    """The share ``[N]`` of the estimate that each rollout contributes; 0 of those that hold.

    Log importance weights ``[N]`` may lack a constant that all share. Shares sum to 1, or to 0 if
    nothing violates.
    """
    share = np.zeros(violated.shape)
    if violated.any():
        failing = log_weight[violated]
        share[violated] = np.exp(failing - log_sum(failing))
    return share


def carrying(share: FloatArray, *, part: float = CARRIED) -> BoolArray:
    """The rollouts ``[N]`` of largest share that together contribute ``part`` of the estimate.

    Rollouts of equal share are all among them or none is.

    A violation that hardly ever happens, such as a pile-up of misses that an early proposal
    drew, violates most but is not among them.
    """
    descending = np.sort(share)[::-1]
    before = np.concatenate([[0.0], np.cumsum(descending)[:-1]])
    needed = descending[(before < part) & (descending > 0.0)]
    return share >= needed[-1] if needed.size else np.zeros(share.shape, dtype=np.bool_)


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

    ``features`` say where outcomes may matter; without them they may everywhere. Steps after a
    violation do not count where the rollouts' memory knows of it.
    """
    chosen = np.flatnonzero(scored.violated)
    if chosen.size == 0:
        return None
    rollouts = scored.rollouts.take(chosen)
    states = rollouts.decision_states()
    deciding = np.ones(rollouts.detected.shape, dtype=np.bool_)
    if features is not None:
        deciding &= features.reacts(states)
    if VIOLATED in states.memory:
        deciding &= ~np.asarray(states.memory[VIOLATED], dtype=np.bool_)
    if CERTAIN in states.memory:  # as of what is absent; an observed miss decides all the same
        deciding &= ~(np.asarray(states.memory[CERTAIN], dtype=np.bool_) & rollouts.detected)
    log_weight = rollouts.log_weight
    return Failures(rollouts, chosen, np.exp(log_weight - log_sum(log_weight)), deciding)


def observed(failures: Failures) -> bool:
    """Whether outcomes were not sampled: misses are certain, as those of the detector itself."""
    certain = failures.rollouts.decision_states().memory.get(CERTAIN)
    return certain is not None and bool(np.any(failures.missed & certain))


def misses_by_distance(failures: Failures, *, edges: Sequence[float]) -> tuple[BandMisses, ...]:
    """Average misses in each band of the gap between ``edges``, ascending."""
    signals = failures.rollouts.decision_states().signals
    every = float(failures.share @ failures.missed.sum(axis=1))
    bands: list[BandMisses] = []
    for low, high in itertools.pairwise(edges):
        value = signals["gap"]
        inside = failures.missed & (value >= low) & (value < high)
        misses = float(failures.share @ inside.sum(axis=1))
        bands.append(BandMisses(low, high, misses, misses / every if every > 0.0 else 0.0))
    return tuple(bands)


def miss_probability_by_step(failures: Failures) -> FloatArray:
    """Probability of a miss that may matter at each step, given a violation, ``[T-1]``."""
    # a product's last digit depends on how the matrix lies in memory
    return failures.share @ np.ascontiguousarray(failures.missed)


def likeliest_chains(failures: Failures) -> tuple[Chain, ...]:
    """The ten chains of misses that carry most of the failure probability."""
    missed = failures.missed
    packed = np.packbits(missed, axis=1)
    _, first, group = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    group = group.ravel()
    share = np.bincount(group, weights=failures.share)
    drawn = np.bincount(group)
    log_p = row_sums(np.where(failures.deciding, failures.rollouts.log_p, 0.0))
    order = np.argsort(-share, kind="stable")[:CHAINS]
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


@dataclass(frozen=True)
class Spread:
    """How a figure differs among violations, weighted by how likely each is.

    Attributes:
        median: Half of the violations have less.
        low: A tenth has less.
        high: A tenth has more.
    """

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Bursts:
    """Bursts of a violation, over violations weighted by how likely each is.

    Attributes:
        dt_s: Time between two frames [s].
        count: Bursts in a violation, on average.
        misses: Misses in them, on average: ``count`` of them begin a burst.
        frames: Misses of the decisive burst.
        begins_s: Time of its first miss [s].
        begins_gap_m: Gap there [m]; ``None`` where the scenario has no gap.
        start: Probability of its first miss under the error model, geometric mean.
        again: Probability of each further miss, geometric mean over them; ``None`` if no
            decisive burst has a second miss.
        whole: Probability of all its further misses together, geometric mean.
    """

    dt_s: AtLeastZero
    count: AtLeastZero
    misses: AtLeastZero
    frames: Spread
    begins_s: Spread
    begins_gap_m: Spread | None
    start: Share
    again: Share | None
    whole: Share


def bursts_of(
    failures: Failures,
    *,
    mattering: BoolArray,
    dt_s: float,
    gap: str | None = "gap",
    turns: int = 1,
) -> Bursts | None:
    """Bursts of violations; ``None`` if no violation has a miss that matters.

    Args:
        failures: Weighted violations.
        mattering: States at which the outcome matters to the scenario, ``[M, T-1]``.
        dt_s: Time between two frames [s].
        gap: The distance, if the scenario has one.
        turns: Outcomes of a step: a burst is one slot's.
    """
    states = failures.rollouts.decision_states()
    missed = ~failures.rollouts.detected
    if VIOLATED in states.memory:
        missed &= ~np.asarray(states.memory[VIOLATED], dtype=np.bool_)
    mattering, missed = (slot_after_slot(v, turns=turns) for v in (missed & mattering, missed))
    of_step, sizes, useful = _runs(missed, mattering)
    counted = useful > 0
    share = np.where(counted.any(axis=1), failures.share, 0.0)
    if not share.sum() > 0.0:
        return None
    share /= share.sum()
    last = useful.shape[1] - 1
    decisive = last - np.argmax(useful[:, ::-1], axis=1)
    rows = np.arange(missed.shape[0])
    inside = missed & (of_step == decisive[:, None])
    first = np.argmax(inside, axis=1)
    frames = sizes[rows, decisive]
    log_p = np.where(inside, slot_after_slot(failures.rollouts.log_p, turns=turns), 0.0)
    log_start = log_p[rows, first]
    log_rest = row_sums(log_p) - log_start
    further = float(share @ (frames - 1))
    gaps = None if gap is None else slot_after_slot(states.signals[gap], turns=turns)
    return Bursts(
        dt_s=dt_s,
        count=float(share @ counted.sum(axis=1)),
        misses=float(share @ np.where(counted, sizes, 0).sum(axis=1)),
        frames=weighted_spread(frames, share),
        begins_s=weighted_spread(first % (missed.shape[1] // turns) * dt_s, share),
        begins_gap_m=None if gaps is None else weighted_spread(gaps[rows, first], share),
        start=min(float(np.exp(float(share @ log_start))), 1.0),
        again=float(np.exp(float(share @ log_rest) / further)) if further > 0.0 else None,
        whole=min(float(np.exp(float(share @ log_rest))), 1.0),
    )


def _runs(missed: BoolArray, useful: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
    """Number of each step's run ``[M, K]``; misses and useful misses of runs ``[M, runs]``."""
    begins = missed.copy()
    begins[:, 1:] &= ~missed[:, :-1]
    of_step = np.maximum(np.cumsum(begins, axis=1) - 1, 0)
    most = int(of_step.max(initial=0)) + 1
    cell = (np.arange(missed.shape[0])[:, None] * most + of_step).ravel()
    size = missed.shape[0] * most

    def totals(chosen: BoolArray) -> IntArray:
        return np.bincount(cell[chosen.ravel()], minlength=size).reshape(-1, most)

    return of_step, totals(missed), totals(useful)


def slot_after_slot(values: AnyArray, *, turns: int) -> AnyArray:
    """Values ``[M, K (T-1)]`` of K turns a step as ``[M, K T]``: slot after slot, 0 after each.

    With one turn a step they are as they were.
    """
    if turns == 1:
        return np.ascontiguousarray(values)
    by_slot = np.ascontiguousarray(values).reshape(len(values), -1, turns).transpose(0, 2, 1)
    between = np.zeros((*by_slot.shape[:2], 1), dtype=values.dtype)
    return np.concatenate([by_slot, between], axis=2).reshape(len(values), -1)


def weighted_spread(values: AnyArray, share: FloatArray) -> Spread:
    """Tenth, half and nine tenths of ``values [M]`` by their shares ``[M]``, which sum to 1."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(share[order])
    places = np.searchsorted(below, np.array([0.5, LOW, HIGH]) * below[-1])
    median, low, high = (float(values[order[min(p, order.size - 1)]]) for p in places)
    return Spread(median=median, low=low, high=high)
