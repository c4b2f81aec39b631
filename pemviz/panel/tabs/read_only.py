"""What only shows: the head above all tabs, and the tabs Learning and Why."""

from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.views.headline import headline, status
from pemviz.panel.views.learning import learning
from pemviz.panel.views.why import why


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


class LearningTab:
    """How the proposal forms."""

    def __init__(self, browser: Browser) -> None:
        self._page = browser.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._page, learning(run))


class WhyTab:
    """Which misses cause violations, and how far to trust the number."""

    def __init__(self, browser: Browser) -> None:
        self._page = browser.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._page, why(run))
