from xml.etree import ElementTree as Xml

import pytest

from pemviz.reports.gate import decide_gate, decide_run
from pemviz.reports.pipeline import junit_xml
from tests.reports.runs import estimate, nasty_result, result, warned

FEW = warned("a few weights carry it", "few-effective-samples", 3.0)


def case_of(text):
    root = Xml.fromstring(text)  # noqa: S314  our own text
    (suite,) = root.findall("testsuite")
    (case,) = suite.findall("testcase")
    for counts in (root.attrib, suite.attrib):
        assert counts["tests"] == "1"
        assert counts["failures"] == str(len(case.findall("failure")))
        assert counts["errors"] == str(len(case.findall("error")))
    return case


@pytest.mark.parametrize(
    ("one", "limit", "outcome", "tag"),
    [
        (estimate(method="mixture"), 1e-9, "passed", None),
        (estimate(), 4e-15, "tripped", "failure"),
        (estimate(diagnostics=(FEW,)), 1e-9, "undecided", "error"),
        (estimate(failures=0, ci_high=None), 1e-9, "undecided", "error"),
    ],
)
def test_the_case_is_the_gate(one, limit, outcome, tag):
    gate = decide_gate(one, limit=limit)
    assert gate.outcome == outcome
    case = case_of(junit_xml(result(one), gate=gate))
    complaints = [child for child in case if child.tag in ("failure", "error")]
    assert [child.tag for child in complaints] == ([] if tag is None else [tag])
    if tag is not None:
        assert gate.reason in complaints[0].attrib["message"]
    assert f"{limit:g}" in case.attrib["name"]


@pytest.mark.parametrize("status", ["stopped", "failed"])
@pytest.mark.parametrize("limit", [None, 1e-9])
def test_a_run_that_did_not_finish_is_an_error(status, limit):
    broken = result(status=status, message="the disk is full")
    gate = None if limit is None else decide_run(broken, limit=limit)
    (complaint,) = case_of(junit_xml(broken, gate=gate)).findall("error")
    assert complaint.attrib["message"] == "the disk is full"


def test_without_a_gate_a_finished_run_passes():
    assert [child.tag for child in case_of(junit_xml(result()))] == ["system-out"]


def test_nasty_text_stays_text():
    nasty = nasty_result()
    text = junit_xml(nasty, gate=decide_run(nasty, limit=1e-9))
    text.encode("utf-8")
    case = case_of(text)
    assert {child.tag for child in case} == {"error", "system-out"}
    assert "<script>alert(1)</script>" in case.attrib["name"]
    assert "]]>" in case.findtext("error", "")
