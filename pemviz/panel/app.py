"""The panel's server, and a session for every browser: its tabs, kept up to date on a thread."""

import logging
import threading
import time
from dataclasses import replace
from typing import Any

import viser

from pemviz.config.toml_files import load_preset
from pemviz.errors import InputError, PemvizError
from pemviz.files.shipped import sample_run
from pemviz.panel.arguments import Arguments
from pemviz.panel.browser import Browser, Hub, Window
from pemviz.panel.compare_tab import CompareTab
from pemviz.panel.controller import Controller, PanelState
from pemviz.panel.experiment_tab import ExperimentTab
from pemviz.panel.headline import Head, status_words
from pemviz.panel.learning_tab import LearningTab
from pemviz.panel.loading import load_run
from pemviz.panel.new_run_place import NewRunPlace
from pemviz.panel.page import COLUMN_PX
from pemviz.panel.process_memory import give_back
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.panel.recordings_tab import RecordingsTab
from pemviz.panel.rollout_player import Player
from pemviz.panel.run_place import RunPlace
from pemviz.panel.run_summary import summary
from pemviz.panel.runs_place import RunsPlace
from pemviz.panel.scene import look_from_first_view
from pemviz.panel.server import guarded_server, scene_of
from pemviz.panel.site import Json, OwnPages, Page
from pemviz.panel.trajectories_tab import TrajectoriesTab
from pemviz.panel.weights_tab import WeightsTab
from pemviz.panel.why_tab import WhyTab

LOG = logging.getLogger(__name__)

FRAME_S = 1 / 12
REFRESH_S = 0.2
LIST_S = 2.0
QUICK_ROLLOUTS = 200
FORM = "form"
"""Address, behind that of scenes, of the page with all controls of an experiment."""


class Session:
    """Does what a browser asks for, and refreshes its page."""

    def __init__(self, client: viser.ClientHandle, hub: Hub) -> None:
        self.browser = Browser(client, hub)
        self._refreshed_s = self._listed_s = 0.0
        self.thread = threading.Thread(
            target=self._live, name=f"pemviz-browser-{client.client_id}", daemon=True
        )

    def _live(self) -> None:
        browser = self.browser
        try:
            self._build()
        except BaseException:
            if not browser.closed:
                LOG.exception("building the page failed")
            return
        while not browser.closed:  # what fails is told to the person, and the session goes on
            try:
                self._turn()
            except PemvizError as error:
                browser.tell("This did not work", " ".join(str(error).split()))
            except BaseException as error:  # one browser's trouble must not end its page
                if not browser.closed:
                    LOG.exception("a browser's request failed")
                    browser.tell("This did not work", f"{type(error).__name__}: {error}")

    def _build(self) -> None:
        browser = self.browser
        gui = browser.client.gui
        with browser.client.atomic():
            gui.set_panel_label("pemviz")
            gui.main_panel.dock_left()
            gui.main_panel.set_width(COLUMN_PX)
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
        self.analysis.fit()
        self.player.window.fit()

    def _turn(self) -> None:
        work = self.browser.next_work(pause_s=FRAME_S if self.player.playing else REFRESH_S)
        if self.browser.closed:
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
        browser = self.browser
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
            self.compare.refresh(run)
            self.recordings.refresh(state)


class App:
    """The server and its sessions.

    Attributes:
        server: viser's server.
    """

    def __init__(self, hub: Hub, *, host: str, port: int) -> None:
        """Start serving.

        Raises:
            InputError: The address cannot be bound.
        """
        self._hub = hub
        self._sessions: dict[int, Session] = {}
        self._tokens: dict[int, str] = {}
        self._lock = threading.Lock()
        runs = RunsPlace(hub)
        requests = {
            **runs.requests,
            **RunPlace(runs.run).requests,
            **NewRunPlace(hub, runs.run).requests,
            "stop": self._stop,
        }
        self._site = OwnPages(
            requests,
            version=lambda: hub.controller.state.version,
            state=lambda: shared_state(hub.controller.state),
            download=runs.download,
        )
        self.server = server = guarded_server(host=host, port=port, site=self._site)
        look_from_first_view(server)
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    @property
    def port(self) -> int:
        """The port bound."""
        return self.server.get_port()

    def stop(self) -> None:
        """End all sessions and the server."""
        with self._lock:
            sessions = list(self._sessions.values())
            self._sessions.clear()
        for session in sessions:
            session.browser.close()
        self.server.stop()

    def _stop(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        self._hub.controller.stop()
        return True

    def _connect(self, client: viser.ClientHandle) -> None:
        token = scene_of(self.server, client)
        if token != FORM:
            self._tokens[client.client_id] = token
            self._site.connect_scene(token, client)
            return
        session = Session(client, self._hub)
        with self._lock:
            self._sessions[client.client_id] = session
        session.thread.start()

    def _disconnect(self, client: viser.ClientHandle) -> None:
        token = self._tokens.pop(client.client_id, None)
        if token is not None:
            self._site.disconnect_scene(token, client)
            return
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.browser.close()
            session.thread.join(10.0)
            del session
            give_back()


def shared_state(state: PanelState) -> Json:
    """What all pages are told: the run that is shown, and how far the one under way is."""
    run, progress = state.run, state.progress
    return {
        "running": state.running,
        "stopping": state.stopping,
        "error": state.error,
        "words": status_words(state),
        "share": None if progress is None else progress.share,
        "run": None if run is None else run.name,
        "kept": 0 if run is None else run.kept,
        "summary": None if run is None else summary(run.result, running=run.running),
        "finished": state.finished_runs,
    }


def show_something(controller: Controller, recordings: RecordingsFolder) -> None:
    """Show the shipped sample, else the newest readable run, else a quick look that is not kept."""
    sample = sample_run()
    shipped = [] if sample is None else [sample]
    for folder in (*shipped, *(recordings.root / name for name in recordings.names())):
        try:
            controller.show(load_run(folder))
        except InputError as error:
            LOG.warning("%s", error)
        else:
            return
    quick = replace(load_preset("paper"), method="naive", final_rollouts=QUICK_ROLLOUTS, plan=False)
    controller.start(quick, keep=False)
