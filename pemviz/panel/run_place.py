"""What the page of a run asks for: its answer, its ranked rollouts, a rollout, pages beside it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.charts.chart import PlaneChart
from pemviz.charts.svg import plot_of
from pemviz.config import MetricName
from pemviz.panel.arguments import Arguments
from pemviz.panel.compare_page import MOST_RUNS, metrics_page, runs_page
from pemviz.panel.learning_page import learning
from pemviz.panel.page_scene import VIEWS
from pemviz.panel.pieces import drawn, signal_name
from pemviz.panel.ranking import METRIC_NAMES, RankedRow, Ranking, rank, row, scoring
from pemviz.panel.rollout_charts import Track, stage_charts, step_words, track, track_charts
from pemviz.panel.rollout_details import ALL_RULES, details, opens_on
from pemviz.panel.run_data import RunData
from pemviz.panel.run_summary import summary
from pemviz.panel.scene import scene_html
from pemviz.panel.site import Page, Request
from pemviz.panel.weights_page import POINTS, weights_page
from pemviz.panel.why_page import why
from pemviz.reports.causes_words import shown_chains
from pemviz.reports.html import sections_html
from pemviz.reports.run_document import run_document
from pemviz.runs.answers import rules_in_order
from pemviz.runs.drawn_rollout import RIGHT

MOST_ROWS = 200
"""Of a ranking, in one answer."""
AMONG, FIRST = ("carrying", "all"), ("share", "least robust")
DOCUMENTS: Mapping[str, tuple[str, ...]] = {
    "uncertainty": ("answer", "rules", "uncertainty", "memory", "warnings", "models"),
    "next": ("plan", "rates", "extrapolation"),
    "record": ("question", "provenance", "assumptions", "configuration"),
}
"""Pages that are sections of the run's document, by name."""
SCENE_WORDS = (
    "A ball over a car says what perception reports of it: small and blue detected, large and "
    "orange missed, grey nothing to report. Beside the road stands a row for each obstacle, flat "
    "blue marks where the ego detected it, upright crosses where it erred. White lines: where "
    "the controller tracks a car, with an ellipse of two standard deviations where it knows any. "
    "From contact on the cars are grey."
)
NO_SCENE_WORDS = (
    "The scenario does not say where cars are (pemviz.DrawsScene), so its signals stand in the "
    "place of a scene, on the timeline's axis. Orange dots: perception errs at that step. Lines "
    "across: what the rule compares a signal with."
)
CHAIN, START = "chain", "start"
"""What can be clicked beside a rollout's point: a chain of misses, a violation's start."""
DRAWN: Mapping[str, Callable[[RunData], str]] = {
    "learning": learning,
    "weights": weights_page,
    "why": why,
    "metrics": metrics_page,
}


@dataclass(frozen=True)
class Choice:
    """Which ranking of a run is looked at."""

    metric: MetricName
    rule: str | None
    carrying: bool
    by_share: bool


class RunPlace:
    """Looks at runs; what is chosen comes with every request, as it stands in the address."""

    def __init__(self, find: Callable[[str], RunData]) -> None:
        """``find`` gives a run by its name."""
        self._find = find

    @property
    def requests(self) -> Mapping[str, Request]:
        """What a page may ask for, by name."""
        return {
            "open": self._open,
            "ranking": self._ranking,
            "rollout": self._rollout,
            "scene_page": self._scene_page,
            "step": self._step,
            "look": self._look,
            "page": self._page,
            "pick": self._pick,
            "compare": self._compare,
        }

    def _open(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The strip, and what there is to choose from, with what it opens on."""
        run = self._find(asked.text("run"))
        rules = [rule.name for rule in rules_in_order(run.config.rules)]
        return {
            "name": run.name,
            "summary": summary(run.result, running=run.running),
            "rules": [*rules, ALL_RULES] if rules else [],
            "rule": opens_on(run) if rules else ALL_RULES,
            "metrics": METRIC_NAMES,
            "metric": run.config.metric,
            "metric_unit": run.robustness_unit,
            "kept": run.kept,
            "simulated": run.simulated,
            "running": run.running,
            "scene": run.has_scene,
            "scene_words": SCENE_WORDS if run.has_scene else NO_SCENE_WORDS,
        }

    def _ranking(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """Rows of the ranking from a place on; while scores are computed, how far they are."""
        run = self._find(asked.text("run"))
        choice = _choice(run, asked)
        progress = scoring(run, choice.metric, rule=choice.rule)
        if progress is not None:
            return {"scored": progress.done, "of": progress.count}
        ranking = _ranked(run, choice)
        count = int(ranking.order.size)
        start = asked.whole("start", 0, 10_000_000, 0)
        end = min(start + asked.whole("count", 1, MOST_ROWS, 50), count)
        return {
            "count": count,
            "among": ranking.among,
            "start": start,
            "rows": [_row(run, row(run, ranking, place)) for place in range(start, end)],
        }

    def _rollout(self, page: Page, asked: Arguments) -> Any:
        """A rollout by its rank; the scene shows it, or its signals in the scene's place."""
        run = self._find(asked.text("run"))
        entry = _entry(run, asked)
        if entry is None:
            return None
        chosen = track(run, entry)
        step = asked.whole("step", -1, 10_000_000, -1)
        step = chosen.interesting_step if step < 0 else min(step, chosen.count - 1)
        contact = "" if chosen.drawn is None else chosen.drawn.contact_words
        if chosen.drawn is not None:
            page.scene.show(chosen.drawn, step=step)
        width, height = asked.whole("width", 200, 4000, 600), asked.whole("height", 100, 4000, 320)
        return {
            "rank": entry.rank,
            "step": step,
            "row": _row(run, entry),
            "title": chosen.title,
            "states": chosen.count,
            "dt_s": chosen.dt_s,
            "contact": chosen.contact_step,
            **_timeline(chosen),
            "stage": [_chart(one) for one in stage_charts(chosen, width=width, height=height)],
            "charts": [_chart(one) for one in track_charts(chosen, width=width)],
            "details": details(run, entry, contact=contact),
        }

    def _scene_page(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The scene of a rollout as an HTML page that plays without a server."""
        run = self._find(asked.text("run"))
        entry = _entry(run, asked)
        chosen = None if entry is None else track(run, entry).drawn
        return None if chosen is None else scene_html(chosen)

    def _step(self, page: Page, asked: Arguments) -> Any:
        page.scene.at(asked.whole("step", 0, 10_000_000), follow=asked.flag("follow", True))
        return True

    def _look(self, page: Page, asked: Arguments) -> Any:
        if asked.flag("move"):
            page.scene.look(asked.choice("view", tuple(VIEWS), "from behind"))
        page.scene.color(dark=asked.flag("dark"))
        return True

    def _page(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """A page beside the scene, as HTML, and whether more of it is being computed."""
        run = self._find(asked.text("run"))
        name = asked.choice("page", (*DOCUMENTS, *DRAWN))
        if name in DRAWN:
            html = DRAWN[name](run)
        else:
            document = run_document(run.result, running=run.running)
            html = sections_html(document.choose(DOCUMENTS[name]), live=True)
        return {"html": html, "waits": run.scans.under_way}

    def _pick(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """Which rollout a click on a page means: its place among all, by the specification."""
        run = self._find(asked.text("run"))
        number = asked.whole("number", 0, 100_000_000)
        index = _index(run, asked.choice("target", (POINTS, CHAIN, START)), number)
        if index is None:
            return None
        ranking = rank(run, run.config.metric, among="all", by_share=True)
        place = int(np.flatnonzero(ranking.order == index)[0])
        return {"rule": ALL_RULES if run.config.rules else "", "metric": run.config.metric,
            "among": "all", "first": FIRST[0], "rank": place + 1}  # fmt: skip

    def _compare(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """Some runs beside each other, as HTML."""
        return runs_page([self._find(name) for name in asked.texts("runs", MOST_RUNS)])


def _index(run: RunData, target: str, number: int) -> int | None:
    """The index in the run's tables of what was clicked; ``None`` if it is not kept."""
    if target == POINTS:
        return number if number < run.kept else None
    explanation, starts = run.result.explanation, run.result.starts
    if target == CHAIN and explanation is not None and explanation.stage is not None:
        chains = shown_chains(explanation.chains)
        if not 1 <= number <= len(chains) or chains[number - 1].likeliest is None:
            return None
        key = (explanation.repetition, explanation.stage, chains[number - 1].likeliest)
    elif target == START and starts and 1 <= number <= len(starts[0].points):
        point = starts[0].points[number - 1]
        key = (point.repetition, point.stage, point.rollout)
    else:
        return None
    names = ("repetition", "stage", "rollout")
    same = [run.rollouts[name] == part for name, part in zip(names, key, strict=True)]
    found = np.flatnonzero(np.all(same, axis=0))
    return int(found[0]) if found.size else None


def _choice(run: RunData, asked: Arguments) -> Choice:
    metrics: dict[str, MetricName] = {name: name for name in METRIC_NAMES}
    rules = [rule.name for rule in run.config.rules]
    rule = asked.choice("rule", (*rules, ALL_RULES), ALL_RULES)
    return Choice(
        metric=metrics[asked.choice("metric", METRIC_NAMES, run.config.metric)],
        rule=None if rule == ALL_RULES else rule,
        carrying=asked.choice("among", AMONG, AMONG[0]) == AMONG[0],
        by_share=asked.choice("first", FIRST, FIRST[0]) == FIRST[0],
    )


def _ranked(run: RunData, choice: Choice) -> Ranking:
    return rank(
        run,
        choice.metric,
        among="carrying" if choice.carrying else "all",
        by_share=choice.by_share,
        rule=choice.rule,
    )


def _entry(run: RunData, asked: Arguments) -> RankedRow | None:
    """The rollout of the rank asked for, the last one if there are fewer; ``None`` of none."""
    ranking = _ranked(run, _choice(run, asked))
    count = int(ranking.order.size)
    rank = min(asked.whole("rank", 1, 100_000_000, 1), count)
    return row(run, ranking, rank - 1) if count else None


def _row(run: RunData, entry: RankedRow) -> Mapping[str, Any]:
    return {
        "rank": entry.rank,
        "robustness": entry.robustness,
        "violated": entry.violated,
        "broken": entry.broken,
        "share": entry.share,
        "log_weight": entry.log_weight if run.method.has_likelihood_ratios else None,
        "misses": entry.misses,
        "stage": entry.stage,
        "index": entry.index,
    }


def _timeline(chosen: Track) -> Mapping[str, Any]:
    """What perception did at each step, and what is said at each state."""
    end = chosen.count - 1 if chosen.contact_step is None else chosen.contact_step
    right = np.any(chosen.answers[:end] == RIGHT, axis=1)
    return {
        "misses": np.flatnonzero(chosen.missed).tolist(),
        "detections": np.flatnonzero(right & ~chosen.missed[:end]).tolist(),
        "readings": list(_readings(chosen)),
        "words": [step_words(chosen, step) for step in range(chosen.count)],
    }


def _readings(chosen: Track) -> Iterator[Mapping[str, Any]]:
    """What is read off at a state: the charted signal and the ego's speed, else all signals."""
    shown: list[tuple[str, str, FloatArray]]
    if chosen.drawn is None:
        shown = [(signal_name(s), s.unit, values) for s, values in chosen.signals.items()]
    else:
        shown = [(signal_name(chosen.charted), chosen.charted.unit, chosen.values)]
        shown.append(("ego", "m/s", chosen.drawn.states.speed_mps[:, 0]))
    for name, unit, values in shown:
        yield {"name": name, "unit": unit, "values": [float(f"{v:.4g}") for v in values.tolist()]}


def _chart(chart: PlaneChart) -> Mapping[str, Any]:
    """A chart against time, and where its axes lie: shares of its width, pixels from its top."""
    plot = plot_of(chart)
    return {
        "html": drawn(chart),
        "left": plot.left / plot.width,
        "right": plot.right / plot.width,
        "top": plot.top,
        "bottom": plot.bottom,
    }
