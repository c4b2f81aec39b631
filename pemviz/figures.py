"""Figures of a run as matplotlib figures, for notebooks and papers.

Each function returns a figure that a notebook shows by itself and ``savefig`` keeps; none needs a
display or pyplot.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pemviz.analysis.detection_curves import GAP, detection_curves, gap_grid
from pemviz.arrays import FloatArray
from pemviz.charts.chart import with_unit
from pemviz.charts.drawing import RunFigure, drawing, empty_figure
from pemviz.colors import (
    BLACK,
    BLUE,
    GREY,
    HOLDS,
    MISSED,
    PEM,
    PROPOSAL,
    VIOLATED,
)
from pemviz.errors import InputError
from pemviz.reports.charts import memory_chart, starts_chart, uncertainty_chart
from pemviz.reports.memory_words import BY_FRAILTY, BY_MEMORY_TIME, CurveAxis
from pemviz.runs.drawn_rollout import slots_of
from pemviz.runs.observers import KeptStages
from pemviz.runs.result import RunResult
from pemviz.types import StageResult

CURVE_STEP_M = 0.25
BINS = 40


def uncertainty(*, result: RunResult) -> RunFigure:
    """How far the answer is open: a bar for each source of doubt, on one logarithmic axis.

    Raises:
        InputError: The run has no estimate.
    """
    chart = uncertainty_chart(result)
    if chart is None:
        message = "uncertainty: the run has no estimate"
        raise InputError(message)
    return drawing(chart)


def robustness_distribution(*, stages: Sequence[StageResult], unit: str = "m") -> RunFigure:
    """Robustness of all rollouts of some stages, those that violate apart.

    Args:
        stages: For example :attr:`pemviz.KeptStages.stages`, or the last of them.
        unit: Of the metric's scores; empty for agm.

    Raises:
        InputError: There is no rollout with a finite robustness.
    """
    scores = [stage.sampled or stage.scored for stage in stages]
    robustness = _joined([scored.robustness for scored in scores])
    violated = _joined([scored.violated for scored in scores]).astype(np.bool_)
    finite = np.isfinite(robustness)
    if not finite.any():
        message = "robustness_distribution: there is no rollout with a finite robustness"
        raise InputError(message)
    figure, axes = empty_figure(3.4)
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
    axes.set(xlabel=with_unit("robustness", unit), ylabel="rollouts")
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
    figure, axes = empty_figure(3.8)
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
    figure, axes = empty_figure(4.6, rows=2)
    bands = explanation.misses_by_distance
    middles = np.array([(band.low + band.high) / 2.0 for band in bands])
    widths = np.array([0.9 * (band.high - band.low) for band in bands])
    axes[0].bar(middles, [band.misses for band in bands], width=widths, color=MISSED)
    axes[0].set(ylabel="misses in a violation")
    axes[0].set_title("Where misses cause violations", loc="left")
    _, *by_band = explanation.sensitivity
    known = [
        (middle, band.elasticity, band.std_error)
        for middle, band in zip(middles.tolist(), by_band, strict=True)
        if band.elasticity is not None
    ]
    axes[1].axhline(0.0, color=GREY, linewidth=0.8)
    for middle, elasticity, error in known:
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
    chart = None if found is None else starts_chart(found)
    if chart is None:
        message = "starts: the run does not tell which starts are dangerous"
        raise InputError(message)
    return drawing(chart)


def memory_curve(*, result: RunResult) -> RunFigure:
    """The failure probability over memory times of misses, with intervals.

    Raises:
        InputError: The run has no such curve.
    """
    return _curve(result, BY_MEMORY_TIME, name="memory_curve")


def frailty_curve(*, result: RunResult) -> RunFigure:
    """The failure probability over frailties of obstacles, with intervals.

    Raises:
        InputError: The run has no such curve.
    """
    return _curve(result, BY_FRAILTY, name="frailty_curve")


def _curve(result: RunResult, axis: CurveAxis, *, name: str) -> RunFigure:
    chart = None if result.memory is None else memory_chart(result.memory, axis)
    if chart is None:
        message = f"{name}: the run has none; ask for it with memory_curve=True"
        raise InputError(message)
    return drawing(chart)


def _edges_about_zero(values: FloatArray) -> FloatArray:
    """Of bins that hold what violates or what does not, never both."""
    step = float(np.ptp(values)) / BINS or 1.0
    first, last = np.floor(np.min(values) / step), np.floor(np.max(values) / step) + 1.0
    return step * np.arange(first, last + 1.0)


def _joined(parts: Sequence[Any]) -> FloatArray:
    return np.concatenate(parts) if parts else np.zeros(0)
