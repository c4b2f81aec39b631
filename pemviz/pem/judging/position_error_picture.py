"""A model of position errors as a picture: spread by distance, calibration, tails, memory."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtri

from pemviz.colors import BLACK, BLUE, GREY, VERMILLION
from pemviz.errors import PemError
from pemviz.pem.models.position_error_card import AXIS_UNITS, AXIS_WORDS
from pemviz.pem.models.position_errors import PositionErrorModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED, FITTED, GAUSSIAN = BLACK, VERMILLION, GREY
FARTHEST_SHOWN_M = 120.0


def write_position_picture(model: PositionErrorModel, path: Path) -> None:
    """Four charts for each kind of error, as PNG.

    Args:
        model: With a card that has a report.
        path: File to write.

    Raises:
        PemError: The card has no report, or one that pemviz did not write.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    report = model.card.report
    if not report:
        raise PemError(f"{model.name}: its card has no report to draw")
    figure = Figure(figsize=(15.0, 3.7 * len(model.axes)), layout="constrained")
    rows = figure.subplots(len(model.axes), 4)
    try:
        for charts, axis in zip(rows, report["axes"], strict=True):
            _draw_distances(charts[0], axis)
            _draw_pit(charts[1], axis)
            _draw_quantiles(charts[2], axis)
            _draw_lags(charts[3], axis)
        words = f"{report['rows']:,} errors, {report['groups']:,} {report['grouped_by']}"
    except (KeyError, TypeError, ValueError) as error:
        raise PemError(f"{model.name}: its report is not as pemviz writes it") from error
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
        told = [np.nan if row[fitted] is None else row[fitted] for row in rows]
        axes.plot(middle, told, "-", color=FITTED)
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


def _draw_lags(axes: "Axes", axis: Mapping[str, Any]) -> None:
    axes.set_title("The same obstacle over time")
    if not axis["lags"]:
        axes.text(0.5, 0.5, "no tracks:\nindependence is assumed", ha="center", va="center",
                  transform=axes.transAxes)  # fmt: skip
        axes.set_axis_off()
        return
    lag_s = [row["lag_s"] for row in axis["lags"]]
    axes.plot(lag_s, [row["measured"] for row in axis["lags"]], "o", color=MEASURED,
              label="measured")  # fmt: skip
    axes.plot(lag_s, [row["fitted"] for row in axis["lags"]], "-", color=FITTED, label="fitted")
    axes.axhline(0.0, color=GREY, label="if independent")
    axes.set_xscale("log")
    axes.set_xticks(lag_s, [f"{lag:g}" for lag in lag_s])
    axes.minorticks_off()
    axes.set_ylim(-0.05, 1.0)
    axes.set_xlabel("time between two frames [s]")
    axes.set_ylabel("correlation of the noise")
    axes.legend()
