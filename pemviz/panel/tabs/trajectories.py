"""The Trajectories tab: the ranking, and how a rollout is picked."""

import time
from typing import cast, get_args

import viser

from pemviz.config import MetricName
from pemviz.errors import InputError
from pemviz.panel.browser import Browser, element_id, set_html
from pemviz.panel.ranking import Ranking, rank, row
from pemviz.panel.run_data import RunData
from pemviz.panel.tabs.player import Player
from pemviz.panel.views.ranking_table import ranking_table
from pemviz.reports.pictures.html import block, quiet

METRIC_HINT = (
    "Metric that ranks the rollouts shown; re-ranks what is stored at once, without a new run. "
    "Violations are always decided by the classical metric."
)
RANK_HINT = "Which rollout to show; 1 is the least robust. Keys: arrow down, arrow up."
FOLLOW_HINT = "Keep the ego car in view while it drives: the road moves beneath it."
LIVE_PAUSE_S = 0.6


class TrajectoriesTab:
    """The ranking; this browser's own choice of metric and rollout."""

    def __init__(self, browser: Browser, player: Player) -> None:
        self._browser = browser
        self._player = player
        gui = browser.client.gui
        self.metric = gui.add_dropdown(
            "Ranked by", get_args(MetricName), initial_value="classical", hint=METRIC_HINT
        )
        self.place = gui.add_number("Rank", 1, min=1, max=1_000_000, step=1, hint=RANK_HINT)
        self._table = gui.add_html("")
        self.follow = gui.add_checkbox("Follow ego", True, hint=FOLLOW_HINT)
        self.follow.on_update(browser.on(lambda: player.follow(self.follow.value)))
        self.metric.on_update(browser.on(self._re_rank))
        self.place.on_update(browser.on(self._pick))
        self._add_keys()
        self._run: RunData | None = None
        self._ranking: Ranking | None = None
        self._picked: tuple[str, int, int, int] | None = None
        self._shown_s = 0.0

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
        self._run = run
        self._show(place=None)

    def step(self, by: int) -> None:
        """Pick a neighbour in the ranking."""
        if self._ranking is None or not self._ranking.order.size:
            return
        last = int(self._ranking.order.size)
        self.place.value = min(max(self.place.value + by, 1), last)
        self._pick()

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
        self._ranking = ranking = rank(run, self._metric())
        if not ranking.order.size:
            set_html(self._table, block(quiet("No rollouts yet.")))
            return
        if place is None:
            place = self._place_of_picked(run, ranking)
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

    def _metric(self) -> MetricName:
        metric = self.metric.value
        if metric not in get_args(MetricName):
            message = f"metric = {metric[:40]!r}: must be one of {', '.join(get_args(MetricName))}"
            raise InputError(message)
        return cast(MetricName, metric)

    def _place_of_picked(self, run: RunData, ranking: Ranking) -> int:
        if self._picked is None or self._picked[0] != run.name:
            return 0
        table = run.rollouts
        same = (
            (table["repetition"] == self._picked[1])
            & (table["stage"] == self._picked[2])
            & (table["rollout"] == self._picked[3])
        )
        ranks = same[ranking.order].nonzero()[0]
        return int(ranks[0]) if ranks.size else 0
