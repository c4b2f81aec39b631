"""How far a run is, and how long it takes still: by a clock that the tests turn."""

from types import SimpleNamespace

import pytest

from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run
from pemviz.runs.events import RepetitionDone, RolloutsDone, RolloutsSearched, RunStarted, StageDone
from pemviz.runs.experiment import build_experiment
from pemviz.runs.forecast import Progress, counted_in_words, left_in_words, searched_in_words
from pemviz.sampling.method import Foreseen
from tests.lattice_walk import ToyPem, ToySimulator

RARE = ToySimulator(initial_gap=5, states=20), ToyPem(at_zero=2.5)
OFTEN = ToySimulator(initial_gap=2, states=12), ToyPem(at_zero=1.0)


def started(method="mixture", *, repetitions=1, planned=400, stages=4, **limits):
    config = ExperimentConfig(method=method, repetitions=repetitions, **limits)
    event = RunStarted(config, (), None, None, stages, planned, None)
    return Progress(began_s=100.0, now_s=100.0).after(event, now_s=100.0)


def stage(number, count=100, *, foreseen=None, kind="learn", repetition=0, **timings_s):
    done = SimpleNamespace(
        stage=number, count=count, repetition=repetition, kind=kind, timings_s=timings_s
    )
    return StageDone(stage=done, result=None, foreseen=foreseen)


def test_time_left_is_what_a_rollout_and_a_fit_took_times_what_is_left():
    at = started()
    assert at.left_s is None
    at = at.after(stage(0, simulation=48.0, robustness=2.0, fit=3.0), now_s=153.0)
    assert at.left_s == (300 + 8) * 0.5 + 2 * 3.0  # one in fifty is simulated again
    assert counted_in_words(at) == "100 of 400 rollouts"
    assert left_in_words(at) == "about 3 min left"
    assert left_in_words(at, now_s=153.0 + 80.0) == "about 80 s left"
    at = at.after(RolloutsDone(0, 1, done=50, total=100), now_s=153.0 + 50.0)
    assert at.left_s == (250 + 8) * 100.0 / 150 + 2 * 3.0


def test_what_an_interrupted_run_left_takes_no_time_that_counts():
    at = started().after(stage(0, simulation=50.0), now_s=150.0)
    at = at.after(RolloutsDone(0, 1, done=100, total=100), now_s=150.1)
    at = at.after(stage(1), now_s=150.2)
    assert at.left_s == (200 + 8) * 0.5


@pytest.mark.parametrize(
    "beside", [RolloutsDone(0, 1, done=0, total=100), RolloutsSearched(0, 1, count=600)]
)
def test_what_comes_before_a_stage_is_no_time_of_its_rollouts(beside):
    at = started().after(stage(0, simulation=50.0), now_s=150.0)
    at = at.after(beside, now_s=450.0)
    at = at.after(RolloutsDone(0, 1, done=20, total=100), now_s=460.0)
    assert at.left_s == (280 + 8) * 0.5


def test_what_a_search_has_simulated_is_told_and_no_longer_to_come():
    foreseen = Foreseen(rollouts=300, learning_stages=0, searches=500, may_grow=False)
    at = started("auto").after(stage(0, foreseen=foreseen, simulation=50.0), now_s=150.0)
    assert at.left_s == (300 + 8 + 500) * 0.5
    for searched, left in ((200, 300), (250, 50), (100, 0)):
        at = at.after(RolloutsSearched(0, 1, count=searched), now_s=200.0)
        assert at.left_s == (300 + 8 + left) * 0.5
    assert searched_in_words(at) == "stage 1, searching: 550 rollouts"
    assert counted_in_words(at) == "100 of 400 rollouts"  # they are no stage's
    assert at.after(RolloutsSearched(1, 0, count=5), now_s=200.0).repetition == 1
    at = at.after(stage(1, foreseen=foreseen, simulation=50.0), now_s=300.0)
    assert at.searched == 0
    assert at.left_s == (300 + 10 + 500) * 0.5


def test_a_run_is_told_no_more_time_than_its_limit_leaves():
    at = started(max_minutes=2.0).after(stage(0, simulation=50.0), now_s=150.0)
    assert at.left_s == 120.0 - 50.0
    assert at.after(RolloutsDone(0, 1, done=0, total=100), now_s=230.0).left_s == 0.0
    longer = started(max_minutes=4.0).after(stage(0, simulation=50.0), now_s=150.0)
    assert longer.left_s == (300 + 8) * 0.5


def test_a_method_that_goes_on_tells_no_end_until_it_has_chosen():
    at = started("auto")
    assert counted_in_words(at) == "0 rollouts"
    at = at.after(stage(0, 240, simulation=120.0), now_s=220.0)
    assert (at.left_s, left_in_words(at), counted_in_words(at)) == (None, "", "240 rollouts")
    foreseen = Foreseen(1200, learning_stages=3, searches=60, may_grow=True)
    at = at.after(stage(1, 100, foreseen=foreseen, simulation=50.0, fit=2.0), now_s=280.0)
    assert at.left_s == pytest.approx((1260 + 0.02 * 1540) * 0.5 + 3 * 2.0)
    assert counted_in_words(at) == "340 of 1,540 rollouts"
    assert left_in_words(at) == "about 11 min left, or more"
    more = at.after(stage(2, 100, foreseen=Foreseen(5000), simulation=50.0), now_s=340.0)
    assert more.planned == 440 + 5000
    assert more.share == at.share > more.done / more.planned  # a bar does not go back


def test_other_repetitions_take_as_many_rollouts():
    at = started("auto", repetitions=3)
    at = at.after(stage(0, 100, foreseen=Foreseen(200), simulation=10.0), now_s=110.0)
    assert at.planned == 3 * 300
    at = at.after(stage(1, 200, foreseen=Foreseen(0), simulation=20.0), now_s=130.0)
    at = at.after(RepetitionDone(0, None, None), now_s=131.0)
    again = stage(0, 100, foreseen=Foreseen(300), repetition=1, simulation=10.0)
    assert at.after(again, now_s=141.0).planned == 300 + 2 * 400


class Foretold:
    """What was foreseen after each stage of a repetition, and what came."""

    def __init__(self):
        self.done, self.foreseen, self.repetitions = 0, [], []

    def notify(self, event):
        match event:
            case StageDone():
                self.done += event.stage.count
                self.foreseen.append((self.done, event.foreseen))
            case RepetitionDone():
                self.repetitions.append((self.done, self.foreseen))
                self.done, self.foreseen = 0, []


@pytest.mark.parametrize(
    ("system", "settings"),
    [
        (OFTEN, {"precision": 0.1}),
        (RARE, {}),
        (RARE, {"precision": 0.05}),
        (RARE, {"method": "mixture"}),
        (RARE, {"repetitions": 2}),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_what_is_foreseen_comes(system, settings, seed):
    """To the rollout where it may not grow, and no less where it may."""
    simulator, pem = system
    spec = f"always[0,{simulator.states - 1}] (gap >= 0.5)"
    config = ExperimentConfig(**{"method": "auto", "spec": spec, "seed": seed, **settings})
    told = Foretold()
    run(build_experiment(config, simulator=simulator, pem=pem), observers=[told])
    assert len(told.repetitions) == config.repetitions
    for total, foreseen in told.repetitions:
        assert foreseen[-1][1] == Foreseen(0)
        for done, left in foreseen:
            if left is not None:
                assert done + left.rollouts <= total
                assert left.may_grow or done + left.rollouts == total


def test_no_more_is_foreseen_than_a_run_may_take():
    simulator, pem = RARE
    config = ExperimentConfig(method="auto", spec="always[0,19] (gap >= 0.5)", max_rollouts=1500)
    told = Foretold()
    run(build_experiment(config, simulator=simulator, pem=pem), observers=[told])
    ((total, foreseen),) = told.repetitions
    known = [(done, left) for done, left in foreseen if left is not None]
    assert all(done + left.rollouts + left.searches <= 1500 for done, left in known)
    assert known[-1] == (total, Foreseen(0))
