"""A run as JUnit XML: one test case, the gate."""

from xml.etree import ElementTree as Xml

from pemviz.reports.document import Caution, Headline, Table
from pemviz.reports.escape import printable_line, printable_lines
from pemviz.reports.gate import GateDecision
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines
from pemviz.runs.result import RunResult

DECLARATION = '<?xml version="1.0" encoding="UTF-8"?>'


def junit_xml(result: RunResult, *, gate: GateDecision | None = None) -> str:
    """A document with one test case that fails when the gate tripped.

    An undecided gate and a run that did not finish are errors: a pipeline never takes them
    for a pass.

    Args:
        result: The run.
        gate: The gate's decision; without a gate the case passes once the run is done.
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
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, encoding="unicode") + "\n"
    )


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
    """What was found, a line each, and every warning."""
    said = run_document(result).blocks("answer", "robustness", "warnings", "extrapolation")
    told = plain_lines(one for one in said if isinstance(one, Headline | Table | Caution))
    lines = [f"run {result.run_id}, status {result.status}", *told]
    return [printable_lines(line) for line in lines]
