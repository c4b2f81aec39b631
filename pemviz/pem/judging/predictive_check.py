"""Predictive checks: data sets drawn from an error model along the tracks of one that was observed.

Each draw is a whole data set: the same tracks, frame by frame, with outcomes from the model. Under
the model tracks are independent given the state, so the draws give the distribution of anything
that is computed from all tracks, however it pools them. The p-value of a quantity is its rank among
B draws: two-sided, with one added to the draws that are as extreme or more (Davison & Hinkley 1997,
Bootstrap Methods, section 4.2), and ties counting half (mid-p; Lancaster 1961, JASA 56:223). It
takes the fitted model as given. Quantities of a variant are judged together by Holm's procedure.

Quantities, of n outcomes in tracks:

- The longest run of misses in neighbouring frames, where a frame lasts 1 / rate.
- A track approaches from its first observation to its nearest, if that is ``APPROACH_M`` nearer.
  Misses on approach are counted nearer than ``CLOSE_M``. It is first detected where it is, and
  lastingly where it stays so to the nearest place; one that is not counts as at its nearest place.
- Misses after a hit and after a miss: shares of the observations whose track's one before was such.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from threading import Event, Lock
from typing import Literal, TypeVar

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.table import TrackTable
from pemviz.pem.fitting.memory import nested_memories
from pemviz.pem.judging.memory_report import CrossFitted, sample_outcomes
from pemviz.pem.judging.position_error_check import ErrorLaw
from pemviz.pem.models.cards import PemCard, memory_of, varying_frailty_of
from pemviz.pem.models.memory import Memory
from pemviz.pem.models.predictive_check import (
    AFTER_HIT,
    AFTER_MISS,
    CLOSE_M,
    DISTANCE_BANDS_M,
    DRAWS,
    FAMILY_WISE,
    FEWEST_DRAWS,
    MISSED_FOR_S,
    MOST_DRAWS,
    CheckedQuantity,
    CheckedVariant,
    ModelCheck,
    QuantityName,
    Variant,
    check_from_mapping,
)
from pemviz.pem.models.protocol import COLUMN, Pem
from pemviz.pem.models.varying_frailty import VaryingFrailty
from pemviz.processes import usable_cpus

APPROACH_M = 5.0
OUTCOMES_AT_ONCE = 1_000_000
"""Of all draws that are worked on at a time: they stay in the memory that a laptop has."""
DIGITS = 9
"""Decimals of a quantity: what differs by rounding alone is a tie."""
ROUNDING_S = 1e-6
"""Sums of frames that are equal but for rounding are equal."""
CURVE_S = np.concatenate([np.arange(0.1, 1.0, 0.1), np.arange(1.0, 5.1, 0.25)])
"""Lengths of runs in a picture [s]."""
CURVE_MISSES = np.arange(1.0, 41.0)

Key = TypeVar("Key")
Progress = Callable[[int, int], None]
Law = Memory | VaryingFrailty
"""Of how misses hang together."""
Values = dict[QuantityName, FloatArray]
Curves = dict[Literal["runs", "misses"], FloatArray]


@dataclass(frozen=True, eq=False)
class TrackQuantities:
    """What is computed from outcomes along tracks."""

    tracks: TrackTable

    @cached_property
    def starts(self) -> IntArray:
        """First row of each track ``[K]``."""
        return np.flatnonzero(~self.tracks.follows)

    @cached_property
    def distance_m(self) -> FloatArray:
        """From the sensor ``[n]`` [m]."""
        if not self.tracks.has_state:
            return np.zeros(len(self.tracks))
        salient = self.tracks.obstacles.salient
        return np.hypot(salient[:, COLUMN["x_m"]], salient[:, COLUMN["z_m"]])

    @cached_property
    def nearest(self) -> IntArray:
        """Row where each track is first at its least distance ``[K]``."""
        ends = np.append(self.starts[1:], len(self.tracks))
        return np.array(
            [a + np.argmin(self.distance_m[a:b]) for a, b in zip(self.starts, ends, strict=True)]
        )

    @cached_property
    def approaches(self) -> BoolArray:
        """Which tracks come nearer ``[K]``."""
        if not self.tracks.has_state:
            return np.zeros(self.starts.size, dtype=np.bool_)
        come_m = self.distance_m[self.starts] - self.distance_m[self.nearest]
        return come_m >= APPROACH_M

    @cached_property
    def on_approach(self) -> BoolArray:
        """Which rows lie on the way to the nearest place ``[n]``."""
        sizes = np.diff(np.append(self.starts, len(self.tracks)))
        before = np.arange(len(self.tracks)) <= np.repeat(self.nearest, sizes)
        return before & np.repeat(self.approaches, sizes)

    @cached_property
    def after_others(self) -> list[tuple[QuantityName, QuantityName, BoolArray]]:
        """Rows that follow one of their track ``[n]``: by band, where distances are known.

        With the names of misses after a hit and after a miss; there is one row at least.
        """
        everywhere = np.ones(len(self.tracks), dtype=np.bool_)
        nowhere = np.zeros_like(everywhere)
        groups = [everywhere, *[nowhere] * len(DISTANCE_BANDS_M)]
        if self.tracks.has_state:
            far_m = self.distance_m
            groups = [nowhere, *((far_m >= a) & (far_m < b) for a, b in DISTANCE_BANDS_M)]
        follow = [rows & self.tracks.follows for rows in groups]
        named = zip(AFTER_HIT, AFTER_MISS, follow, strict=True)
        return [(hit, miss, rows) for hit, miss, rows in named if rows.any()]

    def longest_runs_s(self, detected: BoolArray) -> FloatArray:
        """Longest run of misses of each track ``[B, K]`` [s], of outcomes ``[B, n]``."""
        tracks = self.tracks
        begins = ~(tracks.follows & (np.diff(tracks.frame, prepend=-2) == 1))
        lasted_s = ~detected / tracks.rate_hz
        until_s = np.cumsum(lasted_s, axis=1)
        before_s = np.where(detected, until_s, np.where(begins, until_s - lasted_s, 0.0))
        runs_s = until_s - np.maximum.accumulate(before_s, axis=1)
        return ROUNDING_S * np.round(np.maximum.reduceat(runs_s, self.starts, axis=1) / ROUNDING_S)

    def close_misses(self, detected: BoolArray) -> FloatArray:
        """Misses within ``CLOSE_M`` of each track that comes there ``[B, A]``."""
        close = self.on_approach & (self.distance_m < CLOSE_M)
        counts = np.add.reduceat(~detected & close, self.starts, axis=1, dtype=np.int64)
        return counts[:, self._comes_close].astype(np.float64)

    @cached_property
    def _comes_close(self) -> BoolArray:
        return self.approaches & (self.distance_m[self.nearest] < CLOSE_M)

    def detection_distances_m(self, detected: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Where each approaching track is first and lastingly detected ``[B, A]`` each [m]."""
        row = np.arange(len(self.tracks))
        last = self.nearest
        seen = np.where(detected & self.on_approach, row, len(self.tracks))
        first = np.minimum(np.minimum.reduceat(seen, self.starts, axis=1), last)
        missed = np.where(~detected & self.on_approach, row, -1)
        after = np.maximum.reduceat(missed, self.starts, axis=1) + 1
        lasting = np.clip(after, self.starts, last)
        return (
            self.distance_m[first[:, self.approaches]],
            self.distance_m[lasting[:, self.approaches]],
        )

    def computed(self, detected: BoolArray) -> "Drawn":
        """Every quantity of outcomes ``[B, n]``, and curves."""
        runs_s = self.longest_runs_s(detected)
        values: Values = {"longest_run_s": runs_s.mean(axis=1)}
        for name, least_s in MISSED_FOR_S.items():
            values[name] = (runs_s >= least_s - ROUNDING_S).mean(axis=1)
        curves: Curves = {"runs": _shares(runs_s, CURVE_S - ROUNDING_S)}
        if self._comes_close.any():
            misses = self.close_misses(detected)
            values["close_misses"] = misses.mean(axis=1)
            if misses.shape[1] > 1:
                values["close_misses_sd"] = misses.std(axis=1)
            curves["misses"] = _shares(misses, CURVE_MISSES)
        if self.approaches.any():
            first_m, lasting_m = self.detection_distances_m(detected)
            values |= {"first_m": first_m.mean(axis=1), "lasting_m": lasting_m.mean(axis=1)}
        missed = ~detected
        before = np.zeros_like(missed)
        before[:, 1:] = missed[:, :-1]
        for hit, miss, rows in self.after_others:
            now = missed[:, rows]
            values[hit] = _share_of(now, given=~before[:, rows])
            values[miss] = _share_of(now, given=before[:, rows])
        return Drawn({name: np.round(value, DIGITS) for name, value in values.items()}, curves)


def _share_of(outcomes: BoolArray, *, given: BoolArray) -> FloatArray:
    """Share ``[B]`` of outcomes ``[B, m]`` among those given; not a number where none is."""
    among = np.count_nonzero(given, axis=1)
    return np.count_nonzero(outcomes & given, axis=1) / np.where(among, among, np.nan)


def _shares(values: FloatArray, least: FloatArray) -> FloatArray:
    """Shares of values ``[B, K]`` that are at least ``[points]``: ``[B, points]``."""
    return np.stack([(values >= one).mean(axis=1) for one in least], axis=1)


@dataclass(frozen=True, eq=False)
class Drawn:
    """What B data sets give.

    Attributes:
        values: Quantities ``[B]`` by name, not a number where there was nothing to compute one of.
        curves: For a picture: shares of tracks ``[B, points]`` whose longest run lasts at least
            ``CURVE_S``, and with at least ``CURVE_MISSES`` misses close by.
    """

    values: Values
    curves: Curves


@dataclass(frozen=True, eq=False)
class Checked:
    """A check, with what its picture shows.

    Attributes:
        observed: Quantities and curves of the tracks, B = 1.
        drawn: Of each variant.
    """

    check: ModelCheck
    observed: Drawn
    drawn: Mapping[Variant, Drawn]


def check_tracks(
    tracks: TrackTable,
    logit: FloatArray,
    *,
    part: IntArray,
    laws: Mapping[Variant, Sequence[Law]],
    errors: ErrorLaw | None = None,
    folds: int = 0,
    same_data: bool = False,
    draws: int = DRAWS,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> Checked:
    """Compare tracks with data sets drawn from a model's variants.

    Args:
        tracks: n observations.
        logit: Logits of P(detected | state) ``[n]``.
        part: Which part of the sequences each observation is of ``[n]``, counted from 0.
        laws: By variant the law of misses of each part.
        errors: Law of the position errors, and those that were observed; ``None`` without.
        folds: As in :class:`ModelCheck`, and the next one.
        same_data: Likewise.
        draws: Data sets of each variant.
        seed: Of the draws.
        on_progress: Called with batches of data sets done and batches in all.

    Raises:
        PemError: Fewer than ``FEWEST_DRAWS`` or more than ``MOST_DRAWS`` draws.
    """
    if not FEWEST_DRAWS <= draws <= MOST_DRAWS:
        raise PemError(f"draws is {draws}, allowed: {FEWEST_DRAWS} to {MOST_DRAWS:,}")
    quantities = TrackQuantities(tracks)
    observed = quantities.computed(tracks.detected[None])
    if errors is not None:
        observed.values.update(errors.observed())
    done, lock, stopped = count(1), Lock(), Event()
    at_once = max(1, min(draws, OUTCOMES_AT_ONCE // len(tracks)))

    def draw(place: int, variant: Variant) -> Drawn:
        batches: list[Drawn] = []
        root = np.random.SeedSequence(seed, spawn_key=(2, place))
        batch_sizes = [min(at_once, draws - first) for first in range(0, draws, at_once)]
        outcomes_of = _draws(tracks, logit, part, laws[variant], sizes=batch_sizes, root=root)
        for outcomes, random in outcomes_of:
            if stopped.is_set():
                break
            batches.append(quantities.computed(outcomes))
            if errors is not None:
                of_errors = errors.drawn(variant, count=len(outcomes), random=random)
                batches[-1].values.update(of_errors)
            if on_progress is not None:
                with lock:
                    on_progress(next(done), len(laws) * len(batch_sizes))
        return Drawn(
            _joined([one.values for one in batches]), _joined([one.curves for one in batches])
        )

    # numpy lets go of the interpreter's lock; each variant has its own stream of random numbers
    with ThreadPoolExecutor(usable_cpus()) as threads:
        each = threads.map(draw, range(len(laws)), laws)
        try:
            drawn = dict(zip(laws, each, strict=True))
        except BaseException:  # such as Ctrl-C: the threads shall not go on to their end
            stopped.set()
            raise
    check = ModelCheck(
        tracks=quantities.starts.size,
        approaching=int(quantities.approaches.sum()),
        sequences=int(np.unique(tracks.sequence).size),
        observations=len(tracks),
        draws=draws,
        folds=folds,
        same_data=same_data,
        variants=tuple(
            _variant(variant, of_parts, compare(observed.values, drawn[variant].values))
            for variant, of_parts in laws.items()
        ),
    )
    return Checked(check, observed, drawn)


def _variant(
    name: Variant, laws: Sequence[Law], quantities: tuple[CheckedQuantity, ...]
) -> CheckedVariant:
    """With the medians of what the parts' laws say."""

    def median(values: Iterable[float]) -> float:
        return float(np.median(list(values)))

    frailty = median(law.frailty for law in laws)
    visibilities = [law for law in laws if isinstance(law, VaryingFrailty)]
    if visibilities:
        return CheckedVariant(
            name, 0.0, frailty, quantities,
            varying=median(law.varying for law in visibilities),
            varying_s=median(law.varying_s for law in visibilities),
        )  # fmt: skip
    tau_s = median(law.tau_s for law in laws if isinstance(law, Memory))
    return CheckedVariant(name, tau_s, frailty, quantities)


def laws_of_parts(
    tracks: TrackTable,
    surface: FloatArray,
    *,
    part: IntArray,
    visibilities: Sequence[VaryingFrailty] = (),
) -> dict[Variant, tuple[Law, ...]]:
    """Each variant's law of misses of each part, fitted to the sequences of the others.

    Args:
        tracks: n observations.
        surface: Log likelihoods of the sequences, as
            :func:`pemviz.pem.fitting.memory.memory_surface` gives them.
        part: Which part each observation is of ``[n]``; a sequence lies in one.
        visibilities: As :func:`pemviz.pem.fitting.varying_frailty.held_out_laws` gives them; a
            variant of its own, if there are any.
    """
    first_rows = np.unique(tracks.sequence, return_index=True)[1]
    of_sequence = part[first_rows]
    parts = range(int(part.max()) + 1)
    fitted = [nested_memories(surface[of_sequence != each].sum(axis=0)) for each in parts]
    memory, frailty, both = zip(*fitted, strict=True)
    independent = tuple(Memory() for _ in parts)
    found: dict[Variant, tuple[Law, ...]] = {
        "independent": independent, "memory": memory, "frailty": frailty, "both": both,
    }  # fmt: skip
    if visibilities:
        found["visibility"] = tuple(visibilities)
    return found


def own_laws(pem: Pem) -> dict[Variant, tuple[Law, ...]]:
    """The laws of misses of a model's variants, for tracks of one part.

    Independent, and what it carries; on a card with a check stand a memory time and a frailty
    alone, too.

    Raises:
        PemError: The card is damaged.
    """
    found: dict[Variant, tuple[Law, ...]] = {"independent": (Memory(),)}
    card: object = getattr(pem, "card", None)
    own = memory_of(pem)
    if isinstance(card, PemCard) and own is not None:
        checked = check_from_mapping(card.check, where=card.name)
        for one in () if checked is None else checked.variants:
            if one.name in ("memory", "frailty"):
                found[one.name] = (Memory(tau_s=one.tau_s, frailty=one.frailty),)
    if own is not None:
        found["both"] = (own,)
    if (visibility := varying_frailty_of(pem)) is not None:
        found["visibility"] = (visibility,)
    return found


def check_model(
    tracks: TrackTable,
    pem: Pem,
    *,
    errors: ErrorLaw | None = None,
    same_data: bool = False,
    draws: int = DRAWS,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> Checked:
    """Check a fitted model against tracks; see :func:`check_tracks`.

    Raises:
        PemError: Its card is damaged, or the number of draws is out of range.
    """
    return check_tracks(
        tracks,
        pem.logit(tracks.obstacles.salient),
        part=np.zeros(len(tracks), dtype=np.int64),
        laws=own_laws(pem),
        errors=errors,
        same_data=same_data,
        draws=draws,
        seed=seed,
        on_progress=on_progress,
    )


def check_held_out(
    tracks: TrackTable,
    held_out: CrossFitted,
    surface: FloatArray,
    *,
    visibilities: Sequence[VaryingFrailty] = (),
    errors: ErrorLaw | None = None,
    draws: int = DRAWS,
    seed: int = 0,
    on_progress: Progress | None = None,
) -> Checked:
    """Check a kind of model whose every part of the sequences is told by the others'.

    See :func:`check_tracks`; ``surface`` and ``visibilities`` as in :func:`laws_of_parts`.
    """
    part = held_out.part
    return check_tracks(
        tracks,
        held_out.logit,
        part=part,
        laws=laws_of_parts(tracks, surface, part=part, visibilities=visibilities),
        errors=errors,
        folds=held_out.folds,
        draws=draws,
        seed=seed,
        on_progress=on_progress,
    )


def _joined(batches: Sequence[dict[Key, FloatArray]]) -> dict[Key, FloatArray]:
    return {name: np.concatenate([one[name] for one in batches]) for name in batches[0]}


def _draws(
    tracks: TrackTable,
    logit: FloatArray,
    part: IntArray,
    laws: Sequence[Law],
    *,
    sizes: Sequence[int],
    root: np.random.SeedSequence,
) -> Iterator[tuple[BoolArray, np.random.Generator]]:
    """Outcomes ``[B, n]`` of so many draws at a time, and what else of them is drawn from.

    A draw is the same however many are drawn at a time.
    """
    *of_parts, rest = map(np.random.default_rng, root.spawn(len(laws) + 1))
    chosen = [part == each for each in range(len(laws))]
    tables = [tracks.only(rows) for rows in chosen]
    for several in sizes:
        outcomes = np.empty((several, len(tracks)), dtype=np.bool_)
        for rows, table, law, random in zip(chosen, tables, laws, of_parts, strict=True):
            if rows.any():
                outcomes[:, rows] = sample_outcomes(
                    table, logit[rows], law=law, samples=several, random=random
                )
        yield outcomes, rest


def compare(observed: Values, drawn: Values) -> tuple[CheckedQuantity, ...]:
    """Quantities as observed ``[1]`` beside draws of them ``[B]``, judged together."""
    p_values = [p_value(float(observed[name][0]), drawn[name]) for name in observed]
    refuted = holm(np.array(p_values))
    found: list[CheckedQuantity] = []
    for name, p, wrong in zip(observed, p_values, refuted.tolist(), strict=True):
        known = drawn[name][np.isfinite(drawn[name])]
        low, middle, high = (
            (
                float(np.quantile(known, 0.025)),
                float(known.mean()),
                float(np.quantile(known, 0.975)),
            )
            if known.size
            else (None, None, None)
        )
        seen = float(observed[name][0])
        shown = seen if np.isfinite(seen) else None
        found.append(CheckedQuantity(name, shown, middle, low, high, p, wrong))
    return tuple(found)


def p_value(observed: float, drawn: FloatArray) -> float:
    """Two-sided p-value of one value among draws ``[B]`` of it; see the module.

    What is not a number, for there was nothing to compute it from, counts as the mean of all that
    are, observed and drawn: under the model it is the draws' equal.
    """
    values = np.append(drawn, observed)
    known = np.isfinite(values)
    if not known.any():
        return 1.0
    values = np.where(known, values, values[known].mean())
    greater = np.count_nonzero(values[:-1] > values[-1])
    equal = np.count_nonzero(values[:-1] == values[-1])
    less = drawn.size - greater - equal
    return min(1.0, 2.0 * (1.0 + min(greater, less) + 0.5 * equal) / (drawn.size + 1.0))


def holm(p_values: FloatArray, *, level: float = FAMILY_WISE) -> BoolArray:
    """Which of m hypotheses Holm's step-down procedure refuses, ``[m]``.

    The chance that it refuses any that holds is at most ``level``, however they depend.
    """
    order = np.argsort(p_values, kind="stable")
    passed = p_values[order] <= level / np.arange(len(p_values), 0, -1)
    refused = np.zeros(len(p_values), dtype=np.bool_)
    refused[order] = np.logical_and.accumulate(passed)
    return refused
