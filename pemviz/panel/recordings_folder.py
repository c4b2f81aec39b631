"""The folder of kept runs: safe access to it by name, and viewers of its recordings."""

import shutil
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pemviz.errors import InputError
from pemviz.files.atomic import write_text
from pemviz.panel.run_summary import summary
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result_file import RESULT_FILE, has_result
from pemviz.runs.run_folder import run_lock

FileName = Literal["run.rrd", "result.json", "rollouts.npz", "config.toml"]
LARGEST_DOWNLOAD_BYTES = 512 * 1024 * 1024
LISTED_BYTES = 16_000_000
"""A listed run's result is held to files up to this size; to larger ones when it is opened."""
NOTES_FILE = "notes.txt"
MOST_NOTED = 20_000
"""Characters of a run's notes."""


@dataclass(frozen=True)
class RunEntry:
    """A line of the list of runs.

    Attributes:
        summary: Its line in the table of runs, see :mod:`pemviz.panel.run_summary`.
    """

    name: str
    has_recording: bool
    summary: Mapping[str, Any]
    notes: str = ""


class RecordingsFolder:
    """Runs by name below ``root``, which need not exist; no name reaches outside it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._entries: dict[str, tuple[float, RunEntry | str]] = {}

    def entries(self) -> list[RunEntry]:
        """All readable runs, newest first (the names start with the time)."""
        found = [self._entry(name) for name in self.names()]
        readable = [one for one in found if isinstance(one, RunEntry)]
        return [replace(one, notes=self.notes(one.name)) for one in readable]

    def damaged(self) -> list[str]:
        """What is wrong with the runs that cannot be read, one line each."""
        found = [self._entry(name) for name in self.names()]
        return [one for one in found if isinstance(one, str)]

    def names(self) -> list[str]:
        """Names of run folders, newest first; not links, which lead elsewhere, nor hidden ones."""
        try:
            folders = list(self.root.iterdir())
        except OSError:
            return []
        return sorted(
            (f.name for f in folders if f.name[0] != "." and not f.is_symlink() and has_result(f)),
            reverse=True,
        )

    def folder(self, name: str) -> Path:
        """The folder of the run ``name``.

        Raises:
            InputError: There is no run of this name; nothing but a listed name is accepted.
        """
        if name not in self.names():
            message = f"run {name[:80]!r}: is not in the recordings folder {self.root}"
            raise InputError(message)
        return self.root / name

    def file(self, name: str, file: FileName) -> Path:
        """A file of the run ``name``.

        Raises:
            InputError: There is no such run or file, or it leads out of the run's folder.
        """
        folder = self.folder(name)
        path = folder / file
        if path.is_symlink() or not path.is_file():
            message = f"run {name}: has no {file}"
            raise InputError(message)
        return path

    def content(self, name: str, file: FileName) -> bytes:
        """A file's bytes.

        Raises:
            InputError: As for :meth:`file`; or it is too large to pass through the browser.
        """
        path = self.file(name, file)
        if path.stat().st_size > LARGEST_DOWNLOAD_BYTES:
            message = f"run {name}: {file} is larger than 512 MB; copy it from {path}"
            raise InputError(message)
        return path.read_bytes()

    def notes(self, name: str) -> str:
        """What was noted about the run ``name``; empty if nothing was, or it cannot be read."""
        path = self.root / name / NOTES_FILE
        try:
            if path.is_symlink() or path.stat().st_size > 4 * MOST_NOTED:
                return ""
            return path.read_text(encoding="utf-8", errors="replace")[:MOST_NOTED]
        except OSError:
            return ""

    def note(self, name: str, text: str) -> None:
        """Keep notes in the run's folder; an empty text takes them away.

        Raises:
            InputError: There is no such run, the text is too long, or it cannot be written.
        """
        path = self.folder(name) / NOTES_FILE
        if len(text) > MOST_NOTED:
            message = f"notes: {len(text):,} characters, must be at most {MOST_NOTED:,}"
            raise InputError(message)
        try:
            if text.strip():
                write_text(path, text)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            message = f"run {name}: notes cannot be written ({error.strerror or error})"
            raise InputError(message) from error

    def set_aside(self, name: str) -> None:
        """Take a run out of the list; :meth:`put_back` brings it back, :meth:`forget` deletes it.

        Raises:
            InputError: There is no such run, or somebody is at work in it.
        """
        folder = self.folder(name)
        try:
            with run_lock(folder):
                folder.rename(self._aside(name))
        except OSError as error:
            message = f"run {name}: cannot be deleted ({error.strerror or error})"
            raise InputError(message) from error

    def put_back(self, name: str) -> None:
        """Bring back a run that was set aside.

        Raises:
            InputError: There is none, or another has its name by now.
        """
        try:
            self._aside(name).rename(self.root / name)
        except OSError as error:
            message = f"run {name[:80]!r}: cannot be brought back ({error.strerror or error})"
            raise InputError(message) from error

    def forget(self) -> None:
        """Delete for good what was set aside."""
        for folder in self.root.glob(".*.deleted"):
            shutil.rmtree(folder, ignore_errors=True)

    def _aside(self, name: str) -> Path:
        if Path(name).name != name or name[:1] in ("", "."):
            message = f"run {name[:80]!r}: is no name of a run"
            raise InputError(message)
        return self.root / f".{name}.deleted"

    def _entry(self, name: str) -> RunEntry | str:
        """The run's line, or what is wrong with it."""
        folder = self.root / name
        try:
            changed_s = (folder / RESULT_FILE).stat().st_mtime
        except OSError as error:
            return f"run {name}: cannot be read ({error.strerror or error})"
        cached = self._entries.get(name)
        if cached is not None and cached[0] == changed_s:
            return cached[1]
        try:
            result = read_whole_run(folder, most_bytes=LISTED_BYTES)
        except InputError as error:
            entry = str(error)
        else:
            entry = RunEntry(
                name=name,
                has_recording=(folder / "run.rrd").is_file(),
                summary=summary(result),
            )
        self._entries[name] = (changed_s, entry)
        return entry


class Viewers:
    """Opens a viewer for a recording once, and closes the oldest when there are too many."""

    def __init__(
        self, viewer: Callable[[Path], AbstractContextManager[str]], *, limit: int = 4
    ) -> None:
        """``viewer`` serves a recording until left, and gives its address."""
        self._viewer = viewer
        self._limit = limit
        self._lock = threading.Lock()
        self._open: dict[Path, tuple[str, ExitStack]] = {}

    def open(self, path: Path) -> str:
        """The address of a page that shows the recording."""
        with self._lock:
            if path not in self._open:
                stack = ExitStack()
                address = stack.enter_context(self._viewer(path))
                self._open[path] = (address, stack)
                while len(self._open) > self._limit:
                    self._open.pop(next(iter(self._open)))[1].close()
            return self._open[path][0]

    def close(self) -> None:
        """Close all viewers."""
        with self._lock:
            for _, stack in self._open.values():
                stack.close()
            self._open.clear()
