"""What a person sees of a run's progress: from nothing to the whole, never back, never beyond."""

import io
import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import Progress

from pemviz.bars import progress_bar
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.panel.controller import Watcher
from pemviz.reports.terminal import print_summary
from pemviz.runs.engine import run_experiment
from pemviz.runs.forecast import counted_in_words, progress_now
from pemviz.runs.progress import ProgressBar, ProgressLines, progress_observer
from tests.reports.runs import EXPLANATION, PLAN, estimate, result

EASY = ScenarioConfig(states=45, emergency_gap_m=12.0)


class Displays:
    """The terminal's bar and the panel's, after every event."""

    def __init__(self):
        self._rich = Progress(console=Console(file=io.StringIO()))
        self._bar = ProgressBar(self._rich)
        self._watcher = Watcher(folder=None, publish=lambda *_: None)
        self.shares = []

    def notify(self, event):
        self._bar.notify(event)
        self._watcher.notify(event)
        task = self._rich.tasks[0]
        self.shares.append((task.completed / task.total, self._watcher.progress.share))


@pytest.mark.parametrize("method", ["auto", "mixture", "splitting", "subset", "monte-carlo"])
def test_both_displays_go_from_nothing_to_the_whole(method):
    config = ExperimentConfig(
        method=method,
        scenario=EASY,
        spec="always[0,44] (gap >= 7.0)",
        stages=2,
        rollouts=20,
        final_rollouts=30,
        repetitions=2,
        measured_memory=False,
    )
    displays = Displays()
    run_experiment(config, observers=[displays])
    for shares in zip(*displays.shares, strict=True):
        assert shares[0] == 0.0
        assert shares[-1] == 1.0
        assert all(later >= earlier for earlier, later in itertools.pairwise(shares))


def test_a_notebook_that_asks_for_colours_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as ipykernel sets it for what a cell starts
    with progress_observer() as observer, progress_bar("files") as on_progress:
        assert isinstance(observer, ProgressLines)
        on_progress(1, 2)
    assert capsys.readouterr().err == ""


def test_what_is_counted_is_said():
    at = replace(progress_now(), before=1200, planned=3400, share=0.25)
    assert counted_in_words(at) == "1,200 of 3,400 rollouts"
    assert counted_in_words(replace(at, by_level=True)) == "25% of the way to violations"


def test_elsewhere_than_on_a_terminal_four_lines_tell_of_the_stages(monkeypatch):
    config = ExperimentConfig(
        method="mixture", scenario=EASY, spec="always[0,44] (gap >= 7.0)",
        stages=10, rollouts=4, final_rollouts=4, measured_memory=False,
    )  # fmt: skip
    for silent_s, told in ((30.0, [2, 5, 8, 11]), (-1.0, list(range(12)))):
        monkeypatch.setattr("pemviz.runs.progress.SILENT_S", silent_s)
        shown = io.StringIO()
        run_experiment(config, observers=[ProgressLines(Console(file=shown, width=200))])
        lines = shown.getvalue().splitlines()
        assert [int(line.split()[1].rstrip(",")) for line in lines] == told
        assert lines[-1].startswith("stage 11, final")


def test_an_answer_that_holds_is_told_in_25_lines_with_those_of_the_stages(capsys):
    whole = result(
        estimate(method="mixture"),
        reference=None,
        plan=replace(PLAN, reason=None),
        explanation=replace(EXPLANATION, memory=None),
    )
    print_summary(whole, Path("run"))
    assert len(capsys.readouterr().out.splitlines()) <= 25 - 4
