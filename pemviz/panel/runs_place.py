"""What the table of runs asks for: its rows, notes, deleting and bringing back, files."""

from collections.abc import Mapping
from typing import Any
from urllib.parse import unquote

from pemviz.errors import InputError
from pemviz.files.shipped import sample_run
from pemviz.panel.arguments import Arguments
from pemviz.panel.budgets import Budgets
from pemviz.panel.hub import Hub
from pemviz.panel.ranking import rank, ranking_csv
from pemviz.panel.run_data import RunData
from pemviz.panel.run_summary import summary
from pemviz.panel.site import Page, Request

MOST_RUNS = 1_000
HELD = 4
"""Runs that are kept in memory though no page asks for them at the moment."""
FILES = ("run.rrd", "result.json", "rollouts.npz", "config.toml")
RANKING = "ranking.csv"


class RunsPlace:
    """Runs by name: those kept, the shipped sample, and the one under way."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._held: dict[str, RunData] = {}
        self._budgets = Budgets(hub.recordings.root)

    @property
    def requests(self) -> Mapping[str, Request]:
        """What a page may ask for, by name."""
        return {
            "runs": self._runs,
            "budgets": lambda page, asked: self._budgets.rows(),  # noqa: ARG005
            "verify": self._verify,
            "note": self._note,
            "delete": self._delete,
            "put_back": self._put_back,
            "viewer": self._viewer,
        }

    def run(self, name: str) -> RunData:
        """A run by its name.

        Raises:
            InputError: There is none, or it cannot be read.
        """
        shared = self._hub.controller.state.run
        if shared is not None and shared.name == name:
            return shared
        sample = sample_run()
        is_sample = sample is not None and name == sample.name
        folder = sample if is_sample and sample else self._hub.recordings.folder(name)
        run = self._hub.loaded.get(folder)
        self._held.pop(name, None)
        self._held[name] = run
        while len(self._held) > HELD:
            self._held.pop(next(iter(self._held)))
        return run

    def download(self, address: str) -> tuple[str, bytes]:
        """A file of a run by ``RUN/FILE``: its name and its content.

        Raises:
            InputError: There is no such run or file.
        """
        name, _, file = unquote(address).partition("/")
        if file == RANKING:
            run = self.run(name)
            return f"{name}.csv", ranking_csv(run, rank(run, run.config.metric)).encode()
        for known in FILES:
            if file == known:
                return f"{name}-{file}", self._hub.recordings.content(name, known)
        message = f"{file[:40]!r}: must be one of {', '.join((*FILES, RANKING))}"
        raise InputError(message)

    def _runs(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The rows, newest first, and what is wrong with runs that cannot be read."""
        folder, state = self._hub.recordings, self._hub.controller.state
        rows = [
            {"name": entry.name, "note": entry.notes, "recording": entry.has_recording,
             "kept": True, **entry.summary}
            for entry in folder.entries()
        ]  # fmt: skip
        shared = state.run
        if shared is not None and (shared.running or shared.folder is None):
            on_disk = [row for row in rows if row["name"] == shared.name]
            rows = [row for row in rows if row["name"] != shared.name]
            line = summary(shared.result, running=shared.running)
            row = {"name": shared.name, "note": "", "recording": False, "kept": bool(on_disk)}
            rows.insert(0, row | {**line})
        sample = sample_run()
        if sample is not None and all(row["name"] != sample.name for row in rows):
            line = summary(self.run(sample.name).result)
            rows.append({"name": sample.name, "note": "shipped with pemviz", "recording": False,
                "kept": False, **line})  # fmt: skip
        return {"rows": rows, "damaged": folder.damaged(), "folder": str(folder.root)}

    def _verify(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """Hold a large run to all of its files, which takes some seconds.

        Raises:
            InputError: They contradict each other.
        """
        run = self.run(asked.text("run"))
        wrong = None
        if run.mapped and run.folder is not None:
            wrong = self._hub.loaded.disagreement(run.folder)
        if wrong is not None:
            self._held.pop(run.name, None)
            raise wrong
        return True

    def _note(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        self._hub.recordings.note(asked.text("run"), asked.text("text"))
        return True

    def _delete(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        state, names = self._hub.controller.state, asked.texts("runs", MOST_RUNS)
        under_way = state.run.name if state.running and state.run is not None else None
        if under_way in names:
            message = f"run {under_way}: is under way; stop it first"
            raise InputError(message)
        self._hub.recordings.forget()
        for name in names:
            self._hub.recordings.set_aside(name)
        return True

    def _put_back(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        for name in asked.texts("runs", MOST_RUNS):
            self._hub.recordings.put_back(name)
        return True

    def _viewer(self, page: Page, asked: Arguments) -> Any:  # noqa: ARG002
        """The address of a page of rerun's that shows a run's recording."""
        opener = self._hub.open_recording
        if opener is None:
            message = "rerun's viewer serves this machine alone: download run.rrd instead"
            raise InputError(message)
        return opener(self._hub.recordings.file(asked.text("run"), "run.rrd"))
