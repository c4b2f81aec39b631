"""The Compare tab: metrics against each other, and runs side by side."""

from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.scans import Progress
from pemviz.panel.tabs.chart import Chart
from pemviz.panel.views.compare import (
    MOST_RUNS,
    comparing,
    metric_curves,
    metrics_page,
    run_curves,
    runs_page,
)
from pemviz.panel.views.elements import quiet
from pemviz.panel.views.page import page, progress_words, wide

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
