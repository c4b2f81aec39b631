"""How many training obstacles lie near what a scenario visits, and what they alone would allow.

Training obstacles are counted in cells of class, occlusion, lateral offset, heading and distance.
The counts ship with the model, the data does not. Where a scenario evaluates a model on what its
training data never showed is said in words.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.binomial import exact_interval, exact_upper_bound
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.cards import MOST_PAIRS, FittedMemory, PemCard
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES, Pem, as_rows
from pemviz.pem.models.tabulated import TabulatedPem

DISTANCE_EDGES_M = (0.0, 3.0, 5.0, 7.0, 13.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0)
"""Between the distance bands; the first band lies behind the camera, the last beyond 80 m."""

LATERAL_EDGES_M = (1.5, 4.5, 10.0)
"""Between the bands of |x|."""

HEADING_TOLERANCE_RAD = 0.3
MOST_OBSTACLES = 10**12
"""Training obstacles in a cell; sums of them stay whole numbers."""
HEADING_NAMES = ("heading away", "oncoming", "across")
LATERAL_NAMES = ("straight ahead", "beside", "off the road", "far aside")

SHAPE = (
    len(CLASS_NAMES),
    len(OCCLUSION_NAMES),
    len(LATERAL_EDGES_M) + 1,
    len(HEADING_NAMES),
    len(DISTANCE_EDGES_M) + 1,
)
"""Cells: class, occlusion, lateral band, heading, distance band."""

THIN_OBSTACLES = 30
"""Fewer training obstacles than this in a band count as thin data."""

BEHIND_M = -1e6
"""Lower edge of the band behind the camera."""

NEVER_DETECTED_LOGIT = -28.0
"""Logit of P(detected) where no data bounds P(missed): about 1e-12."""


@dataclass(frozen=True, eq=False)
class SupportSummary:
    """Counts of training obstacles and of the missed ones among them, of the shape SHAPE."""

    obstacles: IntArray
    missed: IntArray

    def to_json(self) -> dict[str, Any]:
        """The cells that are not empty, as plain numbers."""
        filled = np.argwhere(self.obstacles)
        counts = np.stack([self.obstacles[tuple(filled.T)], self.missed[tuple(filled.T)]], axis=1)
        return {
            "distance_edges_m": list(DISTANCE_EDGES_M),
            "lateral_edges_m": list(LATERAL_EDGES_M),
            "heading_tolerance_rad": HEADING_TOLERANCE_RAD,
            "cells": np.concatenate([filled, counts], axis=1).tolist(),
        }


def summarise_support(table: SalientTable) -> SupportSummary:
    """Count a training table's obstacles and misses by cell."""
    cells = cell_of(table.salient)
    obstacles = np.zeros(SHAPE, dtype=np.int64)
    missed = np.zeros(SHAPE, dtype=np.int64)
    np.add.at(obstacles, cells, 1)
    np.add.at(missed, cells, ~table.detected)
    return SupportSummary(obstacles, missed)


def support_from_json(values: Mapping[str, Any], *, where: str) -> SupportSummary | None:
    """Read back what to_json wrote; None from an empty mapping: the model carries no counts.

    Raises:
        PemError: the counts are malformed or were made with other bands.
    """
    if not values:
        return None
    edges = (values.get("distance_edges_m"), values.get("lateral_edges_m"))
    if edges != (list(DISTANCE_EDGES_M), list(LATERAL_EDGES_M)):
        raise PemError(f"{where}: its support counts use other bands than this version of pemviz")
    try:
        cells = np.asarray(values["cells"])
        if cells.size and cells.dtype != np.int64:
            raise PemError(f"{where}: its support counts must be whole numbers")
        cells = cells.astype(np.int64).reshape(-1, len(SHAPE) + 2)
        index = tuple(cells[:, : len(SHAPE)].T)
        summary = SupportSummary(np.zeros(SHAPE, dtype=np.int64), np.zeros(SHAPE, dtype=np.int64))
        summary.obstacles[index] = cells[:, -2]
        summary.missed[index] = cells[:, -1]
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        raise PemError(f"{where}: its support counts are malformed ({error})") from None
    if (cells < 0).any() or (cells > MOST_OBSTACLES).any():
        raise PemError(f"{where}: its support counts must lie between 0 and {MOST_OBSTACLES}")
    if (summary.missed > summary.obstacles).any():
        raise PemError(f"{where}: its support counts are contradictory")
    return summary


def support_of(pem: Pem) -> SupportSummary | None:
    """The counts of training obstacles that a model carries, if it does.

    Raises:
        PemError: the counts are malformed.
    """
    card: object = getattr(pem, "card", None)
    if not isinstance(card, PemCard):
        return None
    return support_from_json(card.support, where=pem.name)


def cell_of(salient: FloatArray) -> tuple[IntArray, ...]:
    """Index arrays [n] into SHAPE of salient variables [..., 11]."""
    rows, _ = as_rows(salient)
    rotation = rows[:, COLUMN["rotation_y_rad"]]

    def near(target_rad: float) -> Any:
        difference = np.angle(np.exp(1j * (rotation - target_rad)))
        return np.abs(difference) < HEADING_TOLERANCE_RAD

    heading = np.select([near(-np.pi / 2), near(np.pi / 2)], [0, 1], 2)
    return (
        rows[:, COLUMN["class_id"]].astype(np.int64),
        rows[:, COLUMN["occlusion"]].astype(np.int64),
        np.searchsorted(LATERAL_EDGES_M, np.abs(rows[:, COLUMN["x_m"]]), side="right"),
        heading,
        np.searchsorted(DISTANCE_EDGES_M, rows[:, COLUMN["z_m"]], side="right"),
    )


def cell_in_words(class_id: int, occlusion: int, lateral: int, heading: int) -> str:
    """For example: Car, occlusion none, straight ahead (|x| < 1.5 m), heading away."""
    edges = (0.0, *LATERAL_EDGES_M, np.inf)
    low, high = edges[lateral], edges[lateral + 1]
    offset = f"|x| < {high:g} m" if lateral == 0 else f"|x| from {low:g} to {high:g} m"
    return (
        f"{CLASS_NAMES[class_id]}, occlusion {OCCLUSION_NAMES[occlusion]}, "
        f"{LATERAL_NAMES[lateral]} ({offset}), {HEADING_NAMES[heading]}"
    )


def band_in_words(band: int) -> str:
    """For example: z from 7 to 13 m."""
    edges = (-np.inf, *DISTANCE_EDGES_M, np.inf)
    low, high = edges[band], edges[band + 1]
    if band == 0:
        return f"z < {high:g} m"
    return f"z from {low:g} to {high:g} m" if np.isfinite(high) else f"z > {low:g} m"


@dataclass(frozen=True)
class BandSupport:
    """Training data in one distance band, of obstacles like those that the scenario shows."""

    index: int
    low_m: float | None
    """Lower edge of z [m]; None for the band behind the camera."""
    high_m: float | None
    """Upper edge of z [m]; None for the farthest band."""
    visits: int
    obstacles: int
    """Training obstacles of the same class, occlusion, lateral band and heading."""
    missed: int
    miss_low: float
    """Exact 95 % interval for P(missed) by the data alone: its lower and upper end."""
    miss_high: float
    miss_bound: float
    """Exact one-sided upper 95 % bound for P(missed) by the data alone."""
    model_miss: float | None
    """The model's mean P(missed) over the visits; None without visits."""


@dataclass(frozen=True)
class SupportReport:
    """What the support check found."""

    obstacle: str
    """The kinds of obstacle that the scenario shows, in words."""
    bands: tuple[BandSupport, ...]
    warnings: tuple[str, ...]


def support_check(salient: FloatArray, *, support: SupportSummary, pem: Pem) -> SupportReport:
    """Compare what a scenario visits, salient variables [..., 11], with the training data."""
    rows, _ = as_rows(salient)
    kinds, band = kinds_and_bands(rows)
    obstacles = support.obstacles[tuple(kinds.T)].sum(axis=0)
    missed = support.missed[tuple(kinds.T)].sum(axis=0)
    visits = np.bincount(band, minlength=SHAPE[-1])
    model_miss = np.exp(-np.logaddexp(0.0, pem.logit(rows)))
    model_misses = np.bincount(band, weights=model_miss, minlength=SHAPE[-1])
    edges = (None, *DISTANCE_EDGES_M, None)
    bands: list[BandSupport] = []
    for index in range(SHAPE[-1]):
        count, misses = int(obstacles[index]), int(missed[index])
        low, high = exact_interval(misses, count)
        band_support = BandSupport(
            index=index,
            low_m=edges[index],
            high_m=edges[index + 1],
            visits=int(visits[index]),
            obstacles=count,
            missed=misses,
            miss_low=low,
            miss_high=high,
            miss_bound=exact_upper_bound(misses, count),
            model_miss=float(model_misses[index]) / int(visits[index]) if visits[index] else None,
        )
        bands.append(band_support)
    words = "; ".join(cell_in_words(*(int(part) for part in kind)) for kind in kinds)
    return SupportReport(words, tuple(bands), tuple(_warnings(bands, obstacle=words)))


def closing_warnings(
    salient: FloatArray, *, dt_s: float, memory: FittedMemory | None
) -> tuple[str, ...]:
    """Whether obstacles come closer faster than in the tracks that a memory was fitted to.

    Laws of how misses hang together that fit slow tracks alike differ where P(missed) changes
    fast.

    Args:
        salient: Salient variables of violating rollouts' steps ``[N, T, 11]``, ``dt_s`` apart [s].
        dt_s: Of a step [s].
        memory: The fitted memory; ``None``, or one without a closing speed: nothing is said.
    """
    if memory is None or memory.closing_mps is None:
        return ()
    z_m = salient[..., COLUMN["z_m"]]
    closing_mps = (z_m[:, :-1] - z_m[:, 1:])[z_m[:, 1:] > 0.0] / dt_s
    if not closing_mps.size or (usual_mps := float(np.median(closing_mps))) <= memory.closing_mps:
        return ()
    return (
        f"extrapolation of the memory: {MOST_PAIRS:.0%} of the pairs of frames it was fitted to "
        f"close at under {memory.closing_mps:.1f} m/s, half of the steps of violations at over "
        f"{usual_mps:.1f} m/s: how misses hang together there no track tells; label fast "
        "approaches",
    )


def data_bound_pem(
    salient: FloatArray, *, support: SupportSummary, confidence: float = 0.95
) -> TabulatedPem:
    """The largest P(missed) that the data alone allow, as a model: for an upper bound on mu.

    In each distance band P(missed) is the exact (Clopper-Pearson) upper bound for obstacles like
    those that the scenario shows, and practically 1 where there are none. The bounds hold
    together with the given confidence: each visited band with data takes its share of the error
    probability. Where more misses make a violation more likely, as in braking for an obstacle,
    mu under this model bounds mu under every model that is constant within bands and
    compatible with the data.

    Args:
        salient: salient variables of the steps that a scenario visits, shape [..., 11].
        support: counts of the training data.
        confidence: of all bands' bounds together.
    """
    rows, _ = as_rows(salient)
    kinds, band = kinds_and_bands(rows)
    obstacles = support.obstacles[tuple(kinds.T)].sum(axis=0)
    missed = support.missed[tuple(kinds.T)].sum(axis=0)
    with_data = int(np.count_nonzero(obstacles[np.unique(band)]))
    each = 1.0 - (1.0 - confidence) / max(with_data, 1)
    logits: list[float] = []
    for count, misses in zip(obstacles.tolist(), missed.tolist(), strict=True):
        bound = exact_upper_bound(misses, count, confidence=each)
        certain = bound >= 1.0
        logits.append(NEVER_DETECTED_LOGIT if certain else float(np.log1p(-bound) - np.log(bound)))
    card = PemCard(
        name="data-bound",
        model="table",
        data=f"exact upper bounds for P(missed) by distance band, jointly {confidence:.0%}",
        licence="as the training data that the counts come from",
        recipe=f"Clopper-Pearson, each band at {each:.2%}",
    )
    lower_edges = np.asarray((BEHIND_M, *DISTANCE_EDGES_M))
    return TabulatedPem(card, lower_edges, np.asarray(logits), between="step")


def kinds_and_bands(rows: FloatArray) -> tuple[IntArray, IntArray]:
    """The kinds of obstacle among rows [n, 11], shape [kinds, 4], and each row's band, [n]."""
    *kind, band = cell_of(rows)
    visited = np.bincount(np.ravel_multi_index(kind, SHAPE[:-1]))
    return np.stack(np.unravel_index(np.flatnonzero(visited), SHAPE[:-1]), axis=1), band


def _warnings(bands: Sequence[BandSupport], *, obstacle: str) -> Iterator[str]:
    visits = sum(band.visits for band in bands)
    for band in bands:
        if band.model_miss is None:
            continue
        where = band_in_words(band.index)
        share = f"{band.visits / visits:.0%} of the scenario's steps"
        model = f"the model's P(missed) of {band.model_miss:.2g} there"
        if band.obstacles == 0:
            yield (
                f"extrapolation: no training obstacle ({obstacle}) with {where}, where {share} "
                f"fall; {model} is a guess"
            )
        elif band.missed == 0:
            yield (
                f"no misses in the data: {band.obstacles} training obstacles ({obstacle}) with "
                f"{where}, none missed, so the data allow P(missed) up to {band.miss_bound:.2g} "
                f"(95 %, exact); {model} is the model's own"
            )
        elif band.obstacles < THIN_OBSTACLES:
            yield (
                f"thin data: {band.missed} of {band.obstacles} training obstacles ({obstacle}) "
                f"with {where} were missed, P(missed) {band.miss_low:.2g} to {band.miss_high:.2g} "
                f"(95 %, exact); {model} is close to a guess"
            )
        elif not band.miss_low <= band.model_miss <= band.miss_high:
            yield (
                f"misfit: {band.missed} of {band.obstacles} training obstacles ({obstacle}) with "
                f"{where} were missed, P(missed) {band.miss_low:.2g} to {band.miss_high:.2g} "
                f"(95 %, exact), where {share} fall; {model} lies outside"
            )
