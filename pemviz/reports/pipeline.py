"""What a pipeline reads of a run: JUnit XML, and the observer that writes it and the summary."""

import os
from pathlib import Path
from xml.etree import ElementTree as Xml

from pemviz.config.rule_words import GateLimits
from pemviz.errors import ConfigError, RunError
from pemviz.files.atomic import is_folder, write_text
from pemviz.reports.document import Caution, Headline, Table
from pemviz.reports.escape import printable_line, printable_lines
from pemviz.reports.gate import GateDecision, decide_limits
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines
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
        gate = decide_limits(result, limits=self._limits)
        try:
            if self._summary is not None:
                with self._summary.open("a", encoding="utf-8") as stream:
                    stream.write(summary_markdown(result, gate=gate))
            if self._junit is not None:
                write_text(self._junit, junit_xml(result, gate=gate))
        except OSError as error:
            message = f"the reports cannot be written ({error})"
            raise RunError(message) from error


def _check_place(name: str, path: Path) -> None:
    folder = path.parent
    if is_folder(path):
        raise ConfigError(f"{name} = {path}: must be a file, is a folder")
    if not is_folder(folder):
        raise ConfigError(f"{name} = {path}: must lie in a folder that exists")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"{name} = {path}: cannot be written there")


def junit_xml(result: RunResult, *, gate: GateDecision | None = None) -> str:
    """A document with one test case that fails when the gate tripped.

    An undecided gate and a run that did not finish are errors: a pipeline never takes them
    for a pass. Without a gate the case passes once the run is done.
    """
    failed = gate is not None and gate.outcome == "tripped"
    broken = result.status != "done" or (gate is not None and gate.outcome == "undecided")
    time_s = f"{result.timings_s.get('total', 0.0):.3f}"
    counts = {
        "tests": "1",
        "failures": str(int(failed and not broken)),
        "errors": str(int(broken)),
        "skipped": "0",
        "time": time_s,
    }
    root = Xml.Element("testsuites", {"name": "pemviz", **counts})
    suite = Xml.SubElement(root, "testsuite", {"name": "pemviz record", **counts})
    _add_properties(suite, result)
    attributes = {"classname": "pemviz.record", "name": _case_name(result, gate), "time": time_s}
    case = Xml.SubElement(suite, "testcase", attributes)
    if broken or failed:
        _add_complaint(case, result, gate, broken=broken)
    Xml.SubElement(case, "system-out").text = "\n".join(_facts(result))
    Xml.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{Xml.tostring(root, encoding="unicode")}\n'


def _case_name(result: RunResult, gate: GateDecision | None) -> str:
    spec = printable_line(result.config.spec)
    if gate is None:
        return f"the failure probability of {spec} can be estimated"
    if gate.limit is None:
        return f"the failure probabilities of the rules in {spec} are at most their limits"
    return f"the failure probability of {spec} is at most {gate.limit:g}"


def _add_properties(suite: Xml.Element, result: RunResult) -> None:
    values = {
        "run_id": result.run_id,
        "method": result.config.method,
        "metric": result.config.metric,
        "seed": str(result.config.seed),
        "pem": result.pem.name,
        "pem_digest": result.pem.digest,
        "pem_data": result.pem.data,
        **{f"version.{name}": version for name, version in result.versions.items()},
    }
    properties = Xml.SubElement(suite, "properties")
    for name, value in values.items():
        Xml.SubElement(properties, "property", {"name": name, "value": printable_line(value)})


def _add_complaint(
    case: Xml.Element, result: RunResult, gate: GateDecision | None, *, broken: bool
) -> None:
    if result.status != "done":
        kind, message = f"run {result.status}", result.message or "the run did not finish"
    elif gate is not None:
        kind, message = f"gate {gate.outcome}", f"gate {gate.sentence}"
    else:
        return
    attributes = {"type": kind, "message": printable_line(message)}
    complaint = Xml.SubElement(case, "error" if broken else "failure", attributes)
    complaint.text = "\n".join([printable_line(message), *_facts(result)])


def _facts(result: RunResult) -> list[str]:
    said = run_document(result).blocks("answer", "robustness", "warnings", "extrapolation")
    printed = plain_lines(one for one in said if isinstance(one, Headline | Table | Caution))
    lines = [f"run {result.run_id}, status {result.status}", *printed]
    return [printable_lines(line) for line in lines]
