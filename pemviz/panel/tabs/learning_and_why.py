"""Tabs that only show: Learning and Why."""

from pemviz.panel.browser import Browser
from pemviz.panel.run_data import RunData
from pemviz.panel.views.learning import learning
from pemviz.panel.views.why import why
from pemviz.panel.widgets import set_html


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
