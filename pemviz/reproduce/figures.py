"""The paper's figures drawn with matplotlib, without a display."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, BLUE, GREEN, GREY, VERMILLION
from pemviz.config import ScenarioConfig
from pemviz.reproduce.least_safe import LeastSafeSearch

DOTS_PER_INCH = 150
WIDTH_IN, HEIGHT_IN = 7.0, 4.2
# colour, line, width: curves that coincide stay visible, the widest drawn first
METRIC_STYLES = {
    "classical": (BLUE, "-", 3.4),
    "agm": (VERMILLION, "--", 2.2),
    "smooth-cumulative": (GREEN, "-.", 1.8),
}
LIMIT_M = 2.0


def learned_proposal_png(
    *, gap_m: FloatArray, pem: FloatArray, proposals: Sequence[FloatArray], emergency_gap_m: float
) -> bytes:
    """P(detected) against gap: the error model and the finally learned proposals.

    Args:
        gap_m: ``[G]``.
        pem: ``[G]``.
        proposals: One curve ``[G]`` for each repetition.
        emergency_gap_m: Marked by a line.
    """
    figure, axes = _figure()
    _gap_axes(axes, gap_m, emergency_gap_m)
    for number, curve in enumerate(proposals):
        label = "learned proposal, each repetition" if number == 0 else None
        axes.plot(gap_m, curve, color=BLUE, linewidth=0.8, alpha=0.35, label=label)
    mean = np.mean(np.stack(proposals), axis=0)
    axes.plot(gap_m, mean, color=BLUE, linewidth=2.4, label="learned proposal, mean")
    axes.plot(gap_m, pem, color=BLACK, linewidth=1.8, linestyle="--", label="error model (PEM)")
    axes.set_title("The learned proposal misses where missing is dangerous", loc="left")
    axes.legend(loc="lower right", frameon=False)
    return _png(figure)


def stage_proposals_png(
    *,
    gap_m: FloatArray,
    pem: FloatArray,
    by_metric: Mapping[str, Sequence[FloatArray]],
    stage: int,
    emergency_gap_m: float,
) -> bytes:
    """P(detected) against gap after a stage, by metric: mean and spread over repetitions."""
    figure, axes = _figure()
    _gap_axes(axes, gap_m, emergency_gap_m)
    axes.plot(gap_m, pem, color=BLACK, linewidth=1.4, linestyle=":", label="error model (PEM)")
    for metric, curves in by_metric.items():
        color, line, width = METRIC_STYLES[metric]
        values = np.stack(curves)
        mean, spread = values.mean(axis=0), values.std(axis=0)
        low, high = np.clip(mean - spread, 0.0, 1.0), np.clip(mean + spread, 0.0, 1.0)
        axes.fill_between(gap_m, low, high, color=color, alpha=0.15, linewidth=0.0)
        axes.plot(gap_m, mean, color=color, linestyle=line, linewidth=width, label=metric)
    repetitions = max(len(curves) for curves in by_metric.values())
    axes.set_title(
        f"Proposals at stage {stage} by metric: mean of {repetitions}, band of one standard "
        "deviation",
        loc="left",
        fontsize="medium",
    )
    axes.legend(loc="lower right", frameon=False)
    return _png(figure)


def least_safe_png(search: LeastSafeSearch, scenario: ScenarioConfig) -> bytes:
    """Gap against time of the least safe rollout of each metric, and what each step detected."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN * 1.25), dpi=DOTS_PER_INCH, layout="constrained")
    upper, lower = figure.subplots(
        2, 1, sharex=True, gridspec_kw={"height_ratios": [3.0, max(len(search.found), 1) * 0.35]}
    )
    for one in search.found:
        color, line, width = METRIC_STYLES[one.metric]
        time_s = np.arange(one.gap_m.size) * search.dt_s
        label = f"{one.metric} (closest: {one.gap_m.min():.2f} m)"
        upper.plot(time_s, one.gap_m, color=color, linestyle=line, linewidth=width, label=label)
    _horizontal(upper, LIMIT_M, "specified: not below 2 m", at=0.0, align="left")
    _horizontal(
        upper, scenario.emergency_gap_m, "emergency braking on a detection", at=1.0, align="right"
    )
    upper.set_ylabel("gap [m]")
    upper.set_ylim(bottom=0.0)
    upper.legend(loc="upper right", frameon=False)
    upper.set_title(
        f"Least safe of {search.rollouts - search.violating} random rollouts that hold "
        f"(of {search.rollouts} drawn)",
        loc="left",
    )
    _outcomes(lower, search)
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def _outcomes(axes: Any, search: LeastSafeSearch) -> None:
    for row, one in enumerate(search.found):
        color, _, _ = METRIC_STYLES[one.metric]
        time_s = np.arange(one.detected.size) * search.dt_s
        axes.plot(time_s[one.detected], np.full(int(one.detected.sum()), row), "|",
                  color=color, markersize=8)  # fmt: skip
        missed = ~one.detected
        axes.plot(time_s[missed], np.full(int(missed.sum()), row), ".", color=GREY, markersize=3)
    axes.set_yticks(range(len(search.found)), [one.metric for one in search.found])
    axes.set_ylim(len(search.found) - 0.5, -0.5)
    axes.set_xlabel("time [s];  bar: detected, dot: missed")


def _figure() -> tuple[Any, Any]:
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _gap_axes(axes: Any, gap_m: FloatArray, emergency_gap_m: float) -> None:
    axes.set_xlim(float(gap_m[0]), float(gap_m[-1]))
    axes.set_ylim(-0.02, 1.05)
    axes.set_xlabel("gap [m]")
    axes.set_ylabel("P(detected) [-]")
    for value, text in ((LIMIT_M, "2 m"), (emergency_gap_m, f"{emergency_gap_m:g} m")):
        axes.axvline(value, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)))
        axes.annotate(text, (value, 0.0), xytext=(3, 2), textcoords="offset points",
                      color="#555555", fontsize="small")  # fmt: skip


def _horizontal(axes: Any, value: float, text: str, *, at: float, align: str) -> None:
    axes.axhline(value, color=GREY, linewidth=0.8, linestyle=(0, (2, 2)))
    axes.annotate(text, (at, value), xycoords=("axes fraction", "data"), xytext=(0, 3),
                  textcoords="offset points", ha=align, color="#555555",
                  fontsize="small")  # fmt: skip


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    # no software version inside: the same figures give the same bytes
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
