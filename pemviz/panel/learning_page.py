"""The Learning page: how the proposal forms, and what the estimate makes of it."""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.charts.chart import (
    SOLID,
    Axis,
    Band,
    Bars,
    Line,
    Mark,
    PlaneChart,
    Points,
    Rule,
    with_unit,
)
from pemviz.colors import BLUE, GREEN, GREY, ORANGE, PEM, PROPOSAL, VERMILLION
from pemviz.panel.pieces import cells, drawn, number, quiet
from pemviz.panel.run_data import RunData
from pemviz.runs.result import StageSummary
from pemviz.runs.uncertainty import run_interval_caveats
from pemviz.sampling.estimates.diagnostics import SMALL_ESS

OLDER = ("#E8894A", "#EDA878", "#F0BE9B", "#F3D0B7", "#F6DFCF")
"""Of proposals learned before the newest one, paler and paler."""
FAR_BELOW = -60.0
MOST_DECADES = 10.0
LONGEST_NAME = 18


def learning(run: RunData) -> str:
    """What there is to see, in a few sentences, and all charts."""
    return run.memo.get("learning", lambda: _learning(run))


def _learning(run: RunData) -> str:
    method, every = run.method, run.result.stages
    last = max((stage.repetition for stage in every), default=0)
    stages = [stage for stage in every if stage.repetition == last]
    several = len(stages) > 1 and method.stages != "parts"
    shown = stages if several and method.stage_interval != "none" else []
    estimate = drawn(estimate_chart(run, shown), caption=_unseen_words(run, shown))
    plots = [drawn(proposal_chart(run)), estimate]
    if several and method.stages == "runs":
        title = "Particles that violate at a run's end"
        plots.append(drawn(failure_chart(stages, title=title, each="run")))
    elif several:
        unit = run.robustness_unit
        plots += [drawn(threshold_chart(stages, unit=unit)), drawn(failure_chart(stages))]
        seen = any(stage.ess is not None for stage in stages)
        plots.append(drawn(ess_chart(stages), caption="" if seen else "No violation yet."))
    return quiet(method.learning_words) + cells(*plots)


def proposal_chart(run: RunData) -> PlaneChart | None:
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
        color = PROPOSAL if age == 0 else OLDER[age - 1]
        width = 2.6 if age == 0 else 1.4
        lines.append(Line(run.gap_m, curve.detection, color, name, width=width))
    pem = run.config.pem.rsplit("/", 1)[-1]
    pem = pem if len(pem) <= LONGEST_NAME else pem[: LONGEST_NAME - 1] + "\N{HORIZONTAL ELLIPSIS}"
    model = Line(run.gap_m, run.pem_detection, PEM, f"error model ({pem})", width=2.0, dash="7 3")
    rollouts = run.curves_from
    means = "" if rollouts is None else f" (from {rollouts:,} rollouts a stage)"
    return detection_chart(f"P(detected) over the gap{means}", (*lines, model))


def detection_chart(title: str, lines: Sequence[Line]) -> PlaneChart:
    """Curves of P(detected) over the gap."""
    ends = [float(line.x[place]) for line in lines for place in (0, -1)]
    x, y = Axis(min(ends), max(ends), "gap [m]"), Axis(0.0, 1.06, "P(detected)")
    return PlaneChart(title, x, y, tuple(lines), width=420, height=240)


def threshold_chart(stages: Sequence[StageSummary], *, unit: str) -> PlaneChart:
    """The level of each stage."""
    points = [(s.stage, s.threshold) for s in stages if s.threshold is not None]
    known = [0.0, *(value for _, value in points)]
    margin = 0.08 * (max(known) - min(known)) or 1.0
    rule = Rule(0.0, "violation below 0", VERMILLION, upright=False)
    return PlaneChart(
        "Threshold: rollouts at or below it are learned from",
        x=_stage_axis(stages),
        y=Axis(min(known) - margin, max(known) + margin, with_unit("robustness", unit)),
        marks=(rule, _dots(points, BLUE, "threshold")),
    )


def failure_chart(
    stages: Sequence[StageSummary], *, title: str = "Rollouts that violate", each: str = "stage"
) -> PlaneChart:
    """How many rollouts of each stage violate."""
    numbers = range(max((s.stage for s in stages), default=0) + 1)
    of = {stage.stage: stage for stage in stages if stage.rollouts}
    counts = [(of[n].failures, of[n].rollouts) if n in of else (0, 0) for n in numbers]
    bars = Bars(
        np.arange(len(numbers) + 1, dtype=np.float64) - 0.5,
        np.array([100.0 * failed / all_of if all_of else math.nan for failed, all_of in counts]),
        ORANGE,
        tips=tuple(f"{each} {n}: {failed} of {of}" for n, (failed, of) in enumerate(counts)),
    )
    share = Axis(0.0, 100.0, "share [%]", ticks=(0.0, 50.0, 100.0))
    return PlaneChart(title, x=_stage_axis(stages, each), y=share, marks=(bars,))


def ess_chart(stages: Sequence[StageSummary]) -> PlaneChart:
    """The effective sample size of each stage's violations."""
    points = [(s.stage, s.ess) for s in stages if s.ess is not None]
    top = max([1.2 * SMALL_ESS, *(ess for _, ess in points)]) * 1.1
    rule = Rule(SMALL_ESS, f"below {SMALL_ESS:g}: do not quote", GREY, upright=False)
    return PlaneChart(
        "Effective sample size of the violations",
        x=_stage_axis(stages),
        y=Axis(0.0, top, "rollouts"),
        marks=(rule, _dots(points, GREEN, "effective sample size")),
    )


def _dots(points: Sequence[tuple[int, float]], color: str, name: str) -> Points:
    tips = tuple(f"stage {stage}: {number(value)}" for stage, value in points)
    x, y = np.array(points, dtype=np.float64).reshape(-1, 2).T
    return Points(x, y, color, tips=tips, joined=True, name=name)


def estimate_chart(run: RunData, stages: Sequence[StageSummary]) -> PlaneChart:
    """Estimates of stages, the answer with its interval, and the reference, on a log axis."""
    estimate, reference = run.result.estimate, run.result.reference
    each = run.method.stage_name
    alone = [(s.stage, s.log10_probability) for s in stages if s.log10_probability is not None]
    marks: list[Mark] = []
    if reference is not None:
        marks.append(
            Rule(reference.probability, "reference", GREEN, SOLID, upright=False, label_at="legend")
        )
    ends: list[float | None] = []
    if estimate is not None:
        caveats = run_interval_caveats(run.result)
        of_level = "not a 95 %" if caveats else "95 %"
        ends = [estimate.probability, estimate.ci_low, estimate.ci_high]
        if estimate.probability == 0.0 and estimate.ci_high:
            label = f"no violation seen: {of_level} upper bound"
            marks.append(Rule(estimate.ci_high, label, VERMILLION, upright=False))
        elif estimate.ci_low is not None and estimate.ci_high:
            label = f"answer's {of_level} interval"
            marks.append(Band(estimate.ci_low, estimate.ci_high, VERMILLION, label, not caveats))
        if estimate.probability > 0.0:
            answer = Rule(estimate.probability, "answer", VERMILLION, SOLID, upright=False,
                label_at="legend")  # fmt: skip
            marks.append(answer)
    exact = [] if reference is None else _logs(reference.probability)
    low, high = _decades([*(value for _, value in alone), *exact, *_logs(*ends)])
    if alone:
        tips = tuple(f"{each} {stage} alone: {number(10.0**value)}" for stage, value in alone)
        x, y = np.array([(stage, 10.0**value) for stage, value in alone]).T
        marks.append(Points(x, y, GREY, f"a {each} alone", tips=tips))
    x_axis = _stage_axis(stages, each) if stages else Axis(0.0, 1.0, "all rollouts", ticks=())
    y_axis = Axis(10.0**low, 10.0**high, "probability", log10=True)
    return PlaneChart("Estimate of P(violation)", x_axis, y_axis, tuple(marks))


def _unseen_words(run: RunData, stages: Sequence[StageSummary]) -> str:
    """What is said where there is no estimate."""
    estimate = run.result.estimate
    if any(s.log10_probability is not None for s in stages):
        return ""
    if estimate is not None and (estimate.probability > 0.0 or estimate.ci_high):
        return ""
    return "No violation yet." if run.running else "No violation seen."


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
