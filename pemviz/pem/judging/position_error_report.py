"""A model of position errors fitted to a table, with what its card shows of how well it fits."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtr, ndtri

from pemviz.arrays import FloatArray, IntArray
from pemviz.colors import BLACK, BLUE, GREY, VERMILLION
from pemviz.errors import PemError
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.fitting import position_errors as fitting
from pemviz.pem.fitting.position_errors import ErrorFeatures, FittedNoiseMemory, HeldOut, LagPairs
from pemviz.pem.judging.memory_report import draw_lags
from pemviz.pem.models.cards import AXIS_UNITS, AXIS_WORDS, PositionErrorCard, as_pemviz_writes
from pemviz.pem.models.position_errors import INDEPENDENT, ErrorAxis, PositionErrorModel
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
MEASURED, FITTED, GAUSSIAN = BLACK, VERMILLION, GREY
FARTHEST_SHOWN_M = 120.0


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
    tails: fitting.TailChoice = "auto"
    seed: int = 0


def fit_position_errors(
    table: PositionErrorTable,
    settings: FitSettings,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> PositionErrorModel:
    """Fit mean, spread, tails, correlation and memory, and write the card.

    ``on_progress`` is called with fits done and fits in all.

    Raises:
        PemError: The table has too few rows, drives or obstacles, or no spread.
    """
    explained = fitting.error_features(table)
    words, groups = table.groups
    groups = np.unique(groups, return_inverse=True)[1].astype(np.int64)
    steps, in_all = count(1), (2 * fitting.FOLDS + 1) * len(table.axes)

    def on_fit() -> None:
        if on_progress is not None:
            on_progress(next(steps), in_all)

    pairs = fitting.lag_pairs(table)
    axes: list[ErrorAxis] = []
    noises: list[FloatArray] = []
    rows: list[dict[str, Any]] = []
    for place, name in enumerate(table.axes):
        error = table.errors[:, place]
        held = fitting.cross_fit_axis(explained, error, groups=groups, name=name, on_fit=on_fit)
        family = held.best if settings.tails == "auto" else settings.tails
        axis = fitting.fit_axis(explained, error, name=name, heavy=family == "student-t")
        gaussian = fitting.fit_axis(explained, error, name=name, heavy=False)
        noise = held.noise[family]
        memory = fitting.fit_noise_memory(noise, pairs, groups=groups, seed=settings.seed)
        axis = replace(axis, memory=INDEPENDENT if memory is None else memory.memory)
        on_fit()
        axes.append(axis)
        noises.append(noise)
        rows.append({
            **_axis_scores(axis, held, noise, groups, seed=settings.seed),
            **_axis_memory(axis, memory, pairs),
            "distances": _by_distance(table, explained, axis, error),
            "largest": float(np.max(np.abs(error))),
            "extreme": _extreme(explained, axis, gaussian),
        })  # fmt: skip
    correlation = np.corrcoef(np.stack(noises)).clip(-LARGEST_CORRELATION, LARGEST_CORRELATION)
    correlation = 0.5 * (correlation + correlation.T)
    np.fill_diagonal(correlation, 1.0)
    model = PositionErrorModel(
        tuple(axes), correlation, explained.distance_m, explained.bearing_rad
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
            {**row, "ahead": [_ahead(model, place, distance_m) for distance_m in AHEAD_M]}
            for place, row in enumerate(rows)
        ],
    }
    heading = "known" if table.alpha_rad is not None else "unknown, left out"
    card = PositionErrorCard(
        name=settings.name,
        data=settings.data,
        data_digest=table.digest,
        licence=settings.licence,
        recipe=(
            "maximum likelihood; mean and log scale linear in functions of distance, bearing and "
            f"aspect (headings {heading}); kind of tails: {settings.tails}; correlation of "
            f"held-out normal scores; intervals by resampling, seed {settings.seed}"
        ),
        report=report,
    )
    return replace(model, card=card)


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
    of_model = axis.memory.correlation(np.array([each.lag_s for each in pairs])).tolist()
    rows = zip(pairs, fitted.correlations, of_model, strict=True)

    def with_ends(value: float, ends: tuple[float, float]) -> dict[str, float]:
        return {"value": value, "low": ends[0], "high": ends[1]}

    return {
        "lags": [
            {"lag_s": each.lag_s, "pairs": int(each.first.size), "measured": seen, "fitted": said}
            for each, seen, said in rows
        ],
        "memory": {
            "lasting_share": with_ends(axis.memory.lasting_share, fitted.share_interval),
            "tau_s": with_ends(axis.memory.tau_s, fitted.tau_interval_s),
        },
    }


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
            "fitted_half_width": float(np.mean(scale[inside]) * axis.half_width_factor),
        })  # fmt: skip
    return rows


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


def write_position_picture(model: PositionErrorModel, path: Path) -> None:
    """Four charts for each kind of error, as PNG: spread, calibration, tails and memory.

    Raises:
        PemError: The card has no report, or one that pemviz did not write.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    report = model.card.report
    if not report:
        raise PemError(f"{model.name}: its card has no report to draw")
    figure = Figure(figsize=(15.0, 3.7 * len(model.axes)), layout="constrained")
    rows = figure.subplots(len(model.axes), 4)
    with as_pemviz_writes(f"{model.name}: its report"):
        for charts, axis in zip(rows, report["axes"], strict=True):
            _draw_distances(charts[0], axis)
            _draw_pit(charts[1], axis)
            _draw_quantiles(charts[2], axis)
            charts[3].set_title("The same obstacle over time")
            if axis["lags"]:
                draw_lags(charts[3], axis["lags"])
                charts[3].set_xlabel("time between two frames [s]")
                charts[3].set_ylabel("correlation of the noise")
            else:
                charts[3].text(0.5, 0.5, "no tracks:\nindependence is assumed", ha="center",
                               va="center", transform=charts[3].transAxes)  # fmt: skip
                charts[3].set_axis_off()
        words = f"{report['rows']:,} errors, {report['groups']:,} {report['grouped_by']}"
    figure.suptitle(f"Position errors {model.name}: {words}; calibration is held out")
    figure.savefig(path, dpi=110)


def _draw_distances(axes: "Axes", axis: Mapping[str, Any]) -> None:
    rows = axis["distances"]
    middle = [(row["low_m"] + min(row["high_m"], FARTHEST_SHOWN_M)) / 2 for row in rows]
    for key, fitted, mark, words in (
        ("half_width", "fitted_half_width", "o", "68 % within +-"),
        ("sd", "fitted_sd", "s", "standard deviation"),
        ("mean", "fitted_mean", "^", "mean"),
    ):
        axes.plot(middle, [row[key] for row in rows], mark, color=MEASURED, label=words)
        curve = [np.nan if row[fitted] is None else row[fitted] for row in rows]
        axes.plot(middle, curve, "-", color=FITTED)
    axes.plot([], [], "-", color=FITTED, label="fitted")
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlabel("distance [m]")
    axes.set_ylabel(f"error {AXIS_WORDS[axis['name']]} [{AXIS_UNITS[axis['name']]}]")
    axes.set_title("By distance")
    axes.legend()


def _draw_pit(axes: "Axes", axis: Mapping[str, Any]) -> None:
    counts = np.asarray(axis["pit"], dtype=np.float64)
    edges = np.linspace(0.0, 1.0, counts.size + 1)
    axes.stairs(counts / counts.mean(), edges, fill=True, color=BLUE, alpha=0.4)
    axes.axhline(1.0, color=FITTED, label="calibrated")
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("share of the model's errors that are smaller")
    axes.set_ylabel("density of the data")
    axes.set_title("Calibration")
    axes.legend()


def _draw_quantiles(axes: "Axes", axis: Mapping[str, Any]) -> None:
    freedom = axis["degrees_of_freedom"]
    family = "Gaussian" if freedom is None else f"Student's t, {freedom:.1f} d.o.f."
    for key, color, words in (
        ("gaussian_quantiles", GAUSSIAN, "were it Gaussian"),
        ("quantiles", FITTED, family),
    ):
        share, measured = np.asarray(axis[key], dtype=np.float64).T
        axes.plot(ndtri(share), measured, ".", color=color, label=words)
    reach = 1.3 * float(np.abs(ndtri(np.asarray(axis["quantiles"])[:, 0])).max())
    axes.plot([-reach, reach], [-reach, reach], color=MEASURED, linewidth=0.8, label="calibrated")
    axes.set_ylim(-2.5 * reach, 2.5 * reach)
    axes.set_xlabel("quantile of a standard normal")
    axes.set_ylabel("quantile of the noise")
    axes.set_title("Tails")
    axes.legend()
