"""The Compare tab: metrics against each other, and two runs side by side."""

from html import escape
from typing import cast, get_args

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.colors import BLACK, BLUE, METRICS, PEM, VERMILLION
from pemviz.config import MetricName
from pemviz.panel.ranking import elites, rank, row
from pemviz.panel.run_data import RunData
from pemviz.panel.views.learning import DOUBTED, logs_of_answer
from pemviz.reports.estimate_text import no_interval_text
from pemviz.reports.pictures.html import block, grid, heading, number, quiet
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.runs.same_run import setting_differences
from pemviz.runs.trust import run_interval_caveats
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M

DASHES = {"classical": "", "agm": "7 3", "smooth-cumulative": "2 3"}


def metrics_page(run: RunData | None) -> str:
    """The least robust rollout of each metric, and how far their elites agree."""
    if run is None or not run.parts:
        return block(quiet("No rollouts yet."))
    if run.running:
        return block(quiet("Compared when the run under way is done."))
    return block(run.memo.get("compare", lambda: _metrics_page(run)))


def _metrics_page(run: RunData) -> str:
    return "".join(
        (
            heading(f"Metrics, on the {run.kept:,} rollouts of {run.name}"),
            least_robust_plot(run),
            quiet("Each metric's least robust rollout. Where lines coincide they chose the same."),
            overlap_table(run),
        )
    )


def least_robust_plot(run: RunData) -> str:
    """Gap against time of each metric's least robust rollout."""
    gaps = {m: np.asarray(run.rollouts["gap_m"][row(run, rank(run, m), 0).index], dtype=np.float64)
            for m in metric_names()}  # fmt: skip
    every = np.concatenate(list(gaps.values()))
    states = np.arange(run.config.scenario.states, dtype=np.float64)
    time_s = states * run.config.scenario.dt_s
    plot = Plot(
        title="Least robust rollout of each metric",
        x=Axis(0.0, float(time_s[-1]), "time [s]"),
        y=Axis(min(-1.0, float(np.min(every)) - 0.5), float(np.max(every)) * 1.05, "gap [m]"),
        height=206,
        bottom=48,
    )
    plot.band(plot.y.low, CAMERA_TO_BUMPER_M, color=VERMILLION, opacity=0.10)
    words = f"{CAMERA_TO_BUMPER_M:g} m: bumpers touch"
    plot.hline(CAMERA_TO_BUMPER_M, color=VERMILLION, label=words, dash="", at_left=True)
    for place, (metric, gap_m) in enumerate(gaps.items()):
        color, dash = METRICS.get(metric, BLACK), DASHES.get(metric, "")
        plot.line(time_s, gap_m, color=color, width=3.4 - place, dash=dash, tip=metric)
        plot.legend([(metric, color, dash)], x=plot.left + 100 * place, y=plot.height - 6)
    return plot.text()


def overlap_table(run: RunData) -> str:
    """How many elites two metrics share."""
    sigma = run.config.sigma
    sets = {m: elites(run, rank(run, m), sigma=sigma) for m in metric_names()}
    lines = [
        [escape(a), *(overlap_text(sets[a], sets[b]) for b in sets)] for a in sets
    ]  # fmt: skip
    note = quiet(
        f"Elites are what a stage learns from: its least robust {1 - sigma:.3g}, ties and all at "
        "or below 0 included. The table counts those that both metrics choose, and in brackets "
        "the share of all that either does."
    )
    return (
        heading("Overlap of the elites")
        + grid(["", *map(escape, sets)], lines, name="Overlap of elites")
        + note
    )


def overlap_text(first: BoolArray, second: BoolArray) -> str:
    """Common elites, and their share of all elites."""
    both = int(np.count_nonzero(first & second))
    either = int(np.count_nonzero(first | second))
    return f"{both} ({100 * both / either:.0f} %)" if either else "0"


def metric_names() -> tuple[MetricName, ...]:
    """All metrics."""
    return cast(tuple[MetricName, ...], get_args(MetricName))


def runs_page(first: RunData | None, second: RunData | None) -> str:
    """Two runs side by side."""
    if first is None or second is None:
        return block(
            heading("Two runs") + quiet("Choose another run above to see it beside this one.")
        )
    return block(
        heading("Two runs")
        + quiet(f"A: {first.name} (shown). B: {second.name}.")
        + curves_plot(first, second)
        + estimates_plot(first, second)
        + estimates_table(first, second)
        + differences_table(first, second)
    )


def curves_plot(first: RunData, second: RunData) -> str:
    """Last proposals and error models."""
    high = max([float(r.gap_m[-1]) for r in (first, second) if r.gap_m.size], default=20.0)
    plot = Plot(
        title="P(detected) against gap, last proposals",
        x=Axis(0.0, high, "gap [m]"),
        y=Axis(0.0, 1.0, "P(detected)", ticks=(0.0, 0.5, 1.0)),
        height=186,
        bottom=48,
    )
    for place, (run, name, dash) in enumerate(((first, "A", ""), (second, "B", "6 3"))):
        color = (VERMILLION, BLUE)[place]
        plot.line(run.gap_m, run.pem_detection, color=PEM, dash=dash, tip=f"error model of {name}")
        if run.curves:
            last = run.final_curves[-1]
            plot.line(last.gap_m, last.detection, color=color, width=2.4, dash=dash, tip=name)
        plot.legend([(f"proposal {name}", color, dash)], x=plot.left + 110 * place, y=180)
    plot.legend([("error models", PEM, "")], x=plot.left + 220, y=180)
    return plot.text()


def estimates_plot(first: RunData, second: RunData) -> str:
    """Both answers with their intervals on a log axis."""
    doubted = [bool(run_interval_caveats(run.result)) for run in (first, second)]
    kind = "intervals (dashed: not 95 %)" if any(doubted) else "95 % intervals"
    answers = [logs_of_answer(run.result.estimate) for run in (first, second)]
    every = [value for answer, interval in answers for value in (*answer, *interval)]
    exponents = [v for v in every if v > -60.0] or [-20.0, 0.0]
    plot = Plot(
        title=f"Estimates with {kind}",
        x=Axis(-0.5, 1.5, "run", ticks=()),
        y=Axis(float(np.floor(min(exponents))) - 1, min(0.0, float(np.ceil(max(exponents))) + 1),
               "probability", log10=True),
        height=150,
        left=52,
    )  # fmt: skip
    for place, (answer, interval) in enumerate(answers):
        color = (VERMILLION, BLUE)[place]
        if len(interval) == 2:
            dash = DOUBTED if doubted[place] else ""
            plot.whisker(place, interval[0], interval[1], color=color, dash=dash)
        for value in answer:
            plot.points([place], [value], color=color, radius=4.0)
        plot.note("AB"[place], plot.px(place), plot.bottom + 13, anchor="middle")
    return plot.text()


def estimates_table(first: RunData, second: RunData) -> str:
    """Both answers in figures."""
    names = (
        ("P(violation)", "probability"),
        ("standard error", "std_error"),
        ("interval from", "ci_low"),
        ("interval to", "ci_high"),
        ("violations", "failures"),
        ("rollouts simulated", "rollouts_simulated"),
        ("effective sample size", "ess"),
        ("Pareto k-hat", "pareto_k"),
        ("NLL of violations [nats]", "nll_mean"),
    )
    answers = (first.result.estimate, second.result.estimate)
    lines = [
        [label, *(number(None if a is None else getattr(a, field), 3) for a in answers)]
        for label, field in names
    ]
    after = 1 + [field for _, field in names].index("ci_high")
    lines.insert(after, ["does it hold at 95 %?", *map(_is_interval, (first, second))])
    return grid(["", "A", "B"], lines, name="Estimates of two runs")


def _is_interval(run: RunData) -> str:
    """Whether the answer's interval holds at its level, and why not."""
    estimate, caveats = run.result.estimate, run_interval_caveats(run.result)
    if estimate is None or estimate.ci_high is None:
        return number(None)
    return escape(f"{no_interval_text(estimate)}: {'; '.join(caveats)}") if caveats else "yes"


def differences_table(first: RunData, second: RunData) -> str:
    """The settings in which two runs differ."""
    differences = setting_differences(first.config, second.config)
    if not differences:
        return heading("Settings") + quiet("All settings are equal.")
    lines = [
        [escape(name), *(escape(shown_setting(value)) for value in values)]
        for name, values in sorted(differences.items())
    ]
    return heading("Settings that differ") + grid(["", "A", "B"], lines, name="Settings")


def shown_setting(value: object) -> str:
    """A setting in few characters."""
    words = f"{value:g}" if isinstance(value, float) else str(value)
    return words if len(words) <= 40 else words[:39] + "\N{HORIZONTAL ELLIPSIS}"
