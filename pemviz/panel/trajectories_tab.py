"""The Trajectories tab: the ranking, how a rollout is picked, and what there is to say of it."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from html import escape
from typing import TypeVar, cast

import numpy as np
import viser

from pemviz import stl
from pemviz.analysis.causes import CARRIED
from pemviz.arrays import FloatArray
from pemviz.charts.svg import Axis, Plot
from pemviz.colors import MISSED
from pemviz.config import MetricName
from pemviz.errors import InputError
from pemviz.latents import Latents
from pemviz.panel.browser import Browser, element_id
from pemviz.panel.curve_chart import signal_name
from pemviz.panel.page import MINUS, block, number, percent, progress_words, quiet
from pemviz.panel.ranking import METRIC_NAMES, Among, RankedRow, Ranking, rank, row, scoring
from pemviz.panel.rollout_player import VIEWS, Player
from pemviz.panel.rollout_tables import final_violations
from pemviz.panel.run_data import RunData
from pemviz.reports.charts import RUN_COLORS
from pemviz.reports.document import Block, Paragraph, Table, Verdict
from pemviz.reports.html import blocks_html, clicks_to, heading
from pemviz.runs.answers import rules_in_order
from pemviz.runs.specification import build_formula
from pemviz.simulators.latents import NamesStarts, within
from pemviz.types import Simulator

PAGE_ROWS = 12
LONG_NAMES = 18
SCENE = (
    "a ball over a car says what perception reports of it: small and blue detected, large and "
    "orange missed, grey nothing to report; beside the road stands a row for each obstacle, flat "
    "blue marks where the ego detected it, upright crosses where it erred. White lines: where "
    "the controller tracks a car, with an ellipse of two standard deviations where it knows any. "
    "From contact on the cars are grey."
)
_CELL = "padding:2px 4px;text-align:right;white-space:nowrap"
_HEAD = "padding:2px 4px;text-align:right;vertical-align:bottom;color:#52606d;font-weight:500"
MOST_LATENTS = 12
NOISE_WIDTH, NOISE_HEIGHT = 390, 130
BROKEN, KEPT = Verdict("no", "broken"), Verdict("yes", "kept")
METRIC_HINT = (
    "Metric that ranks the rollouts shown; re-ranks what is stored at once, without a new run. "
    "Whether one violates is decided by the formula itself."
)
AMONG_HINT = (
    "Which rollouts are ranked: those that carry the answer, so that rank 1 is a failure that "
    "could happen, or all, with those of early stages that pile up misses which hardly ever "
    "come together."
)
ORDER_HINT = "Whether rank 1 is the least robust rollout or contributes most to the probability."
RULE_HINT = "Which rule's robustness and answer the ranking is about; all: the specification."
EVERY_RULE: str = "all rules"
RANK_HINT = "Which rollout to show. Keys: arrow down, arrow up."
CARRIES, ALL = "what carries the answer", "all rollouts"
AMONG: Mapping[str, Among] = {CARRIES: "carrying", ALL: "all"}
LEAST_ROBUST, LARGEST = "least robust", "largest contribution"
BY_SHARE: Mapping[str, bool] = {LEAST_ROBUST: False, LARGEST: True}
FOLLOW_HINT = "Keep the ego car in view while it drives: the road moves beneath it."
VIEW_HINT = "Where the scene is seen from; drag, scroll and right drag move the view as you like."
LIVE_PAUSE_S = 0.6

Value = TypeVar("Value")


def ranking_table(run: RunData, ranking: Ranking, *, selected: int, target: str) -> str:
    """A page of rows around the selected place; ``target`` is the rank input's element id."""
    count = int(ranking.order.size)
    if not count:
        return block(quiet("No rollouts yet."))
    start = max(0, min(selected // PAGE_ROWS * PAGE_ROWS, count - PAGE_ROWS))
    end = min(start + PAGE_ROWS, count)
    unit = "" if ranking.metric == "agm" else " [m]"
    header = (
        "rank", f"robustness{unit}", "breaks" if run.config.rules else "violated",
        "of the answer", "log weight [nats]", "misses", "stage",
    )  # fmt: skip
    head = "".join(f"<th style='{_HEAD}'>{h}</th>" for h in header)
    weighted = run.method.has_likelihood_ratios
    lines: list[str] = []
    for place in range(start, end):
        entry = row(run, ranking, place)
        robustness = number(entry.robustness)
        if 0.01 <= abs(entry.robustness) < 1000.0:  # as many decimals in every row
            robustness = f"{entry.robustness:.3f}".replace("-", MINUS)
        values = (
            str(entry.rank), robustness, _verdict(run, entry),
            percent(entry.share) if entry.share else "",
            number(entry.log_weight if weighted else None), str(entry.misses), str(entry.stage),
        )  # fmt: skip
        cells = "".join(f"<td style='{_CELL}'>{value}</td>" for value in values)
        mark = "background:#dbeafe;font-weight:600;" if place == selected else ""
        lines.append(
            f"<tr data-rank='{entry.rank}' role='button' data-number='{entry.rank}'"
            f" {clicks_to(target)} aria-selected='{'true' if place == selected else 'false'}'"
            f" style='border-top:1px solid #e4e7eb;cursor:pointer;{mark}'>{cells}</tr>"
        )
    shown = (
        f"Ranks {start + 1} to {end} of {count:,} {ranked_text(ranking)}. "
        "Click a row, or press the up and down arrow keys; type a rank to jump. In the scene, "
        f"{SCENE}"
    )
    if run.kept < run.simulated:
        shown += (
            f" Of {run.simulated:,} rollouts {run.kept:,} are kept here: those that contribute "
            f"most to the answer, and the least robust under {run.config.metric}."
        )
    return block(
        f"<table aria-label='Ranking' style='border-collapse:collapse;width:100%;"
        f"font-size:11.5px;font-variant-numeric:tabular-nums'><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table>{quiet(shown)}"
    )


def _verdict(run: RunData, entry: RankedRow) -> str:
    """Whether a rollout violates; where there are rules, which of them it breaks."""
    sign = f"<b style='color:{MISSED}'>\N{MULTIPLICATION X}"
    if not run.config.rules:
        return f"{sign} yes</b>" if entry.violated else "no"
    names = escape(", ".join(entry.broken))
    if len(names) > LONG_NAMES:  # which they are is told below, of the rollout shown
        count = f"{len(entry.broken)} of {len(run.config.rules)}"
        names = f"<span title='{names}'>{count} rules</span>"
    return f"{sign}</b> {names}" if names else "none"


def ranked_text(ranking: Ranking) -> str:
    """Which rollouts are ranked, and how."""
    which = "rollouts"
    if ranking.among == "carrying":
        which = f"rollouts that make up {100 * CARRIED:g} % of the answer"
    under = ranking.metric
    if ranking.rule is not None:
        which += f" to rule {escape(ranking.rule)}" if ranking.among == "carrying" else ""
        under += f" in rule {escape(ranking.rule)}"
    how = f"the least robust under {under} first"
    if ranking.by_share:
        how = f"the largest contribution first, then the least robust under {under}"
    return f"{which}, {how}"


def details(run: RunData, entry: RankedRow, *, contact: str = "") -> str:
    """Each rule, contact, start and latents; empty where scene and plots tell all there is."""
    blocks: list[Block] = []
    if robustness := rule_robustness(run, entry.index):
        rows = tuple(
            (name, number(value), BROKEN if name in entry.broken else KEPT)
            for name, value in robustness.items()
        )
        blocks.append(Table(("rule", "robustness", ""), rows, name="Rules of the rollout"))
    if contact:
        blocks.append(Paragraph(f"{contact[0].upper()}{contact[1:]}.", tone="quiet"))
    plot, latents = "", run.latents(entry.index)
    if latents is not None:
        if latents.start.size:
            blocks.append(Paragraph(_start_words(run, latents), tone="quiet"))
        plot = _noise(run, latents)
    shown = blocks_html(blocks) + plot
    return block(heading("The rollout shown") + shown) if shown else ""


def rule_robustness(run: RunData, index: int) -> dict[str, float]:
    """Classical robustness of a rollout in each rule, by name."""
    signals = run.signals(index)
    found: dict[str, float] = {}
    for rule in run.config.rules:
        config = replace(run.config, spec=rule.formula, rules=())
        formula = build_formula(config, cast(Simulator, run.simulator))
        found[rule.name] = float(stl.robustness(formula, signals, stl.Classical())[0])
    return found


def _start_words(run: RunData, latents: Latents) -> str:
    """The values it started with, where the scenario names them; else the latents themselves."""
    named = within(run.simulator, NamesStarts)
    if named is None:
        mean = latents.start_mean[0]
        around = f", drawn around {_listed(mean)}" if np.any(mean) else ""
        return f"Standard normals at its start: {_listed(latents.start[0])}{around}."
    values = named.start_values(latents.start)
    words = [
        f"{signal_name(signal)} {number(float(values[signal.name][0]))} {signal.unit}"
        for signal in named.starts
    ]
    return f"It started with {', '.join(words)}."


def _listed(values: FloatArray) -> str:
    shown, more = ", ".join(number(float(v)) for v in values[:MOST_LATENTS]), values.size
    return shown if more <= MOST_LATENTS else f"{shown} and {more - MOST_LATENTS} more"


def _noise(run: RunData, latents: Latents) -> str:
    noise: FloatArray = latents.noise[0, :, : len(RUN_COLORS)]
    if not noise.size:
        return ""
    reach = max(3.0, float(np.max(np.abs(noise))) * 1.05)
    time_s = run.time_s
    plot = Plot(
        title="Standard normals of its steps",
        x=Axis(0.0, float(time_s[-1]), "time [s]"),
        y=Axis(-reach, reach, "standard deviations"),
        width=NOISE_WIDTH,
        height=NOISE_HEIGHT,
    )
    for values, color in zip(noise.T, RUN_COLORS, strict=False):
        plot.line(time_s[:-1], values, color=color, width=1.2)
    return plot.text()


def chosen(word: str, meanings: Mapping[str, Value], name: str) -> Value:
    """What a word of a dropdown means.

    Raises:
        InputError: It is none of them: a message need not come from our page.
    """
    if word not in meanings:
        message = f"{name} = {word[:40]!r}: must be one of {', '.join(meanings)}"
        raise InputError(message)
    return meanings[word]


def opens_on(run: RunData) -> str:
    """The first rule that anything breaks, those about collisions before others."""
    ordered = rules_in_order(run.config.rules)
    final = (final_violations(run.rollouts, stages=run.result.stages, rule=r.name) for r in ordered)
    broken = (rule.name for rule, found in zip(ordered, final, strict=True) if found.any())
    return next(broken, EVERY_RULE) if run.parts else EVERY_RULE


class TrajectoriesTab:
    """The ranking; this browser's own choice of metric and rollout."""

    def __init__(self, browser: Browser, player: Player) -> None:
        self._browser = browser
        self._player = player
        gui = browser.client.gui
        self.metric = gui.add_dropdown(
            "Ranked by", METRIC_NAMES, initial_value="classical", hint=METRIC_HINT
        )
        self.among = gui.add_dropdown("Among", tuple(AMONG), hint=AMONG_HINT)
        self.first = gui.add_dropdown("First", tuple(BY_SHARE), hint=ORDER_HINT)
        self.rule = gui.add_dropdown("Rule", (EVERY_RULE,), visible=False, hint=RULE_HINT)
        self.place = gui.add_number("Rank", 1, min=1, max=1_000_000, step=1, hint=RANK_HINT)
        self.view = gui.add_dropdown("View", tuple(VIEWS), hint=VIEW_HINT)
        self.view.on_update(browser.on(self._look))
        self._table = gui.add_html("")
        self._details = gui.add_html("")
        self.follow = gui.add_checkbox("Follow ego", True, hint=FOLLOW_HINT)
        self.follow.on_update(browser.on(lambda: player.follow(self.follow.value)))
        for control in (self.metric, self.among, self.first, self.rule):
            control.on_update(browser.on(lambda: self._show(place=0)))
        self.place.on_update(browser.on(self._pick))
        down = gui.add_command("Next rollout", hotkey="arrowdown", icon=viser.Icon.ARROW_DOWN)
        up = gui.add_command("Previous rollout", hotkey="arrowup", icon=viser.Icon.ARROW_UP)
        down.on_trigger(browser.on(lambda: self._step(1)))
        up.on_trigger(browser.on(lambda: self._step(-1)))
        self._run: RunData | None = None
        self._ranking: Ranking | None = None
        self._waiting: tuple[int | None, bool] | None = None
        self._picked: tuple[str, int, int, int] | None = None
        self._shown_s = 0.0
        self._listeners: list[Callable[[], None]] = []
        self.shown: RankedRow | None = None

    def on_show(self, listener: Callable[[], None]) -> None:
        """Have somebody told when another rollout is shown."""
        self._listeners.append(listener)

    def refresh(self, run: RunData | None) -> None:
        """Show another run, or a later state of the same one."""
        if run is None or run is self._run:
            return
        same = self._run is not None and run.name == self._run.name
        if same and run.running and time.monotonic() - self._shown_s < LIVE_PAUSE_S:
            self._browser.refresh()
            return
        self._shown_s = time.monotonic()
        if self._run is None or run.name != self._run.name:
            self._picked = None
            self.metric.value = run.config.metric
            self.rule.options = (EVERY_RULE, *(rule.name for rule in run.config.rules))
            self.rule.value = opened = opens_on(run)
            self.first.value = LEAST_ROBUST if opened == EVERY_RULE else LARGEST
            self.rule.visible = bool(run.config.rules)
        self._run = run
        self._show(place=None)

    def _look(self) -> None:
        self._player.look_from(*chosen(self.view.value, VIEWS, "view"))

    def _step(self, by: int) -> None:
        if self._ranking is None or not self._ranking.order.size:
            return
        self.place.value = min(max(self.place.value + by, 1), int(self._ranking.order.size))
        self._pick()

    def _pick(self) -> None:
        ranking = self._ranking
        if ranking is None or not ranking.order.size:
            return
        self._show(place=min(max(self.place.value, 1), int(ranking.order.size)) - 1, by_hand=True)

    def _show(self, *, place: int | None, by_hand: bool = False) -> None:
        """Show the ranking with a place chosen; ``None`` keeps the rollout that was picked."""
        run = self._run
        if run is None:
            return
        ranking = self._wanted_ranking(run)
        self._waiting = (place, by_hand) if ranking is None else None
        if ranking is None:
            return
        self._ranking = ranking
        self.place.max = max(int(ranking.order.size), 1)
        if not ranking.order.size:
            self._table.content = block(quiet("No rollouts yet."))
            return
        if place is None:
            place = self._place_of(run, ranking) or 0
        entry = row(run, ranking, place)
        if by_hand:
            self._picked = (run.name, entry.repetition, entry.stage, entry.rollout)
        elif place == 0:
            self._picked = None
        self.place.value = place + 1
        self._table.content = ranking_table(
            run, ranking, selected=place, target=element_id(self.place)
        )
        self._player.show(run, entry)
        self._details.content = details(run, entry, contact=self._player.contact_words)
        before, self.shown = self.shown, entry
        if before is None or before.index != entry.index:
            for listener in self._listeners:
                listener()

    def _wanted_ranking(self, run: RunData) -> Ranking | None:
        """The ranking that is wanted; while its scores are computed, how far they are."""
        self._waiting = None
        metrics: dict[str, MetricName] = {name: name for name in METRIC_NAMES}
        metric = chosen(self.metric.value, metrics, "metric")
        rules: dict[str, str | None] = {one.name: one.name for one in run.config.rules}
        rule = chosen(self.rule.value, {EVERY_RULE: None} | rules, "rule")
        progress = scoring(run, metric, rule=rule)
        if progress is not None:
            words = f"Scored under {metric} so far: {progress_words(progress)}."
            self._table.content = block(quiet(words))
            return None
        among = chosen(self.among.value, AMONG, "among")
        by_share = chosen(self.first.value, BY_SHARE, "first")
        return rank(run, metric, among=among, by_share=by_share, rule=rule)

    def go_on(self) -> None:
        """Show the wanted ranking as soon as its scores are there, else how far."""
        if self._waiting is not None:
            place, by_hand = self._waiting
            self._show(place=place, by_hand=by_hand)

    def pick(self, *, repetition: int, stage: int, rollout: int) -> None:
        """Show a rollout, among all if it is not among those ranked."""
        if self._run is None:
            return
        self._picked = (self._run.name, repetition, stage, rollout)
        if self._ranking is not None and self._place_of(self._run, self._ranking) is None:
            self.among.value = ALL
        self._show(place=None)

    def pick_index(self, index: int) -> None:
        """Show the rollout at an index of the run's tables.

        Raises:
            InputError: There is none.
        """
        run = self._run
        kept = 0 if run is None else run.kept
        if run is None or not 0 <= index < kept:
            message = f"rollout = {index}: must be at least 0 and below {kept}"
            raise InputError(message)
        table = run.rollouts
        self.pick(
            repetition=int(table["repetition"][index]),
            stage=int(table["stage"][index]),
            rollout=int(table["rollout"][index]),
        )

    def _place_of(self, run: RunData, ranking: Ranking) -> int | None:
        """The picked rollout's place; ``None`` if it is not ranked, or none is picked."""
        if self._picked is None or self._picked[0] != run.name:
            return None
        table = run.rollouts
        same = (
            (table["repetition"] == self._picked[1])
            & (table["stage"] == self._picked[2])
            & (table["rollout"] == self._picked[3])
        )
        ranks = same[ranking.order].nonzero()[0]
        return int(ranks[0]) if ranks.size else None
