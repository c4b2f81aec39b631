"""The Trajectories tab: the ranking, and how a rollout is picked."""

import time
from collections.abc import Callable, Mapping
from typing import TypeVar, cast, get_args

import viser

from pemviz.config import MetricName
from pemviz.errors import InputError
from pemviz.panel.browser import Browser, element_id, set_html
from pemviz.panel.ranking import Among, RankedRow, Ranking, rank, row, scoring
from pemviz.panel.run_data import RunData
from pemviz.panel.tabs.player import FROM_ABOVE, FROM_BEHIND, Player
from pemviz.panel.views.details import details
from pemviz.panel.views.elements import block, quiet
from pemviz.panel.views.page import progress_words
from pemviz.panel.views.ranking_table import ranking_table

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
BY_SHARE: Mapping[str, bool] = {"least robust": False, "largest contribution": True}
FOLLOW_HINT = "Keep the ego car in view while it drives: the road moves beneath it."
VIEW_HINT = "Where the scene is seen from; drag, scroll and right drag move the view as you like."
LIVE_PAUSE_S = 0.6

Value = TypeVar("Value")


class TrajectoriesTab:
    """The ranking; this browser's own choice of metric and rollout."""

    def __init__(self, browser: Browser, player: Player) -> None:
        self._browser = browser
        self._player = player
        gui = browser.client.gui
        self.metric = gui.add_dropdown(
            "Ranked by", get_args(MetricName), initial_value="classical", hint=METRIC_HINT
        )
        self.among = gui.add_dropdown("Among", tuple(AMONG), hint=AMONG_HINT)
        self.first = gui.add_dropdown("First", tuple(BY_SHARE), hint=ORDER_HINT)
        self.rule = gui.add_dropdown("Rule", (EVERY_RULE,), visible=False, hint=RULE_HINT)
        self.place = gui.add_number("Rank", 1, min=1, max=1_000_000, step=1, hint=RANK_HINT)
        self.view = gui.add_dropdown("View", (FROM_BEHIND, FROM_ABOVE), hint=VIEW_HINT)
        self.view.on_update(browser.on(lambda: player.look_from(self._view())))
        self._table = gui.add_html("")
        self._details = gui.add_html("")
        self.follow = gui.add_checkbox("Follow ego", True, hint=FOLLOW_HINT)
        self.follow.on_update(browser.on(lambda: player.follow(self.follow.value)))
        for control in (self.metric, self.among, self.first, self.rule):
            control.on_update(browser.on(self._re_rank))
        self.place.on_update(browser.on(self._pick))
        self._add_keys()
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
            self._offer_rules(run)
        self._run = run
        self._show(place=None)

    def step(self, by: int) -> None:
        """Pick a neighbour in the ranking."""
        if self._ranking is None or not self._ranking.order.size:
            return
        last = int(self._ranking.order.size)
        self.place.value = min(max(self.place.value + by, 1), last)
        self._pick()

    def _offer_rules(self, run: RunData) -> None:
        self.rule.options = (EVERY_RULE, *(rule.name for rule in run.config.rules))
        self.rule.value = EVERY_RULE
        self.rule.visible = bool(run.config.rules)

    def _add_keys(self) -> None:
        gui, browser = self._browser.client.gui, self._browser
        down = gui.add_command("Next rollout", hotkey="arrowdown", icon=viser.Icon.ARROW_DOWN)
        up = gui.add_command("Previous rollout", hotkey="arrowup", icon=viser.Icon.ARROW_UP)
        down.on_trigger(browser.on(lambda: self.step(1)))
        up.on_trigger(browser.on(lambda: self.step(-1)))

    def _re_rank(self) -> None:
        self._show(place=0)

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
        ranking = self._asked_ranking(run)
        self._waiting = (place, by_hand) if ranking is None else None
        if ranking is None:
            return
        self._ranking = ranking
        self._offer_places(ranking)
        if not ranking.order.size:
            set_html(self._table, block(quiet("No rollouts yet.")))
            return
        if place is None:
            place = self._place_of(run, ranking) or 0
        entry = row(run, ranking, place)
        if by_hand:
            self._picked = (run.name, entry.repetition, entry.stage, entry.rollout)
        elif place == 0:
            self._picked = None
        self.place.value = place + 1
        set_html(
            self._table,
            ranking_table(run, ranking, selected=place, target=element_id(self.place)),
        )
        self._player.show(run, entry)
        set_html(self._details, details(run, entry, contact=self._player.contact_words))
        before, self.shown = self.shown, entry
        if before is None or before.index != entry.index:
            for listener in self._listeners:
                listener()

    def _offer_places(self, ranking: Ranking) -> None:
        last = max(int(ranking.order.size), 1)
        if self.place.max != last:
            self.place.max = last

    def _asked_ranking(self, run: RunData) -> Ranking | None:
        """The ranking that was asked for; while its scores are computed, how far they are."""
        self._waiting = None
        metric, rule = self._metric(), self._rule(run)
        progress = scoring(run, metric, rule=rule)
        if progress is not None:
            words = f"Scored under {metric} so far: {progress_words(progress)}."
            set_html(self._table, block(quiet(words)))
            return None
        return rank(
            run,
            metric,
            among=self._chosen(self.among.value, AMONG, "among"),
            by_share=self._chosen(self.first.value, BY_SHARE, "first"),
            rule=rule,
        )

    def go_on(self) -> None:
        """Show the ranking that was asked for as soon as its scores are there, else how far."""
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

    @staticmethod
    def _chosen(word: str, meanings: Mapping[str, Value], name: str) -> Value:
        if word not in meanings:
            message = f"{name} = {word[:40]!r}: must be one of {', '.join(meanings)}"
            raise InputError(message)
        return meanings[word]

    def _view(self) -> str:
        return self._chosen(self.view.value, {v: v for v in (FROM_BEHIND, FROM_ABOVE)}, "view")

    def _rule(self, run: RunData) -> str | None:
        names: dict[str, str | None] = {rule.name: rule.name for rule in run.config.rules}
        return self._chosen(self.rule.value, {EVERY_RULE: None} | names, "rule")

    def _metric(self) -> MetricName:
        metric = self.metric.value
        if metric not in get_args(MetricName):
            message = f"metric = {metric[:40]!r}: must be one of {', '.join(get_args(MetricName))}"
            raise InputError(message)
        return cast(MetricName, metric)

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
