"""The Compare tab: metrics against each other, and two runs."""

from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.views.compare import metrics_page, runs_page

NONE = "none"


class CompareTab:
    """This browser's choice of a second run."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._run: RunData | None = None
        self._second: RunData | None = None
        self._finished = -1
        gui = browser.client.gui
        self.other = gui.add_dropdown("Compare with", list[str]([NONE]), initial_value=NONE,
            hint="A run of the recordings folder, shown as B beside the run shown, A.")  # fmt: skip
        self.other.on_update(browser.on(self._choose))
        self._runs = gui.add_html("")
        self._metrics = gui.add_html("")

    def refresh(self, state: PanelState, run: RunData | None) -> None:
        """Show a run, when there is time for it."""
        self._run = run
        if state.finished_runs != self._finished:
            self._finished = state.finished_runs
            names = (NONE, *self._browser.hub.recordings.names())
            if tuple(self.other.options) != names:
                self.other.options = names
        self._browser.later("compare", self._show)

    def _choose(self) -> None:
        name = self.other.value
        if name == NONE:
            self._second = None
        else:
            self._second = self._browser.hub.loaded.get(self._browser.hub.recordings.folder(name))
        self._show()

    def _show(self) -> None:
        set_html(self._runs, runs_page(self._run, self._second))
        set_html(self._metrics, metrics_page(self._run))
