"""How misses follow each other on video, and how well a fitted memory tells it."""

from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.tracks import TrackTable
from pemviz.pem.fitting.memory import MemoryFit, fit_memory
from pemviz.pem.models.memory import (
    FRAILTY_MEANS,
    TAU_MEANS,
    Memory,
    frail_logit,
    persistence,
    remembering_logit,
)
from pemviz.pem.models.memory_card import FLATTERY_IF
from pemviz.pem.models.protocol import COLUMN, OCCLUSION_NAMES

LAGS_S = (0.1, 0.2, 0.5, 1.0, 3.0)
LAG_TOLERANCE = 0.5
"""Of a frame: how far a pair may be from a lag."""
DISTANCE_BANDS_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0), (50.0, 200.0))
AHEAD_M = 1.5
AHEAD_WITHIN_M = 40.0
FEWEST_MISSES = 20
"""In a band, for a memory time of its own."""
SIMULATED = 40
LONGEST_RUN = 10


@dataclass(frozen=True)
class LagCorrelation:
    """Correlation of residuals (missed - P(missed)) of one obstacle, ``lag_s`` apart.

    Attributes:
        lag_s: Time between the two [s].
        pairs: Pairs of observations.
        measured: In the data; ``None`` without pairs.
        fitted: Mean over outcomes drawn from the fitted model on the same tracks.
    """

    lag_s: float
    pairs: int
    measured: float | None
    fitted: float | None


@dataclass(frozen=True)
class GroupMemory:
    """The memory time of a part of the observations.

    Attributes:
        name: Which part.
        observations: How many.
        misses: How many of them were missed.
        missed_after_miss: Share of misses among observations right after a miss.
        missed_after_hit: The same after a hit.
        tau_s: Memory time fitted to them alone [s], frailty left out; ``None``: too few misses.
        tau_interval_s: Of it.
    """

    name: str
    observations: int
    misses: int
    missed_after_miss: float | None
    missed_after_hit: float | None
    tau_s: float | None
    tau_interval_s: tuple[float, float] | None


@dataclass(frozen=True)
class PlainView:
    """How much the data say of obstacles in plain view: neither occluded nor truncated.

    Attributes:
        name: Where they are.
        observations: How many.
        misses: How many of them were missed.
        misses_after_miss: How many of those follow a miss.
    """

    name: str
    observations: int
    misses: int
    misses_after_miss: int


@dataclass(frozen=True)
class MemoryReport:
    """What a memory's card shows.

    Attributes:
        fit: The fitted memory.
        correlations: By lag.
        run_lengths: How many runs of misses have 1, 2, ... and LONGEST_RUN or more frames.
        expected_run_lengths: Mean over outcomes drawn from the fitted model.
        independent_run_lengths: Mean over independent outcomes.
        groups: All observations, by distance, by occlusion.
        plain_view: Misses of obstacles neither occluded nor truncated.
        gaps: How often a track goes on after frames without it.
        rate_changes: How often the frame rate changes within a track.
        rate_hz: The most common frame rate.
    """

    fit: MemoryFit
    correlations: tuple[LagCorrelation, ...]
    run_lengths: tuple[int, ...]
    expected_run_lengths: tuple[float, ...]
    independent_run_lengths: tuple[float, ...]
    groups: tuple[GroupMemory, ...]
    plain_view: tuple[PlainView, ...]
    gaps: int
    rate_changes: int
    rate_hz: float


def report_memory(
    tracks: TrackTable, logit: FloatArray, *, fit: MemoryFit, seed: int = 0
) -> MemoryReport:
    """Compare the data with the fitted model.

    Args:
        tracks: n observations.
        logit: The out-of-fold logits that the memory was fitted with, ``[n]``.
        fit: The fitted memory.
        seed: Of the outcomes that are drawn from the model.
    """
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    drawn = [draw_outcomes(tracks, logit, memory=fit.memory, random=random)
             for _ in range(SIMULATED)]  # fmt: skip
    independent = [draw_outcomes(tracks, logit, memory=Memory(), random=random)
                   for _ in range(SIMULATED)]  # fmt: skip
    rates, counts = np.unique(tracks.rate_hz, return_counts=True)
    return MemoryReport(
        fit=fit,
        correlations=tuple(_correlation(tracks, logit, drawn, lag_s=lag) for lag in LAGS_S),
        run_lengths=tuple(int(n) for n in run_lengths(tracks, tracks.detected)),
        expected_run_lengths=_mean_runs(tracks, drawn),
        independent_run_lengths=_mean_runs(tracks, independent),
        groups=_groups(tracks, logit),
        plain_view=plain_view(tracks),
        gaps=tracks.gaps,
        rate_changes=tracks.rate_changes,
        rate_hz=float(rates[np.argmax(counts)]),
    )


def draw_outcomes(
    tracks: TrackTable, logit: FloatArray, *, memory: Memory, random: np.random.Generator
) -> BoolArray:
    """Outcomes ``[n]`` (true: detected) of the same tracks, drawn from the model of memory."""
    obstacles = int(tracks.track.max()) + 1
    visibility = random.standard_normal(obstacles)[tracks.track]
    own = frail_logit(logit, visibility=visibility, frailty=memory.frailty)
    rho = persistence(tracks.since_s, memory.tau_s)
    uniforms = random.random(len(tracks))
    detected = np.empty(len(tracks), dtype=np.bool_)
    starts = np.flatnonzero(~tracks.follows)
    place = np.arange(len(tracks)) - np.repeat(starts, np.diff(np.append(starts, len(tracks))))
    order = np.argsort(place, kind="stable")
    edges = np.searchsorted(place[order], np.arange(int(place.max()) + 2))
    for first, last in pairwise(edges.tolist()):
        rows = order[first:last]
        before = np.zeros(rows.size, dtype=np.bool_) if first == 0 else ~detected[rows - 1]
        chance = expit(remembering_logit(own[rows], missed_before=before, rho=rho[rows]))
        detected[rows] = uniforms[rows] < chance
    return detected


def residual_correlation(
    tracks: TrackTable, logit: FloatArray, detected: BoolArray, *, lag_s: float
) -> tuple[float | None, int]:
    """Correlation of residuals of one obstacle ``lag_s`` apart, and the number of pairs."""
    first, second = _pairs(tracks, lag_s=lag_s)
    if first.size == 0:
        return None, 0
    residual = (~detected) - expit(-logit)
    spread = np.sqrt(np.mean(residual[first] ** 2) * np.mean(residual[second] ** 2))
    if spread == 0.0:
        return None, int(first.size)
    return float(np.mean(residual[first] * residual[second]) / spread), int(first.size)


def run_lengths(tracks: TrackTable, detected: BoolArray) -> IntArray:
    """Numbers of runs of 1, 2, ..., LONGEST_RUN or more misses in neighbouring frames."""
    next_frame = tracks.follows & (np.diff(tracks.frame, prepend=-2) == 1)
    missed = ~detected
    begins = missed & ~(next_frame & np.roll(missed, 1))
    run = np.cumsum(begins)[missed]
    sizes = np.bincount(run)[1:] if run.size else np.zeros(0, dtype=np.int64)
    return np.bincount(np.minimum(sizes, LONGEST_RUN), minlength=LONGEST_RUN + 1)[1:]


def _pairs(tracks: TrackTable, *, lag_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the same track whose times are ``lag_s`` apart, to within half a frame."""
    steps = np.where(tracks.follows, tracks.since_s, 0.0)
    time_s = np.cumsum(steps)
    # tracks are moved apart so that one sorted list of times serves all
    apart = (float(time_s[-1]) + 10.0 * lag_s) * tracks.track + time_s
    wanted = apart + lag_s
    found = np.searchsorted(apart, wanted - LAG_TOLERANCE / tracks.rate_hz)
    found = np.minimum(found, len(tracks) - 1)
    close = np.abs(apart[found] - wanted) < LAG_TOLERANCE / tracks.rate_hz
    matched = np.flatnonzero(close & (tracks.track[found] == tracks.track))
    return matched, found[matched]


def _correlation(
    tracks: TrackTable, logit: FloatArray, drawn: list[BoolArray], *, lag_s: float
) -> LagCorrelation:
    measured, pairs = residual_correlation(tracks, logit, tracks.detected, lag_s=lag_s)
    values = [residual_correlation(tracks, logit, each, lag_s=lag_s)[0] for each in drawn]
    known = [value for value in values if value is not None]
    return LagCorrelation(lag_s, pairs, measured, float(np.mean(known)) if known else None)


def _mean_runs(tracks: TrackTable, drawn: list[BoolArray]) -> tuple[float, ...]:
    return tuple(np.mean([run_lengths(tracks, each) for each in drawn], axis=0).tolist())


def plain_view(tracks: TrackTable) -> tuple[PlainView, ...]:
    """Counts of obstacles in plain view: by distance, and straight ahead."""
    if not tracks.has_state:
        return ()
    salient = tracks.obstacles.salient
    z_m, x_m = salient[:, COLUMN["z_m"]], salient[:, COLUMN["x_m"]]
    plain = (salient[:, COLUMN["occlusion"]] == 0.0) & (salient[:, COLUMN["truncation"]] == 0.0)
    parts = [
        (f"{low:g} to {high:g} m", (z_m >= low) & (z_m < high)) for low, high in DISTANCE_BANDS_M
    ]
    ahead = (np.abs(x_m) < AHEAD_M) & (z_m < AHEAD_WITHIN_M)
    parts.append((f"straight ahead, nearer than {AHEAD_WITHIN_M:g} m", ahead))
    missed = ~tracks.detected
    return tuple(
        PlainView(
            name=name,
            observations=int(np.count_nonzero(plain & chosen)),
            misses=int(np.count_nonzero(plain & chosen & missed)),
            misses_after_miss=int(np.count_nonzero(plain & chosen & missed & tracks.missed_before)),
        )
        for name, chosen in parts
    )


def _groups(tracks: TrackTable, logit: FloatArray) -> tuple[GroupMemory, ...]:
    salient = tracks.obstacles.salient
    z_m, occlusion = salient[:, COLUMN["z_m"]], salient[:, COLUMN["occlusion"]]
    parts = [("all", np.ones(len(tracks), dtype=np.bool_))]
    parts += [
        (f"{low:g} to {high:g} m", (z_m >= low) & (z_m < high)) for low, high in DISTANCE_BANDS_M
    ]
    parts += [
        (f"occlusion {name}", occlusion == level) for level, name in enumerate(OCCLUSION_NAMES)
    ]
    kept = parts if tracks.has_state else parts[:1]
    return tuple(_group(tracks, logit, name, chosen) for name, chosen in kept)


def _group(tracks: TrackTable, logit: FloatArray, name: str, chosen: BoolArray) -> GroupMemory:
    """A part counts where the observation itself lies, whatever the one before was."""
    missed = ~tracks.detected
    after_miss = chosen & tracks.missed_before
    after_hit = chosen & tracks.follows & ~tracks.missed_before
    tau_s, interval = _tau_of(tracks, logit, chosen)
    return GroupMemory(
        name=name,
        observations=int(chosen.sum()),
        misses=int(missed[chosen].sum()),
        missed_after_miss=_share(missed, after_miss),
        missed_after_hit=_share(missed, after_hit),
        tau_s=tau_s,
        tau_interval_s=interval,
    )


def _tau_of(
    tracks: TrackTable, logit: FloatArray, chosen: BoolArray
) -> tuple[float | None, tuple[float, float] | None]:
    if np.count_nonzero(chosen & ~tracks.detected) < FEWEST_MISSES:
        return None, None
    try:
        fit = fit_memory(tracks, logit, with_frailty=False, chosen=chosen)
    except PemError:
        return None, None
    return fit.memory.tau_s, fit.tau_interval_s


def _share(missed: BoolArray, among: BoolArray) -> float | None:
    return float(missed[among].mean()) if among.any() else None


def memory_table(report: MemoryReport, *, flattery: str = FLATTERY_IF) -> dict[str, Any]:
    """A report as JSON values for the card.

    Args:
        report: What the card shows.
        flattery: What the training of the detector does to these figures, in words.
    """
    return {**asdict(report), "flattery": flattery}


def memory_line(report: MemoryReport) -> str:
    """The fitted memory in a line, and one on what its figures are."""
    fit = report.fit
    low, high = fit.tau_interval_s
    return (
        f"memory time {fit.memory.tau_s:.3f} s ({low:.3f} to {high:.3f}), frailty "
        f"{fit.memory.frailty:.2f}; {fit.nats_independent:.3f} nats an outcome if independent, "
        f"{fit.nats:.3f} with memory\n"
        f"  memory time tau: {TAU_MEANS}; frailty: {FRAILTY_MEANS}, 0 for not at all"
    )
