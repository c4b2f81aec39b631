"""Tabs that only show: Learning and Why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.panel.run_data import RunData
from pemviz.panel.views.learning import learning
from pemviz.panel.views.why import why
from pemviz.panel.widgets import set_html

if TYPE_CHECKING:
    from pemviz.panel.session import Session


class LearningTab:
    """How the proposal forms."""

    def __init__(self, session: Session) -> None:
        self._page = session.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._page, learning(run))


class WhyTab:
    """Which misses cause violations, and how far to trust the number."""

    def __init__(self, session: Session) -> None:
        self._page = session.client.gui.add_html("")

    def refresh(self, run: RunData | None) -> None:
        """Show a run."""
        set_html(self._page, why(run))
