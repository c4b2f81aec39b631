import json
from functools import partial

import pytest

from benchmarks.__main__ import main
from benchmarks.paper import paper_figures
from benchmarks.whole_runs import WHOLE_RUNS
from pemviz.cli.record_arguments import parse


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


@pytest.mark.parametrize("options", WHOLE_RUNS)
def test_the_whole_runs_are_what_the_command_takes(options):
    parse(options.split()).experiment.validate()


def test_whole_runs_are_timed_beside_those_without_numba(capsys, monkeypatch):
    short = "--no-recording --method monte-carlo --final-rollouts 10 --no-plan --no-measured-memory"
    monkeypatch.setattr("benchmarks.whole_runs.WHOLE_RUNS", (short,))
    assert main(["runs", "--times", "1", "--without-numba", "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["options"] == short
    assert run["wall_s"] > 0.0
    assert run["ratio"] == pytest.approx(run["user_s"] / run["other_user_s"])


def test_a_whole_run_that_ends_badly_says_so(capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.whole_runs.WHOLE_RUNS", ("--method moon",))
    assert main(["runs"]) == 3
    assert "--method moon: exit code 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (["--part", "moon"], "moon"),
        (["accuracy", "--scenarios", "moon"], "scenarios = 'moon'"),
        (["accuracy", "--rollouts", "3"], "at least 24"),
        (["accuracy", "--seeds", "0"], "seeds = 0"),
        (["runs", "--times", "0"], "times = 0"),
        (["runs", "--checkout", "moon"], "checkout = moon"),
    ],
)
def test_bad_input_is_one_line(capsys, words, fragment):
    assert main([*words]) == 2
    shown = capsys.readouterr()
    assert fragment in shown.err
    assert shown.err.count("\n") == 1
