"""Runs side by side, and the metrics against each other on the same rollouts."""

from collections.abc import Sequence

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.charts.chart import Line, PlaneChart
from pemviz.colors import BLACK, METRICS, PEM
from pemviz.config import MetricName
from pemviz.config.toml_files import every_setting
from pemviz.errors import InputError
from pemviz.panel.learning_page import detection_chart
from pemviz.panel.pieces import RUN_DASHES, cells, drawn, number, progress_words, quiet
from pemviz.panel.ranking import METRIC_NAMES, Ranking, elites, rank, row, scoring
from pemviz.panel.run_data import RunData
from pemviz.panel.weights_page import over_time
from pemviz.reports.charts import RUN_COLORS, runs_chart
from pemviz.reports.document import Block, Paragraph, Table
from pemviz.reports.estimate_words import interval_text, probability_text
from pemviz.reports.html import blocks_html, warning
from pemviz.runs.reading import flat_settings
from pemviz.runs.uncertainty import run_interval_caveats

METRIC_DASHES = {"agm": "7 3", "smooth-cumulative": "2 3"}
LETTERS = "ABCDEF"
MOST_RUNS = len(LETTERS)
LONGEST_SETTING = 40
ESTIMATES = (
    "run", "P(violation)", "interval", "violations", "rollouts simulated", "effective sample size",
    "Pareto k-hat", "NLL [nats]", "sampling reliable?",
)  # fmt: skip


def metrics_page(run: RunData) -> str:
    """How far the elites of the metrics agree, and each one's least robust rollout.

    Scores of a large run are computed beside; until they are there, the page says how far.
    """
    if not run.parts:
        return quiet("No rollouts yet.")
    if run.running:
        return quiet("Metrics are compared when the run under way is done.")
    waits = (scoring(run, metric) for metric in METRIC_NAMES)  # one after the other
    waiting = next((progress for progress in waits if progress is not None), None)
    if waiting is not None:
        return quiet(f"Scored: {progress_words(waiting)}.")
    return run.memo.get("compare", lambda: cells(_overlaps(run), drawn(metric_chart(run))))


def _overlaps(run: RunData) -> str:
    sigma = run.config.sigma
    rankings, complaints = _rankings(run)
    sets = {m: elites(run, ranking, sigma=sigma) for m, ranking in rankings.items()}
    note = (
        f"Elites are what a stage learns from: its least robust {1 - sigma:.3g}, ties and all at "
        "or below 0 included. The table counts those that both metrics choose, and in brackets "
        "the share of all that either does."
    )
    rows = tuple((a, *(overlap_text(sets[a], sets[b]) for b in sets)) for a in sets)
    table = Table(("", *sets), rows, name="Overlap of the elites", note=note)
    return blocks_html([table]) + "".join(map(warning, complaints))


def overlap_text(first: BoolArray, second: BoolArray) -> str:
    """Common elites, and their share of all elites."""
    both = int(np.count_nonzero(first & second))
    either = int(np.count_nonzero(first | second))
    return f"{both} ({100 * both / either:.0f} %)" if either else "0"


def _rankings(run: RunData) -> tuple[dict[MetricName, Ranking], list[str]]:
    """Rankings of the metrics that can score the rollouts, and in a line each why others cannot."""
    rankings: dict[MetricName, Ranking] = {}
    complaints: list[str] = []
    for metric in METRIC_NAMES:
        try:
            rankings[metric] = rank(run, metric)
        except InputError as error:
            complaints.append(f"{metric} is left out: {error}")
    return rankings, complaints


def metric_chart(run: RunData) -> PlaneChart:
    """The charted signal against time of each metric's least robust rollout."""
    lines = [
        Line(
            run.time_s,
            run.signals(row(run, ranking, 0).index)[run.charted.name][0],
            METRICS.get(metric, BLACK),
            metric,
            width=3.4 - 0.8 * place,
            dash=METRIC_DASHES.get(metric, ""),
        )
        for place, (metric, ranking) in enumerate(_rankings(run)[0].items())
    ]
    return over_time(run, "Each metric's least robust rollout", lines)


def runs_page(runs: Sequence[RunData]) -> str:
    """Runs side by side: answers, figures, and the settings in which they differ."""
    if len(runs) < 2:
        return quiet(f"Tick 2 to {MOST_RUNS} runs to see them side by side.")
    named = [(f"{letter}  {run.name}", run.result) for letter, run in _lettered(runs)]
    doubted = any(run_interval_caveats(run.result) for run in runs)
    kind = "intervals (dotted: not a 95 % interval)" if doubted else "95 % intervals"
    chart = runs_chart(named, limit=None)
    rows = tuple((f"{letter}  {run.name}", *_figures(run)) for letter, run in _lettered(runs))
    return cells(
        drawn(proposals_chart(runs)),
        drawn(chart, caption=f"P(violation) with {kind}."),
        blocks_html([settings_table(runs)]),
        blocks_html([Table(ESTIMATES, rows, name="Estimates of the runs")]),
    )


def _lettered(runs: Sequence[RunData]) -> list[tuple[str, RunData]]:
    return list(zip(LETTERS, runs, strict=False))


def _figures(run: RunData) -> tuple[str, ...]:
    estimate, caveats = run.result.estimate, run_interval_caveats(run.result)
    if estimate is None:
        return (number(None),) * (len(ESTIMATES) - 1)
    return (
        probability_text(estimate), interval_text(estimate, caveats=caveats),
        f"{estimate.failures:,}", f"{estimate.rollouts_simulated:,}", number(estimate.ess),
        number(estimate.pareto_k, 2), number(estimate.nll_mean),
        f"\N{WARNING SIGN} no: {'; '.join(caveats)}" if caveats else "yes",
    )  # fmt: skip


def settings_table(runs: Sequence[RunData]) -> Block:
    """The settings in which runs differ, with every run's value."""
    settings = [flat_settings(every_setting(run.config)) for run in runs]
    names = sorted({name for each in settings for name in each})
    rows = tuple(
        (name, *(_setting(each.get(name)) for each in settings))
        for name in names
        if any(each.get(name) != settings[0].get(name) for each in settings)
    )
    if not rows:
        return Paragraph("Settings that differ: none, all are equal.", tone="quiet")
    return Table(("", *LETTERS[: len(runs)]), rows, name="Settings that differ")


def _setting(value: object) -> str:
    """A setting in few characters; a dash where a run has none of the name."""
    if value is None:
        return number(None)
    words = f"{value:g}" if isinstance(value, float) else str(value)
    short = words[: LONGEST_SETTING - 1] + "\N{HORIZONTAL ELLIPSIS}"
    return words if len(words) <= LONGEST_SETTING else short


def proposals_chart(runs: Sequence[RunData]) -> PlaneChart | None:
    """P(detected) over the gap under the runs' last proposals and their error models."""
    drawn_of = [run for run in runs if run.gap_m.size]
    if len(runs) < 2 or not drawn_of:
        return None
    lines: list[Line] = []
    for (letter, run), color, dash in zip(_lettered(runs), RUN_COLORS, RUN_DASHES, strict=False):
        if run.curves:
            values = run.curves[-1].detection
            lines.append(Line(run.gap_m, values, color, f"proposal {letter}", width=2.2, dash=dash))
    models = {run.config.pem: run for run in reversed(drawn_of)}
    for (name, run), dash in zip(models.items(), RUN_DASHES, strict=False):
        label = f"error model {name.rsplit('/', 1)[-1][:18]}"
        lines.append(Line(run.gap_m, run.pem_detection, PEM, label, dash=dash))
    return detection_chart("P(detected) over the gap: last proposals", lines)
