"""The Learning page: how the proposal forms, and what the estimate makes of it."""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.charts.svg import Axis, Plot
from pemviz.colors import BLUE, GREEN, GREY, ORANGE, PEM, PROPOSAL, VERMILLION
from pemviz.panel.curve_chart import Curves, Line, curves_svg, over_common
from pemviz.panel.pieces import cells, number, quiet
from pemviz.panel.run_data import RunData
from pemviz.runs.result import StageSummary
from pemviz.runs.uncertainty import run_interval_caveats
from pemviz.sampling.estimates.diagnostics import SMALL_ESS

HEIGHT = 220
OLDER = ("#E8894A", "#EDA878", "#F0BE9B", "#F3D0B7", "#F6DFCF")
"""Of proposals learned before the newest one, paler and paler."""
FAR_BELOW = -60.0
MOST_DECADES = 10.0
LONGEST_NAME = 18
DOUBTED = "3 3"
"""How an interval is dashed that is no 95 % interval."""


def learning(run: RunData) -> str:
    """What there is to see, in a few sentences, and all charts."""
    return run.memo.get("learning", lambda: _learning(run))


def _learning(run: RunData) -> str:
    method, every = run.method, run.result.stages
    last = max((stage.repetition for stage in every), default=0)
    stages = [stage for stage in every if stage.repetition == last]
    several = len(stages) > 1 and method.stages != "parts"
    plots = [_estimate_plot(run, stages if several else [])]
    if several and method.stages == "runs":
        title = "Particles that violate at a run's end"
        plots.append(_failure_plot(stages, title=title, each="run"))
    elif several:
        unit = "" if run.config.metric == "agm" else " [m]"
        plots += [_threshold_plot(stages, unit=unit), _failure_plot(stages), _ess_plot(stages)]
    curves = proposal_curves(run)
    drawn = "" if curves is None else curves_svg(curves)
    return quiet(method.learning_words) + cells(drawn, *plots)


def proposal_curves(run: RunData) -> Curves | None:
    """The newest proposal, some of those before it, and the error model."""
    if not run.gap_m.size:
        return None
    method = run.method
    newest_first = [] if method.follows_model else list(reversed(run.final_curves))
    lines: list[Line] = []
    most = 1 if run.running else 1 + len(OLDER)
    if len(newest_first) > most:  # the first, the last, and some between them
        places = np.linspace(0, len(newest_first) - 1, most).round().astype(int)
        newest_first = [newest_first[int(place)] for place in places]
    for age, curve in enumerate(newest_first):
        name = method.curve_name or f"proposal after stage {curve.stage}"
        if run.running:  # the same name all along: the chart is not built anew at each stage
            name = "newest proposal"
        color = PROPOSAL if age == 0 else OLDER[age - 1]
        values = over_common(run.gap_m, run.gap_m, curve.detection)
        lines.append(Line(name, values, color, width=2.6 if age == 0 else 1.4))
    pem = run.config.pem.rsplit("/", 1)[-1]
    pem = pem if len(pem) <= LONGEST_NAME else pem[: LONGEST_NAME - 1] + "\N{HORIZONTAL ELLIPSIS}"
    model = Line(f"error model ({pem})", run.pem_detection, PEM, 2.0, (7.0, 3.0))
    rollouts = run.curves_from
    means = "" if rollouts is None else f" (from {rollouts:,} rollouts a stage)"
    return Curves(
        title=f"P(detected) over the gap{means}",
        x=run.gap_m,
        x_label="gap [m]",
        y_label="P(detected)",
        lines=(*lines, model),
        y_range=(0.0, 1.0),
    )


def _threshold_plot(stages: Sequence[StageSummary], *, unit: str) -> str:
    points = [(s.stage, s.threshold) for s in stages if s.threshold is not None]
    known = [0.0, *(value for _, value in points)]
    margin = 0.08 * (max(known) - min(known)) or 1.0
    plot = Plot(
        title="Threshold: rollouts at or below it are learned from",
        x=_stage_axis(stages),
        y=Axis(min(known) - margin, max(known) + margin, f"robustness{unit}"),
        height=HEIGHT,
    )
    plot.hline(0.0, color=VERMILLION, label="violation below 0")
    _dots(plot, points, color=BLUE)
    return plot.text()


def _failure_plot(
    stages: Sequence[StageSummary],
    *,
    title: str = "Rollouts that violate",
    each: str = "stage",
) -> str:
    share = Axis(0.0, 100.0, "share [%]", ticks=(0.0, 50.0, 100.0))
    plot = Plot(title=title, x=_stage_axis(stages, each), y=share, height=HEIGHT)
    for stage in stages:
        if stage.rollouts:
            edges = np.array([stage.stage - 0.35, stage.stage + 0.35])
            heights = np.array([100.0 * stage.failures / stage.rollouts])
            tip = f"{each} {stage.stage}: {stage.failures} of {stage.rollouts}"
            plot.bars(edges, heights, color=ORANGE, tips=[tip])
    return plot.text()


def _ess_plot(stages: Sequence[StageSummary]) -> str:
    points = [(s.stage, s.ess) for s in stages if s.ess is not None]
    top = max([1.2 * SMALL_ESS, *(ess for _, ess in points)]) * 1.1
    plot = Plot(
        title="Effective sample size of the violations",
        x=_stage_axis(stages),
        y=Axis(0.0, top, "rollouts"),
        height=HEIGHT,
    )
    plot.hline(SMALL_ESS, color=GREY, label=f"below {SMALL_ESS:g}: do not quote")
    _dots(plot, points, color=GREEN)
    if not points:
        plot.note("no violation yet", (plot.left + plot.right) / 2, plot.top + 30, anchor="middle")
    return plot.text()


def _dots(plot: Plot, points: Sequence[tuple[int, float]], *, color: str) -> None:
    xs, ys = [float(stage) for stage, _ in points], [value for _, value in points]
    plot.line(np.array(xs), np.array(ys), color=color)
    tips = [f"stage {stage}: {number(value)}" for stage, value in points]
    plot.points(xs, ys, color=color, tips=tips)


def _estimate_plot(run: RunData, stages: Sequence[StageSummary]) -> str:
    """Estimates of stages, the answer with its interval, and the reference, on a log axis."""
    estimate, reference = run.result.estimate, run.result.reference
    method = run.method
    each, several = method.stage_name, bool(stages) and method.stage_interval != "none"
    points: list[tuple[float, float]] = []
    if several:
        every = ((float(s.stage), s.log10_probability) for s in stages)
        points = [(stage, value) for stage, value in every if value is not None]
    answer = [] if estimate is None else _logs(estimate.probability)
    interval = [] if estimate is None else _logs(estimate.ci_low, estimate.ci_high)
    bound = [] if answer or estimate is None else _logs(estimate.ci_high)
    exact = [] if reference is None else _logs(reference.probability)
    low, high = _decades([*(v for _, v in points), *exact, *answer, *interval])
    x = _stage_axis(stages, each) if several else Axis(-1.0, 1.0, "all rollouts", ticks=())
    plot = Plot(
        title="Estimate of P(violation)",
        x=x,
        y=Axis(low, high, "probability", log10=True),
        height=HEIGHT,
        left=52,
        bottom=48,
    )
    caveats = run_interval_caveats(run.result)
    of_level, dash = ("not a 95 %", DOUBTED) if caveats else ("95 %", "")
    for value in exact:
        plot.hline(value, color=GREEN, dash="", label="reference")
    for value in bound:
        plot.hline(value, color=VERMILLION, label=f"no violation seen: {of_level} upper bound")
    in_range = [(s, v) for s, v in points if v >= low]
    tips = [f"{each} {s:g} alone: {number(10.0**v)}" for s, v in in_range]
    plot.points([s for s, _ in in_range], [v for _, v in in_range], color=GREY, tips=tips)
    at = x.high - 0.35 if several else 0.0
    for value in answer:
        if len(interval) == 2:
            plot.whisker(at, *interval, color=VERMILLION, dash=dash)
        tip = f"answer {number(10.0**value)}"
        plot.points([at], [value], color=VERMILLION, radius=4.0, tips=[tip])
    if not (answer or in_range or bound):
        words = "no violation yet" if run.running else "no violation seen"
        plot.note(words, (plot.left + plot.right) / 2, plot.top + 50, anchor="middle")
    entries = [(f"a {each} alone", GREY, "")] * several
    entries.append((f"answer, {of_level} interval", VERMILLION, dash))
    entries += [("reference", GREEN, "")] * (reference is not None)
    begin = plot.left
    for entry in entries:  # side by side beneath the plot
        plot.legend([entry], x=begin, y=plot.height - 6)
        begin += 27 + round(5.3 * len(entry[0]))
    return plot.text()


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Whole powers of ten around decimal logarithms; what is lower by far does not count."""
    in_range = [value for value in values if value > FAR_BELOW]
    if not in_range:
        return -20.0, 0.0
    least = max(min(in_range), float(np.median(in_range)) - MOST_DECADES)
    return math.floor(least) - 1.0, min(math.ceil(max(in_range)) + 1.0, 0.0)


def _stage_axis(stages: Sequence[StageSummary], each: str = "stage") -> Axis:
    last = max((s.stage for s in stages), default=0)
    step = max(1, (last + 6) // 12)
    return Axis(-0.6, last + 0.6, each, ticks=tuple(float(t) for t in range(0, last + 1, step)))


def _logs(*values: float | None) -> list[float]:
    """Decimal logarithms of those figures that are there, finite and above 0."""
    return [math.log10(v) for v in values if v is not None and 0.0 < v < math.inf]
