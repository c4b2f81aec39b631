"""The Compare tab: metrics against each other, and runs side by side."""

from collections.abc import Sequence
from html import escape
from typing import cast, get_args

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.charts.svg import Axis, Plot
from pemviz.colors import BLACK, METRICS, PEM, VERMILLION
from pemviz.config import MetricName
from pemviz.config.toml_files import every_setting
from pemviz.errors import InputError
from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.curve_chart import (
    RUN_COLORS,
    RUN_DASHES,
    Chart,
    Curves,
    Line,
    over_common,
    signal_label,
)
from pemviz.panel.learning_tab import DOUBTED, decades, logs_of_answer
from pemviz.panel.page import cell, grid, number, page, progress_words, quiet, wide
from pemviz.panel.ranking import Ranking, elites, is_scored, rank, row, scoring
from pemviz.panel.run_data import Progress, RunData
from pemviz.reports.estimate_words import no_interval_text
from pemviz.reports.html import heading, warning
from pemviz.runs.reading import flat_settings
from pemviz.runs.uncertainty import run_interval_caveats
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M

METRIC_DASHES = {"agm": (7.0, 3.0), "smooth-cumulative": (2.0, 3.0)}
LETTERS = "ABCDEF"
MOST_RUNS = len(LETTERS)


def comparing(run: RunData | None, *, asked: bool) -> Progress | bool:
    """How far the metrics' scores are: whether they are there, or how many rollouts are scored.

    Args:
        run: The run shown.
        asked: Whether to have those of a large run computed, which takes a while.
    """
    if run is None or not run.parts or run.running:
        return True
    missing: Sequence[MetricName] = tuple(m for m in metric_names() if not is_scored(run, m))
    if not missing or not asked:
        return not missing
    waits = (scoring(run, metric) for metric in missing)  # one after the other
    return next((progress for progress in waits if progress is not None), True)


def metrics_page(run: RunData | None) -> str:
    """How far the elites of the metrics agree."""
    if run is None or not run.parts:
        return page(wide(quiet("No rollouts yet.")))
    if run.running:
        return page(wide(quiet("Metrics are compared when the run under way is done.")))
    return run.memo.get("compare", lambda: page(cell(overlap_table(run))))


def metric_curves(run: RunData | None) -> Curves | None:
    """Gap, or what is asked about, against time of each metric's least robust rollout."""
    if run is None or not run.parts or run.running:
        return None
    return run.memo.get("metric curves", lambda: _metric_curves(run))


def _metric_curves(run: RunData) -> Curves:
    rankings, _ = _rankings(run)
    charted = run.charted
    lines = [
        Line(
            f"{metric}, {signal_label(charted)}",
            run.signals(row(run, ranking, 0).index)[charted.name][0],
            METRICS.get(metric, BLACK),
            width=3.4 - 0.8 * place,
            dash=METRIC_DASHES.get(metric, ()),
        )
        for place, (metric, ranking) in enumerate(rankings.items())
    ]
    if run.own is None:
        touch = np.full(run.time_s.size, CAMERA_TO_BUMPER_M)
        lines.append(Line("bumpers touch [m]", touch, VERMILLION, width=1.0))
    return Curves(
        title=f"Each metric's least robust of {run.kept:,} rollouts (one line: the same)",
        x=run.time_s,
        x_label="time [s]",
        y_label=signal_label(charted),
        lines=tuple(lines),
    )


def overlap_table(run: RunData) -> str:
    """How many elites two metrics share."""
    sigma = run.config.sigma
    rankings, complaints = _rankings(run)
    sets = {m: elites(run, ranking, sigma=sigma) for m, ranking in rankings.items()}
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
        + "".join(map(warning, complaints))
    )


def _rankings(run: RunData) -> tuple[dict[MetricName, Ranking], list[str]]:
    """Rankings of the metrics that can score the rollouts, and in a line each why others cannot."""
    rankings: dict[MetricName, Ranking] = {}
    complaints: list[str] = []
    for metric in metric_names():
        try:
            rankings[metric] = rank(run, metric)
        except InputError as error:
            complaints.append(f"{metric} is left out: {error}")
    return rankings, complaints


def overlap_text(first: BoolArray, second: BoolArray) -> str:
    """Common elites, and their share of all elites."""
    both = int(np.count_nonzero(first & second))
    either = int(np.count_nonzero(first | second))
    return f"{both} ({100 * both / either:.0f} %)" if either else "0"


def metric_names() -> tuple[MetricName, ...]:
    """All metrics."""
    return cast(tuple[MetricName, ...], get_args(MetricName))


def runs_page(runs: Sequence[RunData]) -> str:
    """Runs side by side: answers, figures, and the settings in which they differ."""
    if len(runs) < 2:
        words = "Add a run above to see it beside the run shown: up to six side by side."
        return page(wide(heading("Runs side by side") + quiet(words)))
    return page(
        cell(estimates_plot(runs)),
        cell(heading("Settings that differ") + differences_table(runs)),
        wide(estimates_table(runs)),
    )


def run_curves(runs: Sequence[RunData]) -> Curves | None:
    """P(detected) over the gap under the runs' last proposals and their error models."""
    drawn = [run for run in runs if run.gap_m.size]
    if len(runs) < 2 or not drawn:
        return None
    gap_m = max((run.gap_m for run in drawn), key=lambda grid_m: float(grid_m[-1]))
    lines: list[Line] = []
    for run, letter, color, dash in zip(runs, LETTERS, RUN_COLORS, RUN_DASHES, strict=False):
        if run.curves:
            last = run.final_curves[-1]
            (values,) = over_common(gap_m, [(last.gap_m, last.detection)])
            lines.append(Line(f"proposal {letter}", values, color, width=2.2, dash=dash))
    models = {run.config.pem: run for run in reversed(drawn)}
    for (name, run), (_, dash) in zip(models.items(), enumerate(RUN_DASHES), strict=False):
        (values,) = over_common(gap_m, [(run.gap_m, run.pem_detection)])
        lines.append(Line(f"error model {name.rsplit('/', 1)[-1][:18]}", values, PEM, dash=dash))
    return Curves(
        title="P(detected) over the gap: last proposals",
        x=gap_m,
        x_label="gap [m]",
        y_label="P(detected)",
        lines=tuple(lines),
        y_range=(0.0, 1.0),
    )


def estimates_plot(runs: Sequence[RunData]) -> str:
    """The answers with their intervals on a log axis; what is lower by far, at its lower edge."""
    doubted = [bool(run_interval_caveats(run.result)) for run in runs]
    kind = "intervals (dashed: not 95 %)" if any(doubted) else "95 % intervals"
    answers = [logs_of_answer(run.result.estimate) for run in runs]
    low, high = decades([value for answer, interval in answers for value in (*answer, *interval)])
    plot = Plot(
        title=f"P(violation) with {kind}",
        x=Axis(-0.5, len(runs) - 0.5, "run", ticks=()),
        y=Axis(low, high, "probability", log10=True),
        height=220,
        left=52,
    )
    for place, (answer, interval) in enumerate(answers):
        color = RUN_COLORS[place]
        if len(interval) == 2 and interval[1] > low:
            dash = DOUBTED if doubted[place] else ""
            plot.whisker(place, interval[0], interval[1], color=color, dash=dash)
        for value in answer:
            plot.points([place], [value], color=color, radius=4.0)
            if value < low:
                plot.note(number(10.0**value, 2), plot.px(place), plot.bottom - 8, anchor="middle")
        if not answer:
            plot.note("none", plot.px(place), plot.bottom - 5, anchor="middle")
        plot.note(LETTERS[place], plot.px(place), plot.bottom + 13, anchor="middle")
    return plot.text()


def estimates_table(runs: Sequence[RunData]) -> str:
    """The answers in figures, a run a line."""
    lines = [
        [
            f"<b style='color:{RUN_COLORS[place]}'>{LETTERS[place]}</b> {escape(run.name)}",
            *_figures(run),
            _is_interval(run),
            _is_reliable(run),
        ]
        for place, run in enumerate(runs)
    ]
    header = (
        "run", "P(violation)", "standard error", "interval", "violations", "rollouts simulated",
        "effective sample size", "Pareto k-hat", "NLL [nats]", "does the interval hold?",
        "reliable?",
    )  # fmt: skip
    return heading("Estimates in figures") + grid(header, lines, name="Estimates of the runs")


def _figures(run: RunData) -> list[str]:
    estimate = run.result.estimate
    if estimate is None:
        return [number(None)] * 8
    interval = number(None)
    if estimate.ci_low is not None and estimate.ci_high is not None:
        interval = f"{number(estimate.ci_low, 2)} to {number(estimate.ci_high, 2)}"
    return [
        number(estimate.probability), number(estimate.std_error, 2), interval,
        f"{estimate.failures:,}", f"{estimate.rollouts_simulated:,}", number(estimate.ess),
        number(estimate.pareto_k, 2), number(estimate.nll_mean),
    ]  # fmt: skip


def _is_interval(run: RunData) -> str:
    """Whether the answer's interval holds at its level, and why not."""
    estimate, caveats = run.result.estimate, run_interval_caveats(run.result)
    if estimate is None or estimate.ci_high is None:
        return number(None)
    return escape(f"{no_interval_text(estimate)}: {'; '.join(caveats)}") if caveats else "yes"


def _is_reliable(run: RunData) -> str:
    """Whether the answer may decide anything; the reasons stand where the pointer rests."""
    if run.result.estimate is None:
        return number(None)
    reasons = run_interval_caveats(run.result)
    if not reasons:
        return "yes"
    return f"<span title='{escape('; '.join(reasons), quote=True)}'>\N{WARNING SIGN} no</span>"


def differences_table(runs: Sequence[RunData]) -> str:
    """The settings in which runs differ, with every run's value."""
    settings = [flat_settings(every_setting(run.config)) for run in runs]
    names = sorted({name for each in settings for name in each})
    differing = [
        name for name in names if any(s.get(name) != settings[0].get(name) for s in settings)
    ]
    if not differing:
        return quiet("All settings are equal.")
    lines = [
        [escape(name), *(escape(shown_setting(s.get(name))) for s in settings)]
        for name in differing
    ]
    return grid(["", *LETTERS[: len(runs)]], lines, name="Settings")


def shown_setting(value: object) -> str:
    """A setting in few characters; a dash where a run has none of the name."""
    if value is None:
        return number(None)
    words = f"{value:g}" if isinstance(value, float) else str(value)
    return words if len(words) <= 40 else words[:39] + "\N{HORIZONTAL ELLIPSIS}"


NONE = "none"
ADD_HINT = (
    "A run of the recordings folder, shown beside the run shown (A); one after the other, up to "
    "six side by side."
)
SCORE_HINT = (
    "Score all rollouts under every metric; in a run of many rollouts that takes a while, in "
    "which the panel can be used."
)
REMOVE_HINT = "Take a run away again."


class CompareTab:
    """This browser's choice of further runs."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._run: RunData | None = None
        self._others: dict[str, RunData] = {}
        self._names: tuple[str, ...] = ()
        self.waiting = False
        gui = browser.client.gui
        self.add = gui.add_dropdown("Compare with", list[str]([NONE]), initial_value=NONE,
            hint=ADD_HINT)  # fmt: skip
        self.remove = gui.add_dropdown("Take away", list[str]([NONE]), initial_value=NONE,
            hint=REMOVE_HINT, visible=False)  # fmt: skip
        self.add.on_update(browser.on(self._add))
        self.remove.on_update(browser.on(self._remove))
        self._curves = Chart(browser)
        self._runs = gui.add_html("")
        self._gaps = Chart(browser)
        self.score = gui.add_button("Compare metrics", visible=False, color="gray",
            hint=SCORE_HINT)  # fmt: skip
        self.score.on_click(browser.on(self._ask))
        self._asked: RunData | None = None
        self._metrics = gui.add_html("")

    def refresh(self, state: PanelState, run: RunData | None) -> None:  # noqa: ARG002
        """Show a run, when there is time for it."""
        self._run = run
        self._browser.later("compare", self._show)

    def list_runs(self, names: tuple[str, ...]) -> None:
        """Offer other runs."""
        self._names = names
        self._offer()

    def _offer(self) -> None:
        chosen = list(self._others)
        options = (NONE, *(name for name in self._names if name not in chosen))
        if tuple(self.add.options) != options:
            self.add.options = options
        self.add.value = NONE
        shown = (NONE, *chosen)
        if tuple(self.remove.options) != shown:
            self.remove.options = shown
        self.remove.value = NONE
        if self.remove.visible != bool(chosen):
            self.remove.visible = bool(chosen)
        full = len(chosen) >= MOST_RUNS - 1
        if self.add.disabled != full:
            self.add.disabled = full

    def _add(self) -> None:
        name, hub = self.add.value, self._browser.hub
        if name == NONE or len(self._others) >= MOST_RUNS - 1:
            return
        try:
            self._others[name] = hub.loaded.get(hub.recordings.folder(name))
        finally:
            self._offer()
        self._show()

    def _remove(self) -> None:
        self._others.pop(self.remove.value, None)
        self._offer()
        self._show()

    def _show(self) -> None:
        runs = [] if self._run is None else [self._run, *self._others.values()]
        with self._browser.client.atomic():
            self._curves.show(run_curves(runs))
            set_html(self._runs, runs_page(runs))
            self._show_metrics()

    def _ask(self) -> None:
        self._asked = self._run
        self._show_metrics()

    def go_on(self) -> None:
        """Tell how far the metrics are, while they are computed."""
        if self.waiting:
            self._show_metrics()

    def _show_metrics(self) -> None:
        run = self._run
        state = comparing(run, asked=run is not None and run is self._asked)
        self.waiting = isinstance(state, Progress)
        offered = state is False
        if self.score.visible != offered:
            self.score.visible = offered
        if state is True:
            self._gaps.show(metric_curves(run))
            set_html(self._metrics, metrics_page(run))
            return
        self._gaps.show(None)
        words = "" if isinstance(state, bool) else f"Scored: {progress_words(state)}."
        set_html(self._metrics, page(wide(quiet(words))) if words else "")
