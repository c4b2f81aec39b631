"""A memory's card as a picture: runs of misses, correlation of residuals, memory time by part."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pemviz.colors import BLACK, BLUE, GREY, VERMILLION
from pemviz.errors import PemError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED, FITTED, INDEPENDENT = BLACK, VERMILLION, GREY
FEWEST_RUNS = 0.3
"""Where the axis of the counts begins: what is expected less often is not seen."""


def write_memory_picture(memory: Mapping[str, Any], path: Path, *, title: str) -> None:
    """Three charts beside each other, as PNG.

    Args:
        memory: A card's table, see :func:`pemviz.pem.judging.memory_report.memory_table`.
        path: File to write.
        title: Whose memory it is.

    Raises:
        PemError: The table is not as ``pemviz.pem.judging.memory_report`` writes it.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 (slow to import)

    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    runs, lags, parts = figure.subplots(1, 3)
    try:
        _draw_runs(runs, memory)
        _draw_correlations(lags, memory)
        _draw_parts(parts, memory)
        tau_s = float(memory["fit"]["memory"]["tau_s"])
        frailty = float(memory["fit"]["memory"]["frailty"])
    except (KeyError, TypeError, ValueError) as error:
        raise PemError("metadata field 'memory' is not as pemviz writes it") from error
    figure.suptitle(f"{title}: memory time {tau_s:.2f} s, frailty {frailty:.2f}")
    figure.savefig(path, dpi=130)


def _draw_runs(axes: "Axes", memory: Mapping[str, Any]) -> None:
    counts = np.asarray(memory["run_lengths"], dtype=np.float64)
    length = np.arange(1, counts.size + 1)
    axes.bar(length, counts, color=MEASURED, alpha=0.25, label="measured")
    for key, color, label in (
        ("expected_run_lengths", FITTED, "fitted model"),
        ("independent_run_lengths", INDEPENDENT, "if independent"),
    ):
        axes.plot(length, np.asarray(memory[key], dtype=np.float64), "o-", color=color, label=label)
    axes.set_yscale("log")
    axes.set_ylim(bottom=FEWEST_RUNS)
    axes.set_xticks(length, [*map(str, length[:-1]), f"{length[-1]}+"])
    axes.set_xlabel(f"misses in a row [frames, {float(memory['rate_hz']):g} Hz]")
    axes.set_ylabel("runs")
    axes.set_title("How long bursts last")
    axes.legend()


def _draw_correlations(axes: "Axes", memory: Mapping[str, Any]) -> None:
    rows = [row for row in memory["correlations"] if row["measured"] is not None]
    lag_s = [float(row["lag_s"]) for row in rows]
    axes.plot(lag_s, [float(row["measured"]) for row in rows], "s-", color=MEASURED,
              label="measured")  # fmt: skip
    fitted = [row for row in rows if row["fitted"] is not None]
    axes.plot([float(row["lag_s"]) for row in fitted], [float(row["fitted"]) for row in fitted],
              "o-", color=FITTED, label="fitted model")  # fmt: skip
    axes.axhline(0.0, color=INDEPENDENT, label="if independent")
    axes.set_xscale("log")
    axes.set_xticks(lag_s, [f"{lag:g}" for lag in lag_s])
    axes.minorticks_off()
    axes.set_ylim(-0.05, 1.0)
    axes.set_xlabel("time between two frames of one obstacle [s]")
    axes.set_ylabel("correlation of residuals")
    axes.set_title("How long a miss is remembered")
    axes.legend()


def _draw_parts(axes: "Axes", memory: Mapping[str, Any]) -> None:
    rows = [row for row in memory["groups"] if row["tau_s"] is not None][::-1]
    place = np.arange(len(rows))
    tau_s = np.asarray([row["tau_s"] for row in rows], dtype=np.float64)
    ends = np.asarray([row["tau_interval_s"] for row in rows], dtype=np.float64).reshape(-1, 2)
    reach = np.stack([tau_s - ends[:, 0], ends[:, 1] - tau_s])
    axes.errorbar(tau_s, place, xerr=np.maximum(reach, 0.0), fmt="o", color=BLUE, capsize=3)
    names = [f"{row['name']} ({row['misses']} missed)" for row in rows]
    axes.set_yticks(place, names)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("memory time tau [s], fitted without frailty")
    axes.set_title("By distance and occlusion")
    axes.grid(axis="x", alpha=0.3)
