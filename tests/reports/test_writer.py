import json
import xml.etree.ElementTree as Xml

import pytest

from pemviz.cli.main import main
from pemviz.errors import ConfigError, RunError
from pemviz.reports.pipeline import ReportWriter
from pemviz.runs.events import RunDone
from tests.reports.runs import result

QUICK = ["--no-plan", "--final-rollouts", "200", "--no-recording", "--json"]


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
