"""A model of position errors fitted to a table, with what its card shows of how well it fits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.fitting.position_error_memory import (
    FittedNoiseMemory,
    LagPairs,
    fit_noise_memory,
    lag_pairs,
)
from pemviz.pem.fitting.position_errors import (
    FOLDS,
    ErrorFeatures,
    HeldOut,
    TailChoice,
    cross_fit_axis,
    error_features,
    fit_axis,
)
from pemviz.pem.models.position_error_card import PositionErrorCard
from pemviz.pem.models.position_errors import (
    INDEPENDENT,
    ErrorAxis,
    PositionErrorModel,
    standard_quantile,
)
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS

EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 120.0, 1e4)
FEWEST_IN_BAND = 50
AHEAD_M = (10.0, 30.0, 60.0)
EXTREME_M = 10.0
EXTREME_NOISE = 5.997807015007775
"""A standard normal is above it with a probability of 1e-9."""
BEYOND = (2.0, 3.0, 4.0)
BINS = 20
SHOWN_QUANTILES = 81
RESAMPLES = 400
HALF = (0.158655253931457, 0.841344746068543)
"""Quantiles of a normal at -1 and 1 standard deviation."""
LARGEST_CORRELATION = 0.99


@dataclass(frozen=True)
class FitSettings:
    """How a model is fitted.

    Attributes:
        name: Short name.
        data: What it is made from, in words.
        licence: Terms of use.
        tails: Family of the errors; ``auto``: the likelier one on held-out errors.
        seed: Of the intervals' resampling.
    """

    name: str
    data: str
    licence: str
    tails: TailChoice = "auto"
    seed: int = 0


def fit_position_errors(
    table: PositionErrorTable,
    settings: FitSettings,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> PositionErrorModel:
    """Fit mean, spread, tails, correlation and memory, and write the card.

    Args:
        table: Errors of detected obstacles.
        settings: How.
        on_progress: Told (fits done, fits in all).

    Raises:
        PemError: The table has too few rows, drives or obstacles, or no spread.
    """
    explained = error_features(table)
    words, groups = table.groups
    groups = np.unique(groups, return_inverse=True)[1].astype(np.int64)
    steps = _Steps(on_progress, in_all=(2 * FOLDS + 1) * len(table.axes))
    parts = _Parts(table, explained, groups, lag_pairs(table), settings)
    fits = [_fit_axis(parts, place, steps) for place in range(len(table.axes))]
    correlation = _correlation(np.stack([fit.noise for fit in fits]))
    model = PositionErrorModel(
        tuple(fit.axis for fit in fits), correlation, explained.distance_m, explained.bearing_rad
    )
    report = {
        "rows": len(table),
        "groups": int(groups.max()) + 1,
        "grouped_by": words,
        "note": table.note,
        "distance_m": list(explained.distance_m),
        "bearing_rad": list(explained.bearing_rad),
        "correlation": correlation.tolist(),
        "axes": [
            {**fit.row, "ahead": [_ahead(model, place, distance_m) for distance_m in AHEAD_M]}
            for place, fit in enumerate(fits)
        ],
    }
    return replace(model, card=_card(table, settings, report))


@dataclass(frozen=True, eq=False)
class _Parts:
    """What every kind of error is fitted from."""

    table: PositionErrorTable
    explained: ErrorFeatures
    groups: IntArray
    pairs: tuple[LagPairs, ...]
    settings: FitSettings


@dataclass(frozen=True, eq=False)
class _FittedAxis:
    """One kind of error, its held-out normal scores ``[n]``, and what the card says of it."""

    axis: ErrorAxis
    noise: FloatArray
    row: dict[str, Any]


def _fit_axis(parts: _Parts, place: int, steps: "_Steps") -> _FittedAxis:
    name, error = parts.table.axes[place], parts.table.errors[:, place]
    explained, groups, settings = parts.explained, parts.groups, parts.settings
    held = cross_fit_axis(explained, error, groups=groups, name=name, on_fit=steps.done)
    family = held.best if settings.tails == "auto" else settings.tails
    axis = fit_axis(explained, error, name=name, heavy=family == "student-t")
    gaussian = fit_axis(explained, error, name=name, heavy=False)
    noise = held.noise[family]
    memory = fit_noise_memory(noise, parts.pairs, groups=groups, seed=settings.seed)
    axis = replace(axis, memory=INDEPENDENT if memory is None else memory.memory)
    steps.done()
    row = {
        **_axis_scores(axis, held, noise, groups, seed=settings.seed),
        **_axis_memory(axis, memory, parts.pairs),
        "distances": _by_distance(parts.table, explained, axis, error),
        "largest": float(np.max(np.abs(error))),
        "extreme": _extreme(explained, axis, gaussian),
    }
    return _FittedAxis(axis, noise, row)


def _correlation(noises: FloatArray) -> FloatArray:
    """Of kinds of error ``[M, M]``, from noises ``[M, n]``; positive definite."""
    correlation = np.corrcoef(noises).clip(-LARGEST_CORRELATION, LARGEST_CORRELATION)
    correlation = 0.5 * (correlation + correlation.T)
    np.fill_diagonal(correlation, 1.0)
    return correlation


@dataclass
class _Steps:
    """Counts the fits."""

    tell: Callable[[int, int], None] | None
    in_all: int
    count: int = 0

    def done(self) -> None:
        """One more."""
        self.count += 1
        if self.tell is not None:
            self.tell(self.count, self.in_all)


def _card(
    table: PositionErrorTable, settings: FitSettings, report: dict[str, Any]
) -> PositionErrorCard:
    heading = "known" if table.alpha_rad is not None else "unknown, left out"
    return PositionErrorCard(
        name=settings.name,
        data=settings.data,
        data_digest=table.digest,
        licence=settings.licence,
        recipe=(
            "maximum likelihood; mean and log scale linear in functions of distance, bearing and "
            f"aspect (headings {heading}); family of tails: {settings.tails}; correlation of "
            f"held-out normal scores; intervals by resampling, seed {settings.seed}"
        ),
        report=report,
    )


def straight_ahead(distance_m: float) -> FloatArray:
    """Salient variables ``[1, 11]`` of a car straight ahead, seen from behind."""
    salient = np.zeros((1, len(SALIENT_COLUMNS)))
    salient[0, COLUMN["z_m"]] = distance_m
    salient[0, COLUMN["alpha_rad"]] = salient[0, COLUMN["rotation_y_rad"]] = -np.pi / 2
    return salient


def _ahead(model: PositionErrorModel, place: int, distance_m: float) -> dict[str, Any]:
    salient = straight_ahead(distance_m)
    return {
        "distance_m": distance_m,
        "mean": float(model.mean(salient)[0, place]),
        "sd": _finite(float(model.sd(salient)[0, place])),
        "half_width": float(model.half_width(salient)[0, place]),
    }


def _axis_scores(
    axis: ErrorAxis, held: HeldOut, noise: FloatArray, groups: IntArray, *, seed: int
) -> dict[str, Any]:
    counts = np.histogram(ndtr(noise), bins=BINS, range=(0.0, 1.0))[0]
    return {
        "name": axis.name,
        "degrees_of_freedom": _finite(axis.degrees_of_freedom),
        "nats": held.nats,
        "pit": counts.tolist(),
        "quantiles": _quantiles(noise),
        "gaussian_quantiles": _quantiles(held.noise["gaussian"]),
        "tails": [
            _tail(noise, held.noise["gaussian"], groups, beyond=beyond, seed=seed)
            for beyond in BEYOND
        ],
    }


def _quantiles(noise: FloatArray) -> list[list[float]]:
    """Expected and measured quantiles of the normal scores, for a picture."""
    count = len(noise)
    edge = float(ndtri(0.5 / count))
    place = np.unique((ndtr(np.linspace(edge, -edge, SHOWN_QUANTILES)) * count).astype(np.int64))
    shown = place.clip(0, count - 1)
    measured = np.sort(noise)[shown]
    return [[float((k + 0.5) / count), float(value)]
            for k, value in zip(shown.tolist(), measured.tolist(), strict=True)]  # fmt: skip


def _tail(
    noise: FloatArray, gaussian: FloatArray, groups: IntArray, *, beyond: float, seed: int
) -> dict[str, Any]:
    """How many normal scores lie beyond, with an interval over resampled groups."""
    far = np.bincount(groups, np.abs(noise) > beyond)
    size = np.bincount(groups).astype(np.float64)
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    chosen = random.integers(0, len(far), (RESAMPLES, len(far)))
    share = far[chosen].sum(axis=1) / size[chosen].sum(axis=1)
    low, high = np.percentile(share * len(noise), (2.5, 97.5))
    return {
        "beyond": beyond,
        "expected": float(2.0 * ndtr(-beyond) * len(noise)),
        "measured": int(far.sum()),
        "low": float(low),
        "high": float(high),
        "if_gaussian": int(np.count_nonzero(np.abs(gaussian) > beyond)),
    }


def _axis_memory(
    axis: ErrorAxis, fitted: FittedNoiseMemory | None, pairs: tuple[LagPairs, ...]
) -> dict[str, Any]:
    if fitted is None:
        return {"lags": [], "memory": None}
    told = axis.memory.correlation(np.array([each.lag_s for each in pairs])).tolist()
    rows = zip(pairs, fitted.correlations, told, strict=True)
    share, tau_s = fitted.share_interval, fitted.tau_interval_s
    return {
        "lags": [
            {"lag_s": each.lag_s, "pairs": int(each.first.size), "measured": seen, "fitted": said}
            for each, seen, said in rows
        ],
        "memory": {
            "lasting_share": _with_ends(axis.memory.lasting_share, share),
            "tau_s": _with_ends(axis.memory.tau_s, tau_s),
        },
    }


def _with_ends(value: float, ends: tuple[float, float]) -> dict[str, float]:
    return {"value": value, "low": ends[0], "high": ends[1]}


def _by_distance(
    table: PositionErrorTable, explained: ErrorFeatures, axis: ErrorAxis, error: FloatArray
) -> list[dict[str, Any]]:
    centre = explained.of_mean @ axis.mean
    scale = np.exp(explained.of_scale @ axis.log_scale)
    rows: list[dict[str, Any]] = []
    for low_m, high_m in pairwise(EDGES_M):
        inside = (table.distance_m >= low_m) & (table.distance_m < high_m)
        if np.count_nonzero(inside) < FEWEST_IN_BAND:
            continue
        own = error[inside]
        lower, upper = np.quantile(own, HALF)
        squares = np.mean(scale[inside] ** 2) * axis.sd_factor**2 + np.var(centre[inside])
        rows.append({
            "low_m": low_m,
            "high_m": high_m,
            "rows": int(own.size),
            "mean": float(np.mean(own)),
            "fitted_mean": float(np.mean(centre[inside])),
            "sd": float(np.std(own)),
            "fitted_sd": _finite(float(np.sqrt(squares))),
            "half_width": float(upper - lower) / 2.0,
            "fitted_half_width": float(np.mean(scale[inside]) * _unit(axis)),
        })  # fmt: skip
    return rows


def _unit(axis: ErrorAxis) -> float:
    one = standard_quantile(np.ones(1), degrees_of_freedom=axis.degrees_of_freedom)
    return float(one[0])


def _extreme(explained: ErrorFeatures, axis: ErrorAxis, gaussian: ErrorAxis) -> dict[str, float]:
    """The error that a car straight ahead exceeds with a probability of 1e-9."""
    said = {}
    for key, each in (("model", axis), ("gaussian", gaussian)):
        alone = PositionErrorModel(
            (replace(each, name="range"), replace(each, name="cross_range")),
            np.eye(2),
            explained.distance_m,
            explained.bearing_rad,
        )
        noise = np.full((1, 2), EXTREME_NOISE)
        said[key] = float(alone.error(straight_ahead(EXTREME_M), noise)[0, 0])
    return {"distance_m": EXTREME_M, **said}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
