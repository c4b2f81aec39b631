import json
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError, RunError
from pemviz.runs.engine import run, run_experiment
from pemviz.runs.events import (
    RepetitionDone,
    RolloutsDone,
    RunDone,
    RunFailed,
    RunStarted,
    StageDone,
)
from pemviz.runs.experiment import build_experiment
from pemviz.runs.result_file import result_document
from pemviz.runs.run_folder import RunStore
from tests.toy import FunctionPem

ROOT = Path(__file__).resolve().parents[2]
SMALL = ExperimentConfig(
    method="adaptive", stages=2, rollouts=30, final_rollouts=30, epochs=5, plan=False,
    measured_memory=False,
)  # fmt: skip


class Listener:
    """Keeps what it hears."""

    def __init__(self):
        self.events = []

    def notify(self, event):
        self.events.append(event)


def heard(config=SMALL, **given):
    """A run's result and its events."""
    listener = Listener()
    return run_experiment(config, observers=[listener], **given), listener.events


def stopping(times, *, when=lambda: True):
    """Stops once it is asked so often while a condition holds; and what counts how often."""
    asked = []

    def should_stop():
        asked.extend([True] * bool(when()))
        return len(asked) == times

    return should_stop, asked


def comparable(result):
    document = result_document(result)
    return {key: document[key] for key in ("estimate", "stages", "repetitions", "least_robust")}


def test_events_come_in_order():
    result, events = heard(replace(SMALL, repetitions=2))
    kinds = [type(event) for event in events if not isinstance(event, RolloutsDone)]
    repetition = [*[StageDone] * 4, RepetitionDone]
    assert kinds == [RunStarted, *repetition, *repetition, RunDone]
    assert events[-1].result == result
    assert result.status == "done"
    assert len(result.stages) == 8
    assert len(result.repetitions) == 2


def test_observers_change_no_digit_and_cannot_write(tmp_path):
    alone = run_experiment(SMALL)
    listener = Listener()
    watched = run_experiment(SMALL, observers=[listener, RunStore(tmp_path)])
    assert comparable(alone) == comparable(watched)
    stage = next(e.stage for e in listener.events if isinstance(e, StageDone))
    rollouts = stage.scored.rollouts
    arrays = (
        *rollouts.signals.values(), *rollouts.memory.values(), rollouts.detected, rollouts.log_p,
        rollouts.pem_logit, stage.scored.robustness, stage.scored.violated,
    )  # fmt: skip
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_a_second_process_gives_the_same_result():
    code = (
        "import json\nfrom tests.runs.test_engine import SMALL, comparable\n"
        "from pemviz.runs.engine import run_experiment\n"
        "print(json.dumps(comparable(run_experiment(SMALL))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert json.loads(done.stdout) == json.loads(json.dumps(comparable(run_experiment(SMALL))))


@pytest.mark.parametrize(
    ("metric", "method"),
    [("classical", "monte-carlo"), ("agm", "naive"), ("smooth-cumulative", "adaptive")],
)
def test_batches_do_not_change_the_result(method, metric):
    many = replace(SMALL, method=method, metric=metric, rollouts=300, final_rollouts=300)
    experiment = build_experiment(many)
    whole = run(experiment)
    problem = replace(experiment.problem, batch_rollouts=170)  # 170 and 130
    parts = run(replace(experiment, problem=problem))
    assert comparable(whole) == comparable(parts)


def test_violations_are_classical_whatever_the_metric():
    by_metric = {
        metric: run_experiment(replace(SMALL, method="naive", metric=metric, final_rollouts=300))
        for metric in ("classical", "agm", "smooth-cumulative")
    }
    failures = {result.estimate.failures for result in by_metric.values() if result.estimate}
    assert len(failures) == 1
    assert failures.pop() > 250
    assert len({r.least_robust[0].robustness for r in by_metric.values()}) == 3


def test_it_stops_between_batches_and_keeps_what_is_done():
    listener = Listener()

    def should_stop():
        return sum(isinstance(event, StageDone) for event in listener.events) >= 2

    result = run_experiment(SMALL, observers=[listener], should_stop=should_stop)
    assert result.status == "stopped"
    assert [s.stage for s in result.stages] == [0, 1]
    assert result.estimate is None
    assert isinstance(listener.events[-1], RunDone)


def test_it_stops_in_the_middle_of_a_fit():
    should_stop, _ = stopping(4)
    result = run_experiment(replace(SMALL, epochs=100_000), should_stop=should_stop)
    assert result.status == "stopped"
    assert result.stages == ()


def test_it_stops_while_the_value_function_is_computed():
    should_stop, asked = stopping(40)
    result, events = heard(replace(SMALL, method="zero-variance"), should_stop=should_stop)
    assert len(asked) == 40
    assert result.status == "stopped"
    assert [type(event) for event in events] == [RunStarted, RunDone]


@pytest.mark.parametrize("last_heard", [StageDone, RepetitionDone])
def test_it_stops_within_the_data_bound_and_within_the_reference(last_heard):
    """The data's bound follows the final stage, the reference the last repetition."""
    listener = Listener()
    should_stop, asked_after = stopping(
        3, when=lambda: any(isinstance(event, last_heard) for event in listener.events)
    )
    config = replace(SMALL, method="monte-carlo", reference=True)
    result = run_experiment(config, observers=[listener], should_stop=should_stop)
    assert len(asked_after) == 3
    assert result.status == "stopped"
    assert result.reference is None
    assert (result.data_bound is None) == (last_heard is StageDone)
    assert len(result.stages) == 1


def test_bad_input_is_refused_before_anyone_hears_of_it():
    listener = Listener()
    with pytest.raises(InputError):
        run_experiment(replace(SMALL, spec="always[0,400] (gap >= 2)"), observers=[listener])
    assert listener.events == []


def test_a_simulator_that_fails_fails_the_run():
    experiment = build_experiment(SMALL)
    listener = Listener()

    def broken(salient):
        raise ValueError("the model is gone")

    problem = replace(experiment.problem, pem=FunctionPem(broken))
    with pytest.raises(RunError, match="the model is gone"):
        run(replace(experiment, problem=problem), observers=[listener])
    assert isinstance(listener.events[-1], RunFailed)
    assert listener.events[-1].result.status == "failed"


def test_an_observer_that_cannot_write_fails_the_run_and_the_others_hear_it():
    class FullDisk(Listener):
        def notify(self, event):
            if not isinstance(event, RunStarted):
                raise OSError(28, "No space left on device")

    listener = Listener()
    with pytest.raises(RunError, match="No space left"):
        run_experiment(SMALL, observers=[FullDisk(), listener])
    assert isinstance(listener.events[-1], RunFailed)


def test_what_carries_the_estimate_is_ranked_before_the_least_robust_of_all():
    result, events = heard()
    stages = [event.stage for event in events if isinstance(event, StageDone)]
    final = stages[-1].scored
    carrying = [r for r in result.least_robust if r.share is not None]
    assert carrying == list(result.least_robust[: len(carrying)])
    assert all(r.violated and r.stage == stages[-1].stage for r in carrying)
    weight = np.where(final.violated, np.exp(final.rollouts.log_weight), 0.0)
    for one in carrying:
        assert one.share == pytest.approx(weight[one.rollout] / weight.sum(), rel=1e-9)
    for some in (carrying, result.least_robust[len(carrying) :]):
        assert (np.diff([r.robustness for r in some]) >= 0.0).all()


def test_before_anything_carries_an_estimate_the_least_robust_of_all_stages_are_listed():
    done = [event for event in heard()[1] if isinstance(event, StageDone)]
    learned = [event for event in done if event.stage.kind != "final"]
    everything = np.sort(np.concatenate([one.stage.scored.robustness for one in learned]))
    listed = learned[-1].result.least_robust
    assert [r.robustness for r in listed] == everything[:20].tolist()
    stages, worst = [event.stage for event in done], listed[0]
    stage = stages[worst.stage]
    assert worst.misses == (~stage.scored.rollouts.detected[worst.rollout]).sum()
    assert worst.nll == pytest.approx(-stage.scored.rollouts.log_p[worst.rollout].sum())


@pytest.mark.parametrize("metric", ["classical", "smooth-cumulative"])
def test_an_experiment_can_be_sent_to_another_process(metric):
    config = ExperimentConfig(
        method="naive", metric=metric, final_rollouts=20, plan=False, measured_memory=False
    )
    sent = pickle.loads(pickle.dumps(build_experiment(config)))  # noqa: S301  our own
    assert run(sent).estimate == run_experiment(config).estimate
