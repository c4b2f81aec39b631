"""One browser: its own selection, playback and view, on a thread of its own.

Callbacks of controls run on viser's threads and only put work into the session's queue.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import viser

from pemviz.errors import PemvizError
from pemviz.panel.hub import Hub
from pemviz.panel.run_data import RunData
from pemviz.panel.tabs.compare import CompareTab
from pemviz.panel.tabs.experiment import ExperimentTab
from pemviz.panel.tabs.head import Head
from pemviz.panel.tabs.learning_and_why import LearningTab, WhyTab
from pemviz.panel.tabs.player import Player
from pemviz.panel.tabs.recordings import RecordingsTab
from pemviz.panel.tabs.trajectories import TrajectoriesTab

LOG = logging.getLogger(__name__)

FRAME_S = 1 / 12
REFRESH_S = 0.2


class Session:
    """A connected browser.

    Attributes:
        client: The browser.
        hub: What it shares with others.
    """

    def __init__(self, client: viser.ClientHandle, hub: Hub) -> None:
        self.client = client
        self.hub = hub
        self.loaded: RunData | None = None
        self._work: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._seen_version = -1
        self._refreshed_s = 0.0
        self._later: dict[str, Callable[[], None]] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(
            target=self._live, name=f"pemviz-browser-{client.client_id}", daemon=True
        )

    @property
    def run(self) -> RunData | None:
        """The run that this browser looks at: one it loaded, else the one all share."""
        return self.loaded or self.hub.controller.state.run

    def start(self) -> None:
        """Build the page and keep it up to date."""
        self._thread.start()

    def close(self) -> None:
        """The browser is gone."""
        self._closed.set()
        self._work.put(None)

    def join(self, *, timeout_s: float = 10.0) -> None:
        """Wait until the session has ended; after :meth:`close`."""
        self._thread.join(timeout_s)

    def post(self, work: Callable[[], None]) -> None:
        """Have the session's thread do something."""
        self._work.put(work)

    def later(self, name: str, work: Callable[[], None]) -> None:
        """Have the session's thread do something once it has nothing else to do.

        Work of the same name replaces what still waits; only for the session's own thread.
        """
        self._later[name] = work

    def on(self, work: Callable[[], None]) -> Callable[[Any], None]:
        """A callback for a control: does ``work`` if a person moved it, not the program."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                self.post(work)

        return callback

    def tell(self, title: str, message: str, *, color: Any = "red") -> None:
        """Show a notification in this browser."""
        self.client.add_notification(title, message, color=color, auto_close_seconds=8.0)

    def look_at(self, run: RunData | None) -> None:
        """Look at a loaded run, or with ``None`` at the one that all share."""
        self.loaded = run
        self._seen_version = -1
        self.player.forget()

    def post_refresh(self) -> None:
        """Look again at the shared state at the next turn."""
        self._seen_version = -1

    def _live(self) -> None:
        try:
            self._build()
        except Exception:
            if not self._closed.is_set():
                LOG.exception("building the page failed")
            return
        while not self._closed.is_set():
            self._guarded(self._turn)

    def _build(self) -> None:
        with self.client.atomic():
            self.head = Head(self)
            tabs = self.client.gui.add_tab_group()
            with tabs.add_tab("Experiment"):
                self.experiment = ExperimentTab(self)
            with tabs.add_tab("Learning"):
                self.learning = LearningTab(self)
            with tabs.add_tab("Trajectories"):
                self.trajectories = TrajectoriesTab(self)
            with tabs.add_tab("Compare"):
                self.compare = CompareTab(self)
            with tabs.add_tab("Why"):
                self.why = WhyTab(self)
            with tabs.add_tab("Recordings"):
                self.recordings = RecordingsTab(self)
            self.player = Player(self)
            self._refresh()

    def _turn(self) -> None:
        """Do what is asked, or else let time pass."""
        pause_s = FRAME_S if self.player.playing else REFRESH_S
        try:
            work = self._work.get(timeout=0.0 if self._later else pause_s)
        except queue.Empty:
            work = self._later.pop(next(iter(self._later))) if self._later else _nothing
        if work is None or self._closed.is_set():
            return
        work()
        self.player.advance()
        if time.monotonic() - self._refreshed_s >= REFRESH_S:
            self._refresh()

    def _refresh(self) -> None:
        """Show what has changed in the state that all share."""
        self._refreshed_s = time.monotonic()
        state = self.hub.controller.state
        if state.version == self._seen_version:
            return
        self._seen_version = state.version
        run = self.loaded or state.run
        with self.client.atomic():  # first what a person waits for after Run and Stop
            self.head.refresh(state, run)
            self.experiment.refresh(state)
        with self.client.atomic():
            self.learning.refresh(run)
            self.why.refresh(run)
            self.trajectories.refresh(run)
            self.compare.refresh(state, run)
            self.recordings.refresh(state)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do ``work``; what fails is told to the person, and the session goes on."""
        try:
            work()
        except PemvizError as error:
            self.tell("This did not work", " ".join(str(error).split()))
        except Exception as error:  # one browser's trouble must not end its page
            if self._closed.is_set():
                return
            LOG.exception("a browser's request failed")
            self.tell("This did not work", f"{type(error).__name__}: {error}")


def _nothing() -> None:
    """Time passes."""
