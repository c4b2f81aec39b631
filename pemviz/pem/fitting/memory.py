"""Memory time tau and frailty f from tracks, by maximum likelihood given P(missed | state).

The likelihood of a track is that of :mod:`pemviz.pem.models.memory`, with the obstacle's u
integrated out by the trapezoid rule. Sequences, not observations, are independent; intervals are
those of :mod:`pemviz.pem.fitting.memory_interval`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.tracks import TrackTable
from pemviz.pem.fitting.memory_interval import (
    FRAILTY,
    TAU,
    Surface,
    independence_p_value,
    inflations,
    interval,
)
from pemviz.pem.models.memory import Memory, miss_quantile, persistence

CONFIDENCE = 0.95
TAU_GRID_S = np.concatenate([[0.0], np.geomspace(0.01, 10.0, 31)])
FRAILTY_GRID = np.linspace(0.0, 3.0, 13)
NODES = np.linspace(-6.0, 6.0, 65)
FEWEST_SEQUENCES = 2
CHUNK_TRACKS = 64
BLOCK_ROWS = 4
"""Outcomes of a track whose probabilities are multiplied before a logarithm is taken."""
SMALLEST = 1e-75
"""Below this a probability counts as this, so that the product of a block is no 0."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class MemoryFit:
    """Fitted memory with its uncertainty.

    Attributes:
        memory: The maximum likelihood estimate.
        tau_interval_s: Of tau [s].
        frailty_interval: Of f; ``None`` where f was not fitted.
        confidence: Of each interval.
        sequences: How many independent sequences they rest on.
        observations: How many outcomes.
        nats_independent: Mean negative log-likelihood of an outcome if misses are independent.
        nats: The same with the fitted memory.
        p_value: One-sided, of tau = 0 with f free.
        inflation: Variance of log tau between sequences over the likelihood's own, at least 1.
        efficiency: Share of what the data say of tau that is left since f is not known.
    """

    memory: Memory
    tau_interval_s: tuple[float, float]
    frailty_interval: tuple[float, float] | None
    confidence: float
    sequences: int
    observations: int
    nats_independent: float
    nats: float
    p_value: float
    inflation: float
    efficiency: float


def fit_memory(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    with_frailty: bool = True,
    chosen: BoolArray | None = None,
    on_progress: Progress | None = None,
) -> MemoryFit:
    """Fit tau, and f if asked for.

    Args:
        tracks: n observations.
        logit: Out-of-fold logits of P(detected | state) of a model that saw none of the
            observation's own sequence, ``[n]``.
        with_frailty: Whether f is fitted too; else it is 0.
        chosen: Which outcomes count, ``[n]``; all if ``None``.
        on_progress: Told (tracks done, tracks in all).

    Raises:
        PemError: Fewer than two sequences, or no obstacle is seen twice.
    """
    count = int(np.unique(tracks.sequence).size)
    if count < FEWEST_SEQUENCES:
        raise PemError("a memory needs tracks of at least two sequences for its interval")
    if not tracks.follows.any():
        raise PemError("no obstacle is observed twice: there is nothing to fit a memory to")
    frailties = FRAILTY_GRID if with_frailty else FRAILTY_GRID[:1]
    surface = log_likelihoods(
        tracks,
        logit,
        taus_s=TAU_GRID_S,
        frailties=frailties,
        chosen=chosen,
        on_progress=on_progress,
    )
    return _fitted(
        surface,
        frailties,
        step_s=float(np.median(tracks.since_s[tracks.follows])),
        observations=len(tracks) if chosen is None else int(np.count_nonzero(chosen)),
    )


def _fitted(
    surface: FloatArray, frailties: FloatArray, *, step_s: float, observations: int
) -> MemoryFit:
    """The fit of log likelihoods of sequences ``[S, taus, frailties]``."""
    count = surface.shape[0]
    whole = Surface(surface.sum(axis=0), TAU_GRID_S, frailties)
    scale = inflations(surface, whole, step_s=step_s)
    low_high = [
        interval(whole, axis, inflation=float(scale[axis]), sequences=count, confidence=CONFIDENCE)
        for axis in (TAU, FRAILTY)
    ]
    return MemoryFit(
        memory=Memory(tau_s=whole.tau_s, frailty=whole.frailty),
        tau_interval_s=low_high[TAU],
        frailty_interval=low_high[FRAILTY] if frailties.size > 1 else None,
        confidence=CONFIDENCE,
        sequences=count,
        observations=observations,
        nats_independent=-float(surface[:, 0, 0].sum()) / observations,
        nats=-whole.peak.height / observations,
        p_value=independence_p_value(whole, inflation=float(scale[TAU]), sequences=count),
        inflation=float(scale[TAU]),
        efficiency=whole.efficiency,
    )


def log_likelihoods(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    taus_s: FloatArray,
    frailties: FloatArray,
    chosen: BoolArray | None = None,
    on_progress: Progress | None = None,
) -> FloatArray:
    """Log likelihood of each sequence ``[S, taus, frailties]`` [nats].

    Args:
        tracks: n observations of S sequences.
        logit: ``[n]`` logits of P(detected | state).
        taus_s: Memory times [s].
        frailties: Values of f.
        chosen: Which outcomes count, ``[n]``; all if ``None``.
        on_progress: Told (tracks done, tracks in all).
    """
    sequences, of_sequence = np.unique(tracks.sequence, return_inverse=True)
    result = np.zeros((sequences.size, taus_s.size, frailties.size))
    starts = np.flatnonzero(~tracks.follows)
    ends = np.append(starts[1:], len(tracks))
    quantile = miss_quantile(logit)
    counts = np.ones(len(tracks), dtype=np.bool_) if chosen is None else chosen
    for first in range(0, starts.size, CHUNK_TRACKS):
        last = min(first + CHUNK_TRACKS, starts.size)
        rows = slice(int(starts[first]), int(ends[last - 1]))
        inner = starts[first:last] - starts[first]
        table = _tracks_log_likelihood(
            tracks, quantile, counts, rows, inner, taus_s=taus_s, frailties=frailties
        )
        np.add.at(result, of_sequence[starts[first:last]], table)
        if on_progress is not None:
            on_progress(last, starts.size)
    return result


def _tracks_log_likelihood(
    tracks: TrackTable,
    quantile: FloatArray,
    chosen: BoolArray,
    rows: slice,
    starts: IntArray,
    *,
    taus_s: FloatArray,
    frailties: FloatArray,
) -> FloatArray:
    """Log likelihood of each track that begins at ``starts``, ``[tracks, taus, frailties]``."""
    missed, left_out = ~tracks.detected[rows], ~chosen[rows]
    repeats = (missed == tracks.missed_before[rows]) | left_out
    blocks, of_track = _blocks(starts, rows=missed.size)
    since_s = tracks.since_s[rows]
    table = np.empty((starts.size, taus_s.size, frailties.size))
    for column, frailty in enumerate(frailties):
        nodes = NODES if frailty > 0.0 else np.zeros(1)
        moved = quantile[rows, None] * np.sqrt(1.0 + frailty**2) + frailty * nodes
        own = ndtr(np.where(missed[:, None], moved, -moved))
        own[left_out] = 1.0
        after = np.empty_like(own)
        log_weight = -0.5 * nodes**2
        log_weight = log_weight - np.log(np.exp(log_weight).sum())
        for row, tau_s in enumerate(taus_s):
            rho = persistence(since_s, float(tau_s))
            np.multiply(own, (1.0 - rho)[:, None], out=after)
            after += (rho * repeats)[:, None]
            np.maximum(after, SMALLEST, out=after)
            log_block = np.log(np.multiply.reduceat(after, blocks, axis=0))
            log_track = np.add.reduceat(log_block, of_track, axis=0)
            joint = log_track + log_weight
            largest = joint.max(axis=1, keepdims=True)
            table[:, row, column] = largest[:, 0] + np.log(np.exp(joint - largest).sum(axis=1))
    return table


def _blocks(starts: IntArray, *, rows: int) -> tuple[IntArray, IntArray]:
    """First rows of blocks that stay within a track, and which block is each track's first."""
    sizes = np.diff(np.append(starts, rows))
    count = -(-sizes // BLOCK_ROWS)
    of_track = np.cumsum(count) - count
    within = np.arange(int(count.sum())) - np.repeat(of_track, count)
    return np.repeat(starts, count) + BLOCK_ROWS * within, of_track
