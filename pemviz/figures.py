"""Figures of a run as matplotlib figures, for notebooks and papers.

Each function returns a figure that a notebook shows by itself and ``savefig`` keeps; none needs a
display or pyplot.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid
from pemviz.arrays import FloatArray
from pemviz.colors import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    HOLDS,
    MISSED,
    PEM,
    PROPOSAL,
    SOURCES,
    VIOLATED,
)
from pemviz.errors import InputError
from pemviz.reports.memory_curve import BY_FRAILTY, BY_MEMORY_TIME, CurveAxis, measured_names
from pemviz.reports.uncertainty_text import UNCERTAINTY_TITLE, ends_text, source_name
from pemviz.runs.kept_stages import KeptStages
from pemviz.runs.result import RunResult
from pemviz.runs.slot_outcomes import slots_of
from pemviz.runs.uncertainty import uncertainty_budget
from pemviz.types import StageResult

WIDTH_IN = 7.0
DOTS_PER_INCH = 90
FARTHEST = 1e-40
"""An end of a range below, or at 0, is drawn at the axis' end."""
CURVE_STEP_M = 0.25
BINS = 40


class RunFigure(Figure):
    """A matplotlib figure that shows itself in a notebook without pyplot."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DOTS_PER_INCH)
        return picture.getvalue()


def uncertainty(*, result: RunResult) -> RunFigure:
    """How far the answer is open: a bar for each source of doubt, on one logarithmic axis.

    Raises:
        InputError: The run has no estimate.
    """
    sources = uncertainty_budget(result)
    if not sources:
        message = "uncertainty: the run has no estimate"
        raise InputError(message)
    figure, axes = _figure(0.45 * len(sources) + 1.0)
    known = [end for source in sources for end in (source.low, source.high) if end]
    left = max(min(known, default=1e-20) / 100.0, FARTHEST)
    for row, source in enumerate(sources):
        if source.high is None:
            axes.text(left * 3.0, row, "not bounded", color=GREY, va="center")
            continue
        low = max(source.low or 0.0, left)
        axes.plot(
            [low, max(source.high, low)], [row, row], color=SOURCES[source.kind], linewidth=6.0
        )
        axes.text(source.high * 2.0, row, " to ".join(ends_text(source)), color=BLACK, va="center")
    if result.estimate is not None and result.estimate.probability > 0.0:
        axes.axvline(result.estimate.probability, color=GREEN, linewidth=1.2)
    axes.set_yticks(range(len(sources)), [source_name(source) for source in sources])
    axes.set(xscale="log", xlim=(left, 10.0), xlabel="failure probability")
    axes.set_title(UNCERTAINTY_TITLE, loc="left")
    axes.set_ylim(len(sources) - 0.5, -0.5)
    return figure


NOT_KNOWN = "#e9ecef"


def robustness_distribution(*, stages: Sequence[StageResult], unit: str = "m") -> RunFigure:
    """Robustness of all rollouts of some stages, those that violate apart.

    Args:
        stages: For example :attr:`pemviz.KeptStages.stages`, or the last of them.
        unit: Of the metric's scores; empty for agm.

    Raises:
        InputError: There is no rollout with a finite robustness.
    """
    scores = [stage.drawn or stage.scored for stage in stages]
    robustness = _joined([scored.robustness for scored in scores])
    violated = _joined([scored.violated for scored in scores]).astype(np.bool_)
    finite = np.isfinite(robustness)
    if not finite.any():
        message = "robustness_distribution: there is no rollout with a finite robustness"
        raise InputError(message)
    figure, axes = _figure(3.4)
    edges = _edges_about_zero(robustness[finite])
    groups = (("specification holds", ~violated, HOLDS), ("violated", violated, VIOLATED))
    drawn = [(name, robustness[rows & finite], color) for name, rows, color in groups]
    axes.hist(
        [values for _, values, _ in drawn],
        bins=edges.tolist(),
        stacked=True,
        color=[color for *_, color in drawn],
        label=[f"{name} ({values.size:,})" for name, values, _ in drawn],
    )
    axes.axvline(0.0, color=BLACK, linewidth=1.0)
    bracketed = f" [{unit}]" if unit else ""
    axes.set(xlabel=f"robustness{bracketed}", ylabel="rollouts")
    axes.set_title("Robustness of rollouts", loc="left")
    axes.legend(frameon=False)
    return figure


def proposal_curves(*, kept: KeptStages, repetition: int = 0) -> RunFigure:
    """P(detected) over the gap: the error model, and the proposal that each stage sampled from.

    Args:
        kept: The observer that was given to the run.
        repetition: Whose stages.

    Raises:
        InputError: The run has not that repetition, or its scenario has no gap.
    """
    stages = [stage for stage in kept.stages if stage.repetition == repetition]
    started = kept.started
    if started is None or not stages:
        message = f"proposal_curves: nothing is kept of repetition {repetition}"
        raise InputError(message)
    if GAP not in {signal.name for signal in started.signals} or slots_of(started.simulator):
        message = "proposal_curves: only of scenarios with one obstacle and a signal named gap"
        raise InputError(message)
    gap_m = gap_grid(started.simulator, step_m=CURVE_STEP_M)
    figure, axes = _figure(3.8)
    for place, stage in enumerate(stages):
        curves = detection_curves(
            simulator=started.simulator,
            pem=started.pem,
            proposal=stage.sampled_from,
            gap_m=gap_m,
            rollouts=stage.scored.rollouts,
        )
        if place == 0:
            axes.plot(gap_m, curves.pem, color=PEM, linewidth=2.0, label="error model")
        last = place == len(stages) - 1
        axes.plot(
            gap_m,
            curves.proposal,
            color=PROPOSAL,
            alpha=1.0 if last else 0.15 + 0.5 * place / len(stages),
            linewidth=2.4 if last else 1.2,
            label=f"proposal of stage {stage.stage}" if last or place == 0 else None,
        )
    axes.set(xlabel="gap [m]", ylabel="P(detected)", ylim=(-0.02, 1.03))
    axes.set_title("How the proposal came about", loc="left")
    axes.legend(frameon=False)
    return figure


def causes(*, result: RunResult) -> RunFigure:
    """Misses in a violation by gap, and what one per cent fewer of them would bring.

    Raises:
        InputError: The run does not tell what causes violations.
    """
    explanation = result.explanation
    if explanation is None:
        message = "causes: the run does not tell what causes violations"
        raise InputError(message)
    figure, axes = _figure(4.6, rows=2)
    bands = explanation.misses_by_distance
    middles = np.array([(band.low + band.high) / 2.0 for band in bands])
    widths = np.array([0.9 * (band.high - band.low) for band in bands])
    axes[0].bar(middles, [band.misses for band in bands], width=widths, color=MISSED)
    axes[0].set(ylabel="misses in a violation")
    axes[0].set_title("Where misses cause violations", loc="left")
    _, *by_band = explanation.sensitivity
    told = [
        (middle, band.elasticity, band.std_error)
        for middle, band in zip(middles.tolist(), by_band, strict=True)
        if band.elasticity is not None
    ]
    axes[1].axhline(0.0, color=GREY, linewidth=0.8)
    for middle, elasticity, error in told:
        bar = None if error is None else 2.0 * error
        axes[1].errorbar([middle], [elasticity], yerr=bar, fmt="o", color=BLUE, capsize=3.0)
    axes[1].set(xlabel="gap [m]", ylabel="% fewer violations\nby 1 % fewer misses")
    return figure


def starts(*, result: RunResult, rule: str | None = None) -> RunFigure:
    """P(violation) in the plane of two start values, with the violating rollouts.

    Args:
        result: Of a simulator that names its random starts.
        rule: Whose violations; left out, all.

    Raises:
        InputError: The run has no such picture.
    """
    found = next((one for one in result.starts if one.rule == rule), None)
    plane = None if found is None else found.plane
    if found is None or plane is None:
        message = "starts: the run does not tell which starts are dangerous"
        raise InputError(message)
    figure, axes = _figure(4.2)
    rows = [[np.nan if v is None else v for v in row] for row in plane.log10_probability]
    ends = (
        (plane.across_low, plane.across_high, len(rows[0])),
        (plane.up_low, plane.up_high, len(rows)),
    )
    axes.set_facecolor(NOT_KNOWN)
    drawn = axes.pcolormesh(
        *(np.linspace(*end) for end in ends), np.array(rows), cmap="YlOrBr", shading="nearest"
    )
    axes.plot(
        [point.across for point in found.points],
        [point.up for point in found.points],
        ".",
        color=BLACK,
        markersize=3.0,
    )
    units = {one.name: f" [{one.unit}]" if one.unit else "" for one in found.values}
    axes.set(
        xlabel=f"{plane.across}{units[plane.across]}",
        ylabel=f"{plane.up}{units[plane.up]}",
        xlim=ends[0][:2],
        ylim=ends[1][:2],
    )
    axes.set_title("Which starts are dangerous (grey: not known)", loc="left")
    figure.colorbar(drawn, ax=axes, label="log10 P(violation)")
    return figure


def memory_curve(*, result: RunResult) -> RunFigure:
    """The failure probability over memory times of misses, with intervals.

    Raises:
        InputError: The run has no such curve.
    """
    figure, axes = _curve(result, BY_MEMORY_TIME, name="memory_curve", label="memory time [s]")
    axes.set_title("If misses come in bursts", loc="left")
    return figure


def frailty_curve(*, result: RunResult) -> RunFigure:
    """The failure probability over frailties of obstacles, with intervals.

    Raises:
        InputError: The run has no such curve.
    """
    figure, axes = _curve(result, BY_FRAILTY, name="frailty_curve", label="frailty")
    axes.set_title("If some obstacles are harder to see all along", loc="left")
    return figure


def _curve(result: RunResult, axis: CurveAxis, *, name: str, label: str) -> tuple[RunFigure, Any]:
    """A curve through its points with their intervals, and what was measured on video."""
    memory = result.memory
    curve = () if memory is None else axis.points(memory)
    points = [point for point in curve if point.probability > 0.0]
    if memory is None or not points:
        message = f"{name}: the run has none; ask for it with memory_curve=True"
        raise InputError(message)
    figure, axes = _figure(3.4)
    places = [axis.place(point) for point in points]
    axes.plot(places, [point.probability for point in points], color=PROPOSAL, linewidth=2.0)
    for place, point in zip(places, points, strict=True):
        if point.low and point.high:
            style = ":" if point.caveats else "-"
            ends = [point.low, point.high]
            axes.plot([place] * 2, ends, color=PROPOSAL, linestyle=style, marker="_")
    _mark_measured(axes, measured_names(memory, axis))
    held = not any(point.caveats for point in points)
    note = "95 % intervals" if held else "dotted: not a 95 % interval"
    axes.set(yscale="log", xlabel=f"{label} ({note})", ylabel="failure probability")
    return figure, axes


def _mark_measured(axes: Any, names: Mapping[float, str]) -> None:
    """Places that were measured on video, and of whom."""
    for place, name in names.items():
        whole = axes.get_xaxis_transform()
        axes.vlines(place, 0.0, 1.0, color=PEM, linewidth=1.0, transform=whole)
        words = f" {name.split(',')[0]}, on video"
        axes.text(place, 0.03, words, transform=whole, rotation=90, fontsize=8, ha="right")


def _figure(height_in: float, *, rows: int = 1) -> tuple[RunFigure, Any]:
    figure = RunFigure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True)
    for each in np.atleast_1d(axes):
        each.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _edges_about_zero(values: FloatArray) -> FloatArray:
    """Of bins that hold what violates or what does not, never both."""
    step = float(np.ptp(values)) / BINS or 1.0
    first, last = np.floor(np.min(values) / step), np.floor(np.max(values) / step) + 1.0
    return step * np.arange(first, last + 1.0)


def _joined(parts: Sequence[Any]) -> FloatArray:
    return np.concatenate(parts) if parts else np.zeros(0)
