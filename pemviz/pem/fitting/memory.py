"""Memory time tau and frailty f from tracks, by maximum likelihood given P(missed | state).

The likelihood of a track is that of :mod:`pemviz.pem.models.memory`, with the obstacle's u
integrated out by the trapezoid rule, on a grid of tau and f. Sequences, not observations, are
independent: the log likelihood of all of them is scaled so that its curvature agrees with a
variance that counts sequences (Chandler & Bate 2007, Biometrika 94:167): the jackknife over
sequences, which is sound for few of them, with Student's t (MacKinnon, Nielsen & Webb 2023,
Journal of Econometrics 232:272). The likelihood's own scale stands where it gives the wider
interval. An interval holds what such a likelihood ratio does not refuse; unlike a spread of
bootstrap estimates it keeps its meaning where an estimate is 0.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtr, stdtrit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.table import TrackTable
from pemviz.pem.models.memory import Memory, miss_quantile, persistence
from pemviz.processes import usable_cpus

CONFIDENCE = 0.95
TAU_GRID_S = np.concatenate([[0.0], np.geomspace(0.01, 10.0, 31)])
FRAILTY_GRID = np.linspace(0.0, 3.0, 13)
NODES = np.linspace(-6.0, 6.0, 65)
FEWEST_SEQUENCES = 2
CHUNK_TRACKS = 32
"""Worked on at once: what they need stays in a core's cache."""
BLOCK_ROWS = 4
"""Outcomes of a track whose probabilities are multiplied before a logarithm is taken."""
SMALLEST = 1e-75
"""Below this a probability counts as this, so that the product of a block is no 0."""

FINE_TAUS, FINE_FRAILTIES = 601, 241
"""Points of profiles."""
TAU, FRAILTY = 0, 1

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class MemoryFit:
    """Fitted memory with its uncertainty.

    Attributes:
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
    surface: FloatArray | None = None,
    on_progress: Progress | None = None,
) -> MemoryFit:
    """Fit tau, and f if asked for.

    Args:
        tracks: n observations.
        logit: Out-of-fold logits of P(detected | state) of a model that saw none of the
            observation's own sequence, ``[n]``.
        with_frailty: Whether f is fitted too; else it is 0.
        chosen: Which outcomes count, ``[n]``; all if ``None``.
        surface: What :func:`memory_surface` gives of these, if it is known.
        on_progress: Called with tracks done and tracks in all.

    Raises:
        PemError: Fewer than two sequences, or no obstacle is seen twice.
    """
    check_fittable(tracks)
    frailties = FRAILTY_GRID if with_frailty else FRAILTY_GRID[:1]
    if surface is None:
        surface = memory_surface(
            tracks, logit, frailties=frailties, chosen=chosen, on_progress=on_progress
        )
    observations = len(tracks) if chosen is None else int(np.count_nonzero(chosen))
    count = surface.shape[0]
    whole = Surface(surface.sum(axis=0), TAU_GRID_S, frailties)
    step_s = float(np.median(tracks.since_s[tracks.follows]))
    scale = inflations(surface, whole, step_s=step_s)
    low_high = [
        interval(whole, axis, inflation=float(scale[axis]), sequences=count)
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
        nats=-whole.peak[1] / observations,
        p_value=independence_p_value(whole, inflation=float(scale[TAU]), sequences=count),
        inflation=float(scale[TAU]),
        efficiency=whole.efficiency,
    )


def check_fittable(tracks: TrackTable) -> None:
    """Whether there is anything to fit a memory to.

    Raises:
        PemError: Fewer than two sequences, or no obstacle is seen twice.
    """
    if np.unique(tracks.sequence).size < FEWEST_SEQUENCES:
        raise PemError("a memory needs tracks of at least two sequences for its interval")
    if not tracks.follows.any():
        raise PemError("no obstacle is observed twice: there is nothing to fit a memory to")


def memory_surface(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    frailties: FloatArray = FRAILTY_GRID,
    chosen: BoolArray | None = None,
    on_progress: Progress | None = None,
) -> FloatArray:
    """Log likelihood of each sequence ``[S, taus, frailties]`` [nats] on the grid of tau."""
    return log_likelihoods(
        tracks, logit, taus_s=TAU_GRID_S, frailties=frailties, chosen=chosen,
        on_progress=on_progress,
    )  # fmt: skip


def nested_memories(log_likelihood: FloatArray) -> tuple[Memory, Memory, Memory]:
    """The likeliest memory time alone, frailty alone, and both.

    Args:
        log_likelihood: ``[taus, frailties]`` on the grids of :func:`memory_surface`.
    """
    from scipy.interpolate import CubicSpline  # noqa: PLC0415  slow to import

    alone = Surface(log_likelihood[:, :1], TAU_GRID_S, FRAILTY_GRID[:1])
    both = Surface(log_likelihood, TAU_GRID_S, FRAILTY_GRID)
    of_frailty = log_likelihood[0]  # even in f, as in Surface
    mirrored = np.concatenate([of_frailty[:0:-1], of_frailty])
    curve = CubicSpline(np.concatenate([-FRAILTY_GRID[:0:-1], FRAILTY_GRID]), mirrored)
    fine = np.linspace(FRAILTY_GRID[0], FRAILTY_GRID[-1], FINE_FRAILTIES)
    return (
        Memory(tau_s=alone.tau_s),
        Memory(frailty=float(fine[np.argmax(curve(fine))])),
        Memory(tau_s=both.tau_s, frailty=both.frailty),
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
    """Log likelihood of each sequence ``[S, taus, frailties]`` [nats]; see :func:`fit_memory`."""
    sequences, of_sequence = np.unique(tracks.sequence, return_inverse=True)
    result = np.zeros((sequences.size, taus_s.size, frailties.size))
    starts = np.flatnonzero(~tracks.follows)
    ends = np.append(starts[1:], len(tracks))
    quantile = miss_quantile(logit)
    left_out = np.zeros(len(tracks), dtype=np.bool_) if chosen is None else ~chosen
    firsts = range(0, starts.size, CHUNK_TRACKS)

    def of_chunk(first: int) -> FloatArray:
        last = min(first + CHUNK_TRACKS, starts.size)
        rows = slice(int(starts[first]), int(ends[last - 1]))
        inner = starts[first:last] - starts[first]
        return _tracks_log_likelihood(
            tracks, quantile, left_out, rows, inner, taus_s=taus_s, frailties=frailties
        )

    # numpy lets go of the interpreter's lock; sums are in the order of the tracks all the same
    with ThreadPoolExecutor(usable_cpus()) as threads:
        for first, table in zip(firsts, threads.map(of_chunk, firsts), strict=True):
            last = first + len(table)
            np.add.at(result, of_sequence[starts[first:last]], table)
            if on_progress is not None:
                on_progress(last, starts.size)
    return result


def _tracks_log_likelihood(
    tracks: TrackTable,
    quantile: FloatArray,
    left_out: BoolArray,
    rows: slice,
    starts: IntArray,
    *,
    taus_s: FloatArray,
    frailties: FloatArray,
) -> FloatArray:
    """Log likelihood of each track that begins at ``starts``, ``[tracks, taus, frailties]``."""
    length = np.diff(np.append(starts, rows.stop - rows.start))
    # blocks of rows stay within a track, and the last of each is filled up with factors of 1
    count = -(-length // BLOCK_ROWS)
    of_track = np.cumsum(count) - count
    block = np.arange(int(count.sum())) - np.repeat(of_track, count)
    within = (BLOCK_ROWS * block[:, None] + np.arange(BLOCK_ROWS)).ravel()
    filled = within >= np.repeat(length, BLOCK_ROWS * count)
    row = rows.start + np.where(filled, 0, np.repeat(starts, BLOCK_ROWS * count) + within)
    missed, left_out = ~tracks.detected[row], left_out[row] | filled
    repeats = (missed == tracks.missed_before[row]) | left_out
    since_s = np.where(filled, np.inf, tracks.since_s[row])
    table = np.empty((starts.size, taus_s.size, frailties.size))
    for column, frailty in enumerate(frailties):
        nodes = NODES if frailty > 0.0 else np.zeros(1)
        moved = quantile[row, None] * np.sqrt(1.0 + frailty**2) + frailty * nodes
        own = ndtr(np.where(missed[:, None], moved, -moved))
        own[left_out] = 1.0
        least = own.min()
        after = np.empty_like(own)
        log_weight = -0.5 * nodes**2
        log_weight = log_weight - np.log(np.exp(log_weight).sum())
        for index, tau_s in enumerate(taus_s):
            rho = persistence(since_s, float(tau_s))
            anew = 1.0 - rho
            np.multiply(own, anew[:, None], out=after)
            after += (rho * repeats)[:, None]
            if least * anew.min() < SMALLEST:
                np.maximum(after, SMALLEST, out=after)
            log_block = np.log(after.reshape(-1, BLOCK_ROWS, nodes.size).prod(axis=1))
            log_track = np.add.reduceat(log_block, of_track, axis=0)
            joint = log_track + log_weight
            largest = joint.max(axis=1, keepdims=True)
            table[:, index, column] = largest[:, 0] + np.log(np.exp(joint - largest).sum(axis=1))
    return table


@dataclass(frozen=True, eq=False)
class Surface:
    """A log likelihood between the points of its grid.

    Attributes:
        log_likelihood: ``[taus, frailties]``; the first row is of tau = 0.
        taus_s: The grid's memory times [s], the first 0.
        frailties: The grid's f, four or more; or one value, if f is given.
    """

    log_likelihood: FloatArray
    taus_s: FloatArray
    frailties: FloatArray

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import RectBivariateSpline  # noqa: PLC0415  slow to import

        values, columns = self.log_likelihood[1:], self.frailties
        if columns.size == 1:
            values, columns = np.repeat(values, 4, axis=1), columns[0] + np.arange(4.0)
        elif columns[0] == 0.0:  # the likelihood is even in f: u and -u are as likely
            values = np.concatenate([values[:, :0:-1], values], axis=1)
            columns = np.concatenate([-columns[:0:-1], columns])
        return RectBivariateSpline(np.log(self.taus_s[1:]), columns, values)

    @cached_property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Of log tau and f."""
        log_tau = np.log(self.taus_s[1:])
        return (
            (float(log_tau[0]), float(log_tau[-1])),
            (float(self.frailties[0]), float(self.frailties[-1])),
        )

    @cached_property
    def peak(self) -> tuple[FloatArray, float]:
        """Log tau and f where it is highest, and how high it is there."""
        from scipy.optimize import minimize  # noqa: PLC0415  slow to import

        row, column = np.unravel_index(
            int(self.log_likelihood[1:].argmax()), self.log_likelihood[1:].shape
        )
        start = [np.log(self.taus_s[1 + row]), self.frailties[column]]

        def falling(place: FloatArray) -> tuple[float, list[float]]:
            slopes = [-float(self._spline.ev(*place, dx=1)), -float(self._spline.ev(*place, dy=1))]
            return -float(self._spline.ev(*place)), slopes

        options = {"ftol": 1e-13, "gtol": 1e-7}
        found = minimize(
            falling, start, jac=True, bounds=self.bounds, method="L-BFGS-B", options=options
        )
        return np.asarray(found.x), -float(found.fun)

    @property
    def tau_s(self) -> float:
        """Memory time of the highest point [s]; 0 at the lower end of the grid."""
        log_tau = float(self.peak[0][TAU])
        return 0.0 if log_tau <= self.bounds[TAU][0] + 1e-5 else float(np.exp(log_tau))

    @property
    def frailty(self) -> float:
        """Frailty of the highest point."""
        return float(self.peak[0][FRAILTY])

    @property
    def free(self) -> BoolArray:
        """Whether the peak lies inside of the range of log tau and of f, ``[2]``."""
        place, (low, high) = self.peak[0], np.array(self.bounds).T
        margin = 1e-6 * (high - low)
        return (place > low + margin) & (place < high - margin)

    def derivatives(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """First derivatives ``[2]`` and minus the second ones ``[2, 2]`` in log tau and f."""
        at = partial(self._spline.ev, *place)
        mixed = -float(at(dx=1, dy=1))
        slopes = np.array([float(at(dx=1)), float(at(dy=1))])
        return slopes, np.array([[-float(at(dx=2)), mixed], [mixed, -float(at(dy=2))]])

    @property
    def efficiency(self) -> float:
        """Share of what the data say of tau that is left since f is not known."""
        _, bends = self.derivatives(self.peak[0])
        if not self.free.all() or not _is_peak(bends):
            return 1.0
        return float(1.0 - bends[0, 1] ** 2 / (bends[0, 0] * bends[1, 1]))

    def profile(self, axis: int) -> tuple[FloatArray, FloatArray]:
        """Fine grid of log tau or f, and the height with the other one free."""
        (low, high), (least, most) = self.bounds
        log_taus = np.linspace(low, high, FINE_TAUS)
        frailties = np.linspace(least, most, 1 if least == most else FINE_FRAILTIES)
        heights = self._spline(log_taus, frailties)
        return (log_taus, frailties)[axis], heights.max(axis=1 - axis)


def inflations(surfaces: FloatArray, whole: Surface, *, step_s: float) -> FloatArray:
    """Variance between sequences over the likelihood's own, of log tau and of f; at least 1.

    A jackknife of one Newton step each, in the correlation exp(-step / tau) of neighbouring
    outcomes, in which a likelihood is regular down to tau = 0. What lies at an end of its range is
    held there, and has 1.

    Args:
        surfaces: Log likelihoods ``[S, taus, frailties]`` of the sequences.
        whole: Their sum.
        step_s: Time between neighbouring outcomes [s].
    """
    count = surfaces.shape[0]
    place, free = whole.peak[0], whole.free
    result = np.ones(2)
    if not free.any():
        return result
    parts = [Surface(each, whole.taus_s, whole.frailties).derivatives(place) for each in surfaces]
    # d^2/d rho^2 = (d^2/dx^2 - rho''/rho' d/dx) / rho'^2 of x = log tau; rho' drops out below
    curved = np.array([[step_s / np.exp(place[TAU]) - 1.0, 0.0], [0.0, 0.0]])
    bends = np.array([(bend + slope[TAU] * curved)[np.ix_(free, free)] for slope, bend in parts])
    all_bends = bends.sum(axis=0)
    if not _is_peak(all_bends):
        return result
    steps = np.array(
        [
            np.linalg.solve(rest if _is_peak(rest) else all_bends, slope[free])
            for (slope, _), rest in zip(parts, all_bends - bends, strict=True)
        ]
    )
    jackknife = (count - 1.0) / count * np.sum(steps**2, axis=0)
    result[free] = np.maximum(jackknife / np.diag(np.linalg.inv(all_bends)), 1.0)
    return result


def _is_peak(bends: FloatArray) -> bool:
    """Whether minus the second derivatives ``[k, k]`` are those of a maximum."""
    return bool(np.linalg.eigvalsh(bends).min() > 0.0)


def interval(whole: Surface, axis: int, *, inflation: float, sequences: int) -> tuple[float, float]:
    """What the scaled likelihood ratio does not refuse, of tau [s] or f.

    Args:
        whole: The log likelihood of all sequences.
        axis: TAU or FRAILTY.
        inflation: Its scale, see :func:`inflations`.
        sequences: Their number S; Student's t has S - 1 degrees of freedom.
    """
    limit = float(stdtrit(sequences - 1, 0.5 + CONFIDENCE / 2.0)) ** 2 / 2.0 * inflation
    grid, heights = whole.profile(axis)
    above = heights - (max(whole.peak[1], float(heights.max())) - limit)
    inside = np.flatnonzero(above >= 0.0)
    first, last = int(inside[0]), int(inside[-1])
    low, high = float(grid[first]), float(grid[last])
    if first > 0:
        low = float(np.interp(0.0, above[first - 1 : first + 1], grid[first - 1 : first + 1]))
    if last < grid.size - 1:
        ends = slice(last + 1, last - 1, -1) if last else slice(1, None, -1)
        high = float(np.interp(0.0, above[ends], grid[ends]))
    if axis == FRAILTY:
        return low, high
    return (0.0 if first == 0 else float(np.exp(low))), float(np.exp(high))


def independence_p_value(whole: Surface, *, inflation: float, sequences: int) -> float:
    """One-sided p-value of tau = 0 with f free: Student's t of the signed root of the ratio.

    tau = 0 lies on the edge of what is possible, so half of the ratio's distribution stands at 0
    (Self & Liang 1987, case 5); an estimate of 0 has the p-value 1.

    It is cautious where sequences are few: Student's t stands for the normal quantile though the
    likelihood's own scale is never undercut. Of 400 samples without memory, 8 tracks of 20 frames
    a sequence, 4.0 % were refused at 5 % with 12 sequences and no frailty, 3.0 % with 12 and f =
    0.8; of 200 samples, 5 tracks a sequence, 1.5 % with 6. Normal quantiles and no inflation
    would refuse 5.5, 5.0 and 3.5 %, so the half at 0 is as it should be.
    """
    if whole.tau_s == 0.0:
        return 1.0
    at_zero = float(whole.profile(TAU)[1][0])
    root = np.sqrt(max(2.0 * (whole.peak[1] - at_zero), 0.0) / inflation)
    return float(stdtr(sequences - 1, -root))
