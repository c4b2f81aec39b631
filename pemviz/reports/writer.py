"""The observer that writes a run's reports at its end, whatever that end is."""

import os
from pathlib import Path

from pemviz.config.rule_words import GateLimits
from pemviz.errors import ConfigError, RunError
from pemviz.files.atomic import is_folder, write_text
from pemviz.reports.gate import decide_limits
from pemviz.reports.junit import junit_xml
from pemviz.reports.markdown import summary_markdown
from pemviz.runs.events import Event, RunDone, RunFailed
from pemviz.runs.result import RunResult


class ReportWriter:
    """Writes the summary page and the JUnit file when a run is done, stopped or failed.

    The summary is added to the end of its file, as the summary page of a pipeline's job is
    shared by all its steps; the JUnit file is written anew, whole or not at all.
    """

    def __init__(
        self,
        *,
        summary: Path | None = None,
        junit: Path | None = None,
        limits: GateLimits | None = None,
    ) -> None:
        """Check the places; nothing is written yet.

        Args:
            summary: Markdown file.
            junit: XML file.
            limits: The gate's, if there is a gate.

        Raises:
            ConfigError: A file cannot be written there.
        """
        for name, path in (("summary", summary), ("junit", junit)):
            if path is not None:
                _check_place(name, path)
        self._summary = summary
        self._junit = junit
        self._limits = GateLimits() if limits is None else limits

    def notify(self, event: Event) -> None:
        """Write at the end of a run.

        Raises:
            RunError: A file cannot be written.
        """
        if isinstance(event, RunDone | RunFailed):
            self.write(event.result)

    def write(self, result: RunResult) -> None:
        """Write what was asked for, of a run that has come to its end.

        Raises:
            RunError: A file cannot be written.
        """
        try:
            self._write(result)
        except OSError as error:
            message = f"the reports cannot be written ({error})"
            raise RunError(message) from error

    def _write(self, result: RunResult) -> None:
        gate = decide_limits(result, limits=self._limits)
        if self._summary is not None:
            with self._summary.open("a", encoding="utf-8") as stream:
                stream.write(summary_markdown(result, gate=gate))
        if self._junit is not None:
            write_text(self._junit, junit_xml(result, gate=gate))


def _check_place(name: str, path: Path) -> None:
    folder = path.parent
    if is_folder(path):
        raise ConfigError(f"{name} = {path}: must be a file, is a folder")
    if not is_folder(folder):
        raise ConfigError(f"{name} = {path}: must lie in a folder that exists")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"{name} = {path}: cannot be written there")
