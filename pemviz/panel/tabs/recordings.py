"""The Recordings tab: runs that are kept, loading, downloads."""

from pemviz.errors import InputError
from pemviz.panel.browser import Browser, set_html
from pemviz.panel.controller import PanelState
from pemviz.panel.ranking import rank, ranking_csv
from pemviz.panel.scene import scene_html
from pemviz.panel.tabs.player import Player
from pemviz.panel.views.recordings import recordings_table, viewer_link

NONE = "no runs yet"
DOWNLOAD_HINT = (
    "Of the run chosen: its recording, its result, its ranking as a table. Of the rollout shown: "
    "a page that plays the scene without a server."
)
DOWNLOADS = ("run.rrd", "result.json", "CSV", "3D scene (HTML)")


class RecordingsTab:
    """This browser's choice of a run."""

    def __init__(self, browser: Browser, player: Player) -> None:
        self._browser = browser
        self._player = player
        self._finished = -1
        self._running = False
        gui = browser.client.gui
        self.name = gui.add_dropdown("Run", list[str]([NONE]), initial_value=NONE,
            hint="A run of the recordings folder, newest first.")  # fmt: skip
        self.load = gui.add_button("Load", hint="Show this run here; other browsers keep theirs.")
        self.back = gui.add_button("Back to the latest run", visible=False, color="gray",
            hint="Show the run that was started last, or is under way.")  # fmt: skip
        self.download = gui.add_button_group("Download", DOWNLOADS,
            hint=DOWNLOAD_HINT)  # fmt: skip
        self.viewer = gui.add_button("Open in rerun", color="gray",
            visible=browser.hub.open_recording is not None,
            hint="Serve this run's recording to rerun's viewer in the browser.")  # fmt: skip
        self._link = gui.add_html("")
        self._table = gui.add_html("")
        self.load.on_click(browser.on(self._load))
        self.back.on_click(browser.on(self._back))
        self.download.on_click(browser.on(self._download))
        self.viewer.on_click(browser.on(self._open))
        self.name.on_update(browser.on(lambda: set_html(self._link, "")))

    def refresh(self, state: PanelState) -> None:
        """List the folder anew when a run began or ended."""
        if self.back.visible != (self._browser.loaded is not None):
            self.back.visible = self._browser.loaded is not None
        if (state.finished_runs, state.running) == (self._finished, self._running):
            return
        self._finished, self._running = state.finished_runs, state.running
        folder = self._browser.hub.recordings
        entries = folder.entries()
        names = tuple(entry.name for entry in entries) or (NONE,)
        if tuple(self.name.options) != names:
            self.name.options = names
        damaged = folder.damaged()
        table = recordings_table(entries, folder=str(folder.root), damaged=damaged)
        set_html(self._table, table)

    def _load(self) -> None:
        hub = self._browser.hub
        self._browser.look_at(hub.loaded.get(hub.recordings.folder(self.name.value)))

    def _back(self) -> None:
        self._browser.look_at(None)

    def _download(self) -> None:
        filename, content = self._downloaded(self.download.value, self.name.value)
        self._browser.client.send_file_download(filename, content, save_immediately=True)

    def _downloaded(self, word: str, name: str) -> tuple[str, bytes]:
        """File name and content of a download."""
        folder = self._browser.hub.recordings
        if word == "run.rrd":
            return f"{name}.rrd", folder.content(name, "run.rrd")
        if word == "result.json":
            return f"{name}.json", folder.content(name, "result.json")
        if word == "CSV":
            run = self._browser.hub.loaded.get(folder.folder(name))
            return f"{name}.csv", ranking_csv(run, rank(run, run.config.metric)).encode()
        chosen = self._player.track
        if chosen is None:
            message = "no rollout is shown: pick one in the Trajectories tab"
            raise InputError(message)
        return "pemviz-rollout.html", scene_html(chosen).encode()

    def _open(self) -> None:
        opener = self._browser.hub.open_recording
        if opener is None:
            return
        path = self._browser.hub.recordings.file(self.name.value, "run.rrd")
        set_html(self._link, viewer_link(opener(path), name=self.name.value))
