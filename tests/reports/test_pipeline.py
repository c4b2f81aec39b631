"""What a pipeline reads: JUnit XML, the summary page, and where they may lie."""

import json
from xml.etree import ElementTree as Xml

import pytest

from pemviz.cli.main import main
from pemviz.errors import ConfigError, RunError
from pemviz.reports.gate import decide_gate, decide_run
from pemviz.reports.pipeline import ReportWriter, junit_xml
from pemviz.runs.events import RunDone
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


QUICK = ["--no-plan", "--no-measured-memory", "--final-rollouts", "200", "--no-recording", "--json"]


def record(tmp_path, *words):
    places = ["--summary", str(tmp_path / "page.md"), "--junit", str(tmp_path / "gate.xml")]
    return main(["record", "--out", str(tmp_path / "runs"), *QUICK, *places, *words])


@pytest.mark.parametrize(
    ("words", "code", "tags", "mark"),
    [
        (["--method", "monte-carlo", "--fail-above", "0.9"], 0, set(), "✅"),
        (["--method", "monte-carlo", "--fail-above", "1e-6"], 1, {"failure"}, "❌"),
        (["--method", "naive", "--fail-above", "1e-9"], 4, {"error"}, "⚠️"),
    ],
)
def test_record_writes_both_reports(tmp_path, capsys, words, code, tags, mark):
    assert record(tmp_path, *words) == code
    json.loads(capsys.readouterr().out)
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert page.startswith("## pemviz: failure probability")
    assert f"{mark} **Gate" in page
    root = Xml.parse(tmp_path / "gate.xml").getroot()  # noqa: S314  our own file
    assert {e.tag for e in root.iter() if e.tag in ("failure", "error")} == tags


def test_a_second_run_is_added_to_the_page(tmp_path, capsys):
    (tmp_path / "page.md").write_text("from an earlier step\n\n")
    for _ in range(2):
        record(tmp_path, "--method", "naive")
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert page.startswith("from an earlier step\n\n## pemviz")
    assert page.count("## pemviz: ") == 2
    assert Xml.parse(tmp_path / "gate.xml").getroot().attrib["tests"] == "1"  # noqa: S314


@pytest.mark.parametrize("option", ["--summary", "--junit"])
@pytest.mark.parametrize("place", ["nowhere/file", "."])
def test_a_place_that_cannot_be_written_is_bad_input(tmp_path, capsys, option, place):
    assert record(tmp_path, option, str(tmp_path / place)) == 2
    shown = capsys.readouterr()
    assert option[2:] in shown.err
    assert shown.err.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_place_that_goes_away_fails_the_run_in_one_line(tmp_path):
    folder = tmp_path / "there"
    folder.mkdir()
    writer = ReportWriter(junit=folder / "gate.xml")
    folder.rmdir()
    with pytest.raises(RunError, match="reports cannot be written"):
        writer.notify(RunDone(result=result()))


def test_a_folder_in_place_of_a_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="is a folder"):
        ReportWriter(summary=tmp_path)
