import json
from functools import partial

import pytest

from benchmarks.__main__ import main
from benchmarks.paper import paper_figures


@pytest.mark.slow
def test_figures_of_the_paper_repetition(capsys, monkeypatch):
    # more repeats only make the medians steadier
    monkeypatch.setattr("benchmarks.paper.paper_figures", partial(paper_figures, repeats=1))
    assert main(["--part", "paper", "--json"]) == 0
    (figures,) = json.loads(capsys.readouterr().out).values()
    by_name = {figure["name"]: figure for figure in figures}
    wall = by_name["paper repetition, wall"]
    parts = [by_name[f"paper repetition, {part}"] for part in ("simulation", "fits")]
    assert all(figure["value"] > 0.0 and figure["unit"] for figure in figures)
    assert sum(part["value"] for part in parts) < wall["value"]


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["--part", "moon"], "moon"),
        (["accuracy", "--scenarios", "moon"], "scenarios = 'moon'"),
        (["accuracy", "--rollouts", "3"], "at least 24"),
        (["accuracy", "--seeds", "0"], "seeds = 0"),
    ],
)
def test_bad_input_is_one_line(capsys, words, fragment):
    assert main([*words]) == 2
    shown = capsys.readouterr()
    assert fragment in shown.err
    assert shown.err.count("\n") == 1
