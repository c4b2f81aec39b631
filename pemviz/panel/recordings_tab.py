"""The Recordings tab: runs that are kept; loading, settings, notes, downloads, deleting."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from pathlib import Path

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.panel.browser import Browser
from pemviz.panel.controller import PanelState
from pemviz.panel.page import block, number, quiet
from pemviz.panel.ranking import rank, ranking_csv
from pemviz.panel.recordings_folder import RunEntry, read_listed
from pemviz.panel.rollout_player import Player
from pemviz.panel.run_data import RunData
from pemviz.panel.scene import scene_html
from pemviz.reports.html import warning

MOST_COMPLAINTS = 10
TABLE_PX = 260
SHOWN_NOTES = 120
ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
HEADER = ("run, notes", "method", "P(violation)", "sampling reliable?", "status")
NONE = "no runs yet"
SETTINGS_HINT = "Fill the Experiment tab with the settings of the run chosen; nothing is run yet."
NOTES_HINT = "Kept in the run's folder as notes.txt, and shown in the table below."
DELETE_HINT = "Delete the folder of the run chosen for good; asks first."
DOWNLOAD_HINT = (
    "Of the run chosen: its recording, its result, its ranking as a table. Of the rollout shown: "
    "a page that plays the scene without a server."
)
DOWNLOADS = ("run.rrd", "result.json", "CSV", "3D scene (HTML)")


def recordings_table(
    entries: Sequence[RunEntry], *, folder: str, damaged: Sequence[str] = ()
) -> str:
    """One line a run, then what is wrong with those that cannot be read."""
    complaints = "".join(warning(words) for words in damaged[:MOST_COMPLAINTS])
    if len(damaged) > MOST_COMPLAINTS:
        complaints += warning(f"and {len(damaged) - MOST_COMPLAINTS} more damaged runs")
    if not entries:
        words = f"There are no runs in {folder} yet. Press Run in the Experiment tab."
        return block(complaints + quiet(words))
    lines: list[str] = []
    for entry in entries:
        notes, verdict = " ".join(entry.notes.split()), "\N{CHECK MARK} yes"
        if notes:  # the first words; all of them where the pointer rests
            short = notes if len(notes) <= SHOWN_NOTES else notes[: SHOWN_NOTES - 1] + ELLIPSIS
            notes = f"<br><i title='{escape(notes, quote=True)}'>{escape(short)}</i>"
        if entry.probability is None:
            verdict = "no estimate"
        elif entry.unreliable:
            reasons = escape("; ".join(entry.unreliable), quote=True)
            verdict = f"<span title='{reasons}'>\N{WARNING SIGN} unreliable</span>"
        values = (
            f"{escape(entry.name)}{notes}",
            f"{escape(entry.method)}<br>{escape(entry.metric)}<br>seed {entry.seed}",
            number(entry.probability),
            verdict,
            escape(entry.status) + ("" if entry.has_recording else "<br>no .rrd"),
        )
        lines.append(f"<tr>{''.join(f'<td>{value}</td>' for value in values)}</tr>")
    heads = "".join(f"<th>{head}</th>" for head in HEADER)
    table = (
        f"<div style='max-height:{TABLE_PX}px;overflow-y:auto'><table aria-label='Recordings'>"
        f"<thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )
    return block(table + complaints + quiet(f"Folder: {folder}"))


def delete_question(name: str) -> str:
    """What is lost if a run is deleted."""
    words = "Its result, rollouts, recording and notes are deleted. Nothing brings them back."
    return block(f"<b>{escape(name)}</b>" + quiet(words))


def viewer_link(address: str, *, name: str) -> str:
    """A link to the viewer, opened in a new tab."""
    return block(
        f"<a href='{escape(address, quote=True)}' target='_blank' rel='noopener'>"
        f"Open {escape(name)} in rerun's viewer (new tab)</a>"
    )


class RecordingsTab:
    """This browser's choice of a run."""

    def __init__(
        self,
        browser: Browser,
        player: Player,
        *,
        use_settings: Callable[[ExperimentConfig], None],
        list_runs: Callable[[tuple[str, ...]], None],
    ) -> None:
        """Build it; ``use_settings`` fills the Experiment tab, ``list_runs`` is told new names."""
        self._browser = browser
        self._player = player
        self._use_settings = use_settings
        self._list_runs = list_runs
        self._moment = (-1, False)
        self._seen: object = None
        self._opening: Path | None = None
        gui = browser.client.gui
        self.name = gui.add_dropdown("Run", list[str]([NONE]), initial_value=NONE,
            hint="A run of the recordings folder, newest first.")  # fmt: skip
        self.load = gui.add_button("Load", hint="Show this run here; other browsers keep theirs.")
        self.back = gui.add_button("Back to the latest run", visible=False, color="gray",
            hint="Show the run that was started last, or is under way.")  # fmt: skip
        self.settings = gui.add_button("Use this run's settings", color="gray", hint=SETTINGS_HINT)
        self._table = gui.add_html("")
        self.download = gui.add_button_group("Download", DOWNLOADS, hint=DOWNLOAD_HINT)
        self.viewer = gui.add_button("Open in rerun", color="gray",
            visible=browser.hub.open_recording is not None,
            hint="Serve this run's recording to rerun's viewer in the browser.")  # fmt: skip
        self._link = gui.add_html("")
        self.load.on_click(browser.on(self._load))
        self.back.on_click(browser.on(self._back))
        self.settings.on_click(browser.on(self._settings))
        self.download.on_click(browser.on(self._download))
        self.viewer.on_click(browser.on(self._open))
        self.notes = gui.add_text("Notes", "", multiline=True, hint=NOTES_HINT)
        self.save = gui.add_button("Save notes", color="gray", hint=NOTES_HINT)
        self.delete = gui.add_button("Delete", color="red", hint=DELETE_HINT)
        self.save.on_click(browser.on(self._save))
        self.delete.on_click(browser.on(self._confirm_deletion))
        self.name.on_update(browser.on(self._chosen))

    def refresh(self, state: PanelState) -> None:
        """List the folder anew when a run began or ended."""
        self.back.visible = self._browser.loaded is not None
        self._moment = (state.finished_runs, state.running)
        self.look()

    def look(self) -> None:
        """List the folder anew if its runs are others, or one began or ended."""
        seen = (self._moment, tuple(self._browser.hub.recordings.names()))
        if seen != self._seen:
            self._seen = seen
            self._list()

    def _list(self) -> None:
        folder = self._browser.hub.recordings
        entries = folder.entries()
        names = tuple(entry.name for entry in entries) or (NONE,)
        if tuple(self.name.options) != names:
            before = self.name.value
            self.name.options = names
            self.name.value = before if before in names else names[0]
            if self.name.value != before:  # what somebody types beside it stays
                self._chosen()
            self._list_runs(tuple(entry.name for entry in entries))
        damaged = folder.damaged()
        table = recordings_table(entries, folder=str(folder.root), damaged=damaged)
        self._table.content = table

    def _chosen(self) -> None:
        self._clear_link()
        self.notes.value = self._browser.hub.recordings.notes(self.name.value)

    def _load(self) -> None:
        """Read the run on a thread of its own, and show it unless another is asked for."""
        browser, hub, name = self._browser, self._browser.hub, self.name.value
        folder = hub.recordings.folder(name)
        self._opening = folder

        def read() -> RunData:
            run = hub.loaded.get(folder)
            if run.parts:
                _ = run.log_weight  # so that what follows needs no wait
            return run

        def show(run: RunData) -> None:
            if self._opening == folder:
                self._opening = None
                browser.look_at(run)
                if run.mapped:
                    look = partial(hub.loaded.disagreement, folder)
                    browser.beside(look, partial(self._held_to_files, run))

        self._link.content = block(quiet(f"Opening {escape(name)} ..."))
        browser.beside(read, show, ended=self._clear_link)

    def _clear_link(self) -> None:
        self._link.content = ""

    def _held_to_files(self, run: RunData, wrong: InputError | None) -> None:
        """Say what large files contradict, and show the run no longer."""
        if wrong is not None:
            if self._browser.loaded is run:
                self._browser.look_at(None)
            raise wrong

    def _back(self) -> None:
        self._opening = None
        self._browser.look_at(None)

    def _settings(self) -> None:
        name = self.name.value
        self._use_settings(read_listed(self._browser.hub.recordings.folder(name)).config)
        self._browser.tell("Settings taken over", f"The Experiment tab has those of {name}.",
            color="blue")  # fmt: skip

    def _save(self) -> None:
        self._browser.hub.recordings.note(self.name.value, self.notes.value)
        self._list()
        self._browser.tell("Notes", f"Kept with {self.name.value}.", color="blue")

    def _confirm_deletion(self) -> None:
        name, browser = self.name.value, self._browser
        browser.hub.recordings.folder(name)
        dialog = browser.client.gui.add_modal("Delete a run")
        with dialog:
            browser.client.gui.add_html(delete_question(name))
            yes = browser.client.gui.add_button("Delete it for good", color="red")
            no = browser.client.gui.add_button("Keep it", color="gray")

        def delete() -> None:
            dialog.close()
            self._delete(name)

        yes.on_click(browser.on(delete))
        no.on_click(browser.on(dialog.close))

    def _delete(self, name: str) -> None:
        hub = self._browser.hub
        state = hub.controller.state
        if state.running and state.run is not None and state.run.name == name:
            message = f"run {name}: is under way; stop it first"
            raise InputError(message)
        hub.recordings.delete(name)
        self._list()
        self._browser.tell("Deleted", name, color="blue")

    def _download(self) -> None:
        browser, word, name = self._browser, self.download.value, self.name.value
        hub = browser.hub
        if word == "CSV":
            folder = hub.recordings.folder(name)
            browser.tell("CSV", f"The ranking of {name} is being written.", color="blue")

            def ranked() -> bytes:
                run = hub.loaded.get(folder)
                return ranking_csv(run, rank(run, run.config.metric)).encode()

            browser.beside(ranked, partial(self._send, f"{name}.csv"))
        elif word == "run.rrd":
            self._send(f"{name}.rrd", hub.recordings.content(name, "run.rrd"))
        elif word == "result.json":
            self._send(f"{name}.json", hub.recordings.content(name, "result.json"))
        elif self._player.track is None:
            message = "no rollout is shown: pick one in the Trajectories tab"
            raise InputError(message)
        else:
            self._send("pemviz-rollout.html", scene_html(self._player.track.drawn).encode())

    def _send(self, filename: str, content: bytes) -> None:
        self._browser.client.send_file_download(filename, content, save_immediately=True)

    def _open(self) -> None:
        opener = self._browser.hub.open_recording
        if opener is None:
            return
        path = self._browser.hub.recordings.file(self.name.value, "run.rrd")
        self._link.content = viewer_link(opener(path), name=self.name.value)
