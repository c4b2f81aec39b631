"""One browser's page: its tabs and the player, kept up to date on a thread of its own."""

import logging
import threading
import time
from collections.abc import Callable

import viser

from pemviz.errors import PemvizError
from pemviz.panel.browser import Browser, Hub
from pemviz.panel.page_layout import Window
from pemviz.panel.tabs.compare import CompareTab
from pemviz.panel.tabs.experiment import ExperimentTab
from pemviz.panel.tabs.player import Player
from pemviz.panel.tabs.read_only import Head, LearningTab, WeightsTab, WhyTab
from pemviz.panel.tabs.recordings import RecordingsTab
from pemviz.panel.tabs.trajectories import TrajectoriesTab

LOG = logging.getLogger(__name__)

FRAME_S = 1 / 12
REFRESH_S = 0.2
LIST_S = 2.0


class Session:
    """Does what a browser asks for, and refreshes its page."""

    def __init__(self, client: viser.ClientHandle, hub: Hub) -> None:
        self._browser = Browser(client, hub)
        self._refreshed_s = self._listed_s = 0.0
        self._thread = threading.Thread(
            target=self._live, name=f"pemviz-browser-{client.client_id}", daemon=True
        )

    def start(self) -> None:
        """Build the page and keep it up to date."""
        self._thread.start()

    def close(self) -> None:
        """The browser is gone."""
        self._browser.close()

    def join(self, *, timeout_s: float = 10.0) -> None:
        """Wait until the session has ended; after :meth:`close`."""
        self._thread.join(timeout_s)

    def _live(self) -> None:
        try:
            self._build()
        except BaseException:
            if not self._browser.closed:
                LOG.exception("building the page failed")
            return
        while not self._browser.closed:
            self._guarded(self._turn)

    def _build(self) -> None:
        browser = self._browser
        with browser.client.atomic():
            self.head = Head(browser)
            self.player = Player(browser)
            tabs = browser.client.gui.add_tab_group()
            with tabs.add_tab("Experiment"):
                self.experiment = ExperimentTab(browser)
            with tabs.add_tab("Trajectories"):
                self.trajectories = TrajectoriesTab(browser, self.player)
            recordings = tabs.add_tab("Recordings")
            self.analysis = analysis = Window(browser.client, at_top=True)
            with analysis.panel.add_tab("Learning"):
                self.learning = LearningTab(browser)
            with analysis.panel.add_tab("Weights"):
                self.weights = WeightsTab(browser, self.trajectories, analysis)
            with analysis.panel.add_tab("Compare"):
                self.compare = CompareTab(browser)
            with analysis.panel.add_tab("Why"):
                self.why = WhyTab(browser, self.trajectories, analysis)
            with recordings:
                self.recordings = RecordingsTab(
                    browser,
                    self.player,
                    use_settings=self.experiment.show,
                    list_runs=self.compare.list_runs,
                )
            analysis.panel.minimize()
            self._fit()
            browser.client.camera.on_update(lambda _: browser.post(self._fit))
            self._refresh()

    def _fit(self) -> None:
        """Lay the windows over the scene as large as it is."""
        self.analysis.fit()
        self.player.window.fit()

    def _turn(self) -> None:
        """Do what is asked, or else let time pass."""
        work = self._browser.next_work(pause_s=FRAME_S if self.player.playing else REFRESH_S)
        if self._browser.closed:
            return
        work()
        self.player.advance()
        if time.monotonic() - self._refreshed_s >= REFRESH_S:
            self._refresh()
            for tab in (self.trajectories, self.weights, self.compare):
                tab.go_on()
        if time.monotonic() - self._listed_s >= LIST_S:
            self._listed_s = time.monotonic()
            self.recordings.look()

    def _refresh(self) -> None:
        """Show what has changed in the state that all share."""
        self._refreshed_s = time.monotonic()
        browser = self._browser
        state = browser.hub.controller.state
        if state.version == browser.shown_version:
            return
        browser.shown_version = state.version
        run = browser.loaded or state.run
        with browser.client.atomic():  # first what a person waits for after Run and Stop
            self.head.refresh(state, run, limit=self.experiment.limit)
            self.experiment.refresh(state)
        with browser.client.atomic():
            self.learning.refresh(run)
            self.why.refresh(run)
            self.trajectories.refresh(run)
            self.weights.refresh(run)
            self.compare.refresh(state, run)
            self.recordings.refresh(state)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do ``work``; what fails is told to the person, and the session goes on."""
        browser = self._browser
        try:
            work()
        except PemvizError as error:
            browser.tell("This did not work", " ".join(str(error).split()))
        except BaseException as error:  # one browser's trouble must not end its page
            if browser.closed:
                return
            LOG.exception("a browser's request failed")
            browser.tell("This did not work", f"{type(error).__name__}: {error}")
