"""The page of a risk budget: whole, self-contained, and what strangers wrote is text."""

import re
from dataclasses import replace

import pytest

from pemviz.cli.main import main
from pemviz.reports.budget_document import budget_document, next_steps, verdict_sentence
from pemviz.reports.document import Table
from pemviz.runs.risk_budget import judge_budget
from tests.budgets import COUNTED, WEIGHED, hazard, look_at_memories, make_run, write_budget
from tests.reports.test_safety_case import LOADS, well_formed

NASTY = "a <script>alert(1)</script> [red]b[/red] & é"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("runs")
    look_at_memories(make_run(found / "looked", COUNTED))
    make_run(found / "weighed", WEIGHED)
    return found


def judged(folder, *hazards, accepted):
    return judge_budget(write_budget(folder / "budget.toml", *hazards, accepted=accepted))


def test_the_page_has_budget_argument_and_evidence_and_fetches_nothing(folder, tmp_path):
    one = hazard(runs=("looked",), name=NASTY)
    two = hazard(name="other", runs=("weighed",), extra="uncertainty = 'sampling'")
    path = write_budget(folder / "budget.toml", one, two, accepted=1.0)
    out = tmp_path / "case.html"
    assert main(["report", "--budget", str(path), "--out", str(out)]) == 0
    page = out.read_text(encoding="utf-8")
    tree = well_formed(page)
    text = "".join(tree.itertext())
    sections = ("Hazards", "Which factor decides", "What to do next", "Harm an hour")
    runs = ("Run 1: looked", "Run 2: weighed")
    for words in (*sections, *runs, "the safety board", "G-h1-violation", NASTY):
        assert words in text
    assert "<script>" not in page
    assert LOADS.findall(page) == []
    assert not {element.tag for element in tree.iter()} & {"script", "link", "img", "iframe"}


def test_runs_that_are_named_are_the_evidence(folder, tmp_path, capsys):
    path = write_budget(folder / "budget.toml", hazard(runs=("looked",)), accepted=1.0)
    out, words = tmp_path / "case.html", ["report", "--budget", str(path)]
    words += [str(folder / "weighed"), str(folder / "looked"), "--gsn", str(tmp_path / "g.yaml")]
    assert main([*words, "--out", str(out)]) == 0
    assert "Run 1: weighed" in out.read_text(encoding="utf-8")
    told = "pemviz: weighed: in no hazard of the budget, so not in the argument"
    assert capsys.readouterr().err.strip() == told


def test_what_would_not_lower_the_upper_end_is_no_less_than_nothing(folder):
    one = judged(folder, hazard(), accepted=1e-3)
    worse = replace(one.effects[0], high_if_known=1.001 * one.risk.harm_per_hour.high)
    document = budget_document(replace(one, effects=(worse,)))
    (table,) = (block for block in document.blocks("decides") if isinstance(block, Table))
    assert table.rows[0][-1] == "0%"


def test_sentences_agree_with_the_figures(folder):
    one = judged(folder, hazard(runs=("looked",)), accepted=1e-3)
    total = one.risk.harm_per_hour
    found = re.search(r"at most (\S+) an hour, (\S+) times", verdict_sentence(one))
    assert float(found[1]) == pytest.approx(total.high, rel=0.05)
    assert float(found[2]) == pytest.approx(total.high / 1e-3, rel=0.05)


def test_where_a_memory_of_misses_decides_it_is_said_with_what_narrows_it(folder):
    one = judged(folder, hazard(runs=("looked",)), accepted=0.04)
    steps = list(next_steps(one))
    assert steps[0].startswith("P(violation | encounter) of braking decides")
    assert "memory of misses" in steps[1]
    assert "tracked video of this detector" in steps[1]
    assert steps[-1].startswith("what to label: pemviz record --config")


def test_every_section_has_its_blocks(folder):
    document = budget_document(judged(folder, hazard(runs=("looked",)), accepted=1e-3))
    assert [section.key for section in document.sections] == [
        "verdict", "hazards", "decides", "next", "method",
    ]  # fmt: skip
    assert all(section.full for section in document.sections)
