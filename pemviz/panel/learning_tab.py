"""The Learning tab: how the proposal forms, and what the estimate makes of it."""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.charts.svg import Axis, Plot
from pemviz.colors import BLUE, GREEN, GREY, ORANGE, PEM, PROPOSAL, VERMILLION
from pemviz.panel.browser import Browser, set_html
from pemviz.panel.curve_chart import Chart, Curves, Line, over_common
from pemviz.panel.page import cell, number, page, quiet, wide
from pemviz.panel.run_data import ProposalCurve, RunData
from pemviz.runs.result import StageSummary
from pemviz.runs.uncertainty import run_interval_caveats
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate

HEIGHT = 220
OLDER = ("#E8894A", "#EDA878", "#F0BE9B", "#F3D0B7", "#F6DFCF")
"""Of proposals learned before the newest one, paler and paler."""
FAR_BELOW = -60.0
MOST_DECADES = 10.0
DOUBTED = "3 3"
"""How an interval is dashed that is no 95 % interval."""


def learning(run: RunData | None) -> str:
    """All plots of the tab."""
    if run is None:
        return page(wide(quiet("Nothing has run yet.")))
    return run.memo.get("learning", lambda: _learning(run))


def learning_words(run: RunData | None) -> str:
    """What there is to see, in a few sentences."""
    return "" if run is None else page(wide(quiet(by_name(run.config.method).learning_words)))


def _learning(run: RunData) -> str:
    stages = _last_repetition(run.result.stages)
    cells = [cell(estimate_plot(run, stages))]
    if has_stages(run, stages):
        cells += map(cell, _stage_plots(run, stages))
    return page(*cells)


def has_stages(run: RunData, stages: Sequence[StageSummary]) -> bool:
    """Whether stages differ, and are not parts of one batch."""
    return len(stages) > 1 and by_name(run.config.method).stages != "parts"


def _stage_plots(run: RunData, stages: Sequence[StageSummary]) -> list[str]:
    if by_name(run.config.method).stages == "runs":
        return [failure_plot(stages, title="Particles that violate at a run's end", each="run")]
    threshold = threshold_plot(stages, unit=_unit(run))
    return [threshold, failure_plot(stages), ess_plot(stages)]


def proposal_curves(run: RunData | None) -> Curves | None:
    """The newest proposal, some of those before it, and the error model."""
    if run is None or not run.gap_m.size:
        return None
    method = by_name(run.config.method)
    curves = () if method.follows_model else run.final_curves
    lines: list[Line] = []
    drawn = _spread(tuple(reversed(curves)))
    if run.running:  # the same lines all along, so that the chart is not built anew each stage
        drawn = drawn[:1]
    for age, curve in enumerate(drawn):
        name = method.curve_name or f"proposal after stage {curve.stage}"
        if run.running:
            name = "newest proposal"
        color = PROPOSAL if age == 0 else OLDER[min(age, len(OLDER)) - 1]
        (values,) = over_common(run.gap_m, [(curve.gap_m, curve.detection)])
        lines.append(Line(name, values, color, width=2.6 if age == 0 else 1.4))
    model = Line(f"error model ({_shown_pem(run)})", run.pem_detection, PEM, 2.0, (7.0, 3.0))
    return Curves(
        title=f"P(detected) over the gap{_from(run)}",
        x=run.gap_m,
        x_label="gap [m]",
        y_label="P(detected)",
        lines=(*lines, model),
        y_range=(0.0, 1.0),
    )


def _from(run: RunData) -> str:
    """How many rollouts curves are means of, where that is not all."""
    return "" if run.curves_from is None else f" (from {run.curves_from:,} rollouts a stage)"


def _spread(curves: Sequence[ProposalCurve]) -> list[ProposalCurve]:
    """The first, the last, and some between them: as many as can be told apart."""
    most = 1 + len(OLDER)
    if len(curves) <= most:
        return list(curves)
    places = np.linspace(0, len(curves) - 1, most).round().astype(int)
    return [curves[place] for place in places.tolist()]


def _shown_pem(run: RunData) -> str:
    name = run.config.pem.rsplit("/", 1)[-1]
    return name if len(name) <= 18 else name[:17] + "\N{HORIZONTAL ELLIPSIS}"


def threshold_plot(stages: Sequence[StageSummary], *, unit: str) -> str:
    """The level of robustness that each stage learned from."""
    points = [(s.stage, s.threshold) for s in stages if s.threshold is not None]
    low, high = _range([v for _, v in points], with_zero=True)
    plot = Plot(
        title="Threshold: rollouts at or below it are learned from",
        x=_stage_axis(stages),
        y=Axis(low, high, f"robustness{unit}"),
        height=HEIGHT,
    )
    plot.hline(0.0, color=VERMILLION, label="violation below 0")
    xs, ys = np.array([p[0] for p in points], float), np.array([p[1] for p in points], float)
    plot.line(xs, ys, color=BLUE)
    tips = [f"stage {s}: {number(v)}" for s, v in points]
    plot.points(xs.tolist(), ys.tolist(), color=BLUE, tips=tips)
    return plot.text()


def failure_plot(
    stages: Sequence[StageSummary],
    *,
    title: str = "Rollouts that violate",
    each: str = "stage",
) -> str:
    """Share of violating rollouts a stage."""
    with_rollouts = [s for s in stages if s.rollouts]
    xs = np.array([float(s.stage) for s in with_rollouts])
    ys = np.array([100.0 * s.failures / s.rollouts for s in with_rollouts])
    plot = Plot(
        title=title,
        x=_stage_axis(stages, each),
        y=Axis(0.0, 100.0, "share [%]", ticks=(0.0, 50.0, 100.0)),
        height=HEIGHT,
    )
    for x, y, stage in zip(xs, ys, with_rollouts, strict=True):
        tip = f"{each} {stage.stage}: {stage.failures} of {stage.rollouts}"
        edges = np.array([x - 0.35, x + 0.35])
        plot.bars(edges, np.array([y]), color=ORANGE, tips=[tip])
    return plot.text()


def ess_plot(stages: Sequence[StageSummary]) -> str:
    """Effective sample size of each stage's failing weights."""
    ess_by_stage = [(s.stage, s.ess) for s in stages if s.ess is not None]
    xs = [float(stage) for stage, _ in ess_by_stage]
    ys = [ess for _, ess in ess_by_stage]
    top = max([1.2 * SMALL_ESS, *ys]) * 1.1
    plot = Plot(
        title="Effective sample size of the violations",
        x=_stage_axis(stages),
        y=Axis(0.0, top, "rollouts"),
        height=HEIGHT,
    )
    plot.hline(SMALL_ESS, color=GREY, label=f"below {SMALL_ESS:g}: do not quote")
    plot.line(np.array(xs), np.array(ys), color=GREEN)
    tips = [f"stage {stage}: {number(ess)}" for stage, ess in ess_by_stage]
    plot.points(xs, ys, color=GREEN, tips=tips)
    if not ess_by_stage:
        plot.note("no violation yet", (plot.left + plot.right) / 2, plot.top + 30, anchor="middle")
    return plot.text()


def estimate_plot(run: RunData, stages: Sequence[StageSummary]) -> str:
    """Estimates a stage, the answer with its interval, and the reference, on a log axis."""
    estimate, reference = run.result.estimate, run.result.reference
    method = by_name(run.config.method)
    each = method.stage_name
    several = has_stages(run, stages) and method.stage_interval != "none"
    points = _stage_points(stages) if several else []
    answer, interval = logs_of_answer(estimate)
    bound = [] if answer or estimate is None else logs(estimate.ci_high)
    exact = [] if reference is None else logs(reference.probability)
    low, high = decades([*(v for _, v in points), *exact, *answer, *interval])
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
    if estimate is not None:
        _draw_answer(plot, estimate, x=x.high - 0.35 if several else 0.0, dash=dash)
    if not (answer or in_range or bound):
        words = "no violation yet" if run.running else "no violation seen"
        plot.note(words, (plot.left + plot.right) / 2, plot.top + 50, anchor="middle")
    answer_entry = (f"answer, {of_level} interval", VERMILLION, dash)
    entries = [(f"a {each} alone", GREY, "")] * several + [answer_entry]
    _legend(plot, entries + [("reference", GREEN, "")] * (reference is not None))
    return plot.text()


def _stage_points(stages: Sequence[StageSummary]) -> list[tuple[float, float]]:
    """Each stage with the decimal logarithm of its own estimate, if it has one."""
    every = ((float(s.stage), s.log10_probability) for s in stages)
    return [(stage, value) for stage, value in every if value is not None]


def _draw_answer(plot: Plot, estimate: Estimate, *, x: float, dash: str) -> None:
    answer, interval = logs_of_answer(estimate)
    for value in answer:
        if len(interval) == 2:
            plot.whisker(x, interval[0], interval[1], color=VERMILLION, dash=dash)
        tip = f"answer {number(estimate.probability)}"
        plot.points([x], [value], color=VERMILLION, radius=4.0, tips=[tip])


def decades(values: Sequence[float]) -> tuple[float, float]:
    """Whole powers of ten around decimal logarithms; what is lower by far does not count."""
    in_range = [value for value in values if value > FAR_BELOW]
    if not in_range:
        return -20.0, 0.0
    least = max(min(in_range), float(np.median(in_range)) - MOST_DECADES)
    return math.floor(least) - 1.0, min(math.ceil(max(in_range)) + 1.0, 0.0)


def _legend(plot: Plot, entries: Sequence[tuple[str, str, str]]) -> None:
    """Label, colour and dash of each entry, side by side beneath the plot."""
    lengths = [27 + round(5.3 * len(label)) for label, _, _ in entries]
    for place, entry in enumerate(entries):
        plot.legend([entry], x=plot.left + sum(lengths[:place]), y=plot.height - 6)


def _last_repetition(stages: Sequence[StageSummary]) -> list[StageSummary]:
    last = max((s.repetition for s in stages), default=0)
    return [s for s in stages if s.repetition == last]


def _stage_axis(stages: Sequence[StageSummary], each: str = "stage") -> Axis:
    last = max((s.stage for s in stages), default=0)
    step = max(1, (last + 6) // 12)
    return Axis(-0.6, last + 0.6, each, ticks=tuple(float(t) for t in range(0, last + 1, step)))


def _unit(run: RunData) -> str:
    return "" if run.config.metric == "agm" else " [m]"


def logs_of_answer(estimate: Estimate | None) -> tuple[list[float], list[float]]:
    """Decimal logarithms of an estimate and of the ends of its interval, as far as known."""
    if estimate is None:
        return [], []
    return logs(estimate.probability), logs(estimate.ci_low, estimate.ci_high)


def logs(*values: float | None) -> list[float]:
    """Decimal logarithms of those figures that are there, finite and above 0."""
    return [math.log10(v) for v in values if v is not None and 0.0 < v < math.inf]


def _range(values: Sequence[float], *, with_zero: bool) -> tuple[float, float]:
    chosen = [*values, 0.0] if with_zero else list(values)
    low, high = min(chosen, default=0.0), max(chosen, default=1.0)
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


class LearningTab:
    """How the proposal forms."""

    def __init__(self, browser: Browser) -> None:
        self._words = browser.client.gui.add_html("")
        self._curves = Chart(browser)
        self._page = browser.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._words, learning_words(run))
        self._curves.show(proposal_curves(run))
        set_html(self._page, learning(run))
