"""Where a scenario asks a model about what its training data never showed, in words."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.binomial import exact_interval, exact_upper_bound
from pemviz.pem.data.support import (
    DISTANCE_EDGES_M,
    SHAPE,
    SupportSummary,
    band_in_words,
    cell_in_words,
    cell_of,
)
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.protocol import Pem, as_rows
from pemviz.pem.models.tabulated import TabulatedPem

THIN_OBSTACLES = 30
"""Fewer training obstacles than this in a band count as thin data."""

BEHIND_M = -1e6
"""Lower edge of the band behind the camera."""

NEVER_DETECTED_LOGIT = -28.0
"""Logit of P(detected) where no data bounds P(missed): about 1e-12."""


@dataclass(frozen=True)
class BandSupport:
    """Training data in one distance band, of obstacles like those that the scenario shows."""

    index: int
    """Index of the band, near to far."""
    low_m: float | None
    """Lower edge of z [m]; None for the band behind the camera."""
    high_m: float | None
    """Upper edge of z [m]; None for the farthest band."""
    visits: int
    """Rows of the scenario in the band."""
    obstacles: int
    """Training obstacles of the same class, occlusion, lateral band and heading."""
    missed: int
    """Those among them that the detector missed."""
    miss_low: float
    """Exact 95 % interval for P(missed) by the data alone: its lower end."""
    miss_high: float
    """Its upper end."""
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
    """All distance bands, near to far."""
    warnings: tuple[str, ...]
    """Where the model extrapolates or contradicts the data, near to far; empty if nowhere."""


def support_check(salient: FloatArray, *, support: SupportSummary, pem: Pem) -> SupportReport:
    """Compare what a scenario visits with what the model was trained on.

    Args:
        salient: salient variables of the steps that a scenario visits, shape [..., 11].
        support: counts of the training data.
        pem: the model, for its own P(missed).
    """
    rows, _ = as_rows(salient)
    kinds, band = kinds_and_bands(rows)
    obstacles = support.obstacles[tuple(kinds.T)].sum(axis=0)
    missed = support.missed[tuple(kinds.T)].sum(axis=0)
    visits = np.bincount(band, minlength=SHAPE[-1])
    model_misses = np.bincount(band, weights=_miss(pem, rows), minlength=SHAPE[-1])
    bands = tuple(
        _band(
            index,
            visits=int(visits[index]),
            obstacles=int(obstacles[index]),
            missed=int(missed[index]),
            model_misses=float(model_misses[index]),
        )
        for index in range(SHAPE[-1])
    )
    words = "; ".join(cell_in_words(*(int(part) for part in kind)) for kind in kinds)
    return SupportReport(words, bands, tuple(_warnings(bands, obstacle=words)))


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


def _miss(pem: Pem, rows: FloatArray) -> FloatArray:
    return np.exp(-np.logaddexp(0.0, pem.logit(rows)))


def _band(
    index: int, *, visits: int, obstacles: int, missed: int, model_misses: float
) -> BandSupport:
    edges = (None, *DISTANCE_EDGES_M, None)
    low, high = exact_interval(missed, obstacles)
    return BandSupport(
        index=index,
        low_m=edges[index],
        high_m=edges[index + 1],
        visits=visits,
        obstacles=obstacles,
        missed=missed,
        miss_low=low,
        miss_high=high,
        miss_bound=exact_upper_bound(missed, obstacles),
        model_miss=model_misses / visits if visits else None,
    )


def _warnings(bands: tuple[BandSupport, ...], *, obstacle: str) -> Iterator[str]:
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
