"""The Recordings tab."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pemviz.panel.controller import PanelState
from pemviz.panel.rundata import RunData

if TYPE_CHECKING:
    from pemviz.panel.session import Session


class RecordingsTab:
    """Metrics against each other, and runs."""

    def __init__(self, session: Session) -> None:
        self._page = session.client.gui.add_html("")

    def refresh(self, state: PanelState) -> None:
        """Show a run."""
