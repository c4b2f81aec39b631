"""Above all tabs: the answer, what runs, how far it is."""

from pemviz.panel.browser import Browser
from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.views.headline import headline, status
from pemviz.panel.widgets import set_html


class Head:
    """The answer, the state, the progress bar."""

    def __init__(self, browser: Browser) -> None:
        gui = browser.client.gui
        self._headline = gui.add_html("")
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False, color="blue")

    def refresh(self, state: PanelState, run: RunData | None) -> None:
        """Show the state."""
        set_html(self._headline, headline(run))
        set_html(self._status, status(state))
        if self._bar.visible != state.running:
            self._bar.visible = state.running
        self._bar.value = 100.0 * state.progress.share if state.progress is not None else 0.0
