"""What a method's description says of it is what the method does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pemviz.config import METHODS, ExperimentConfig, ScenarioConfig
from pemviz.errors import InputError
from pemviz.runs.engine import run
from pemviz.runs.events import RolloutsDone, StageDone
from pemviz.runs.experiment import Experiment, build_experiment, build_method
from pemviz.sampling.description import MethodDescription
from pemviz.sampling.registry import SHIPPED, by_name
from pemviz.sampling.rollouts.runners import run_here
from tests.toy import constant_pem

EVERY = pytest.mark.parametrize("method", SHIPPED, ids=lambda method: method.name)
PLANNED = pytest.mark.parametrize(
    "method", [one for one in SHIPPED if one.most is None], ids=lambda method: method.name
)
"""Those whose stages are known before they begin."""
CHANGES = {
    "alpha": 0.7,
    "sigma": 0.97,
    "stages": 7,
    "rollouts": 77,
    "final_rollouts": 777,
    "epochs": 77,
    "learning_rate": 0.07,
    "naive_detection_probability": 0.7,
    "chains": 70,
    "precision": 0.07,
    "max_rollouts": 7_777,
    "max_minutes": 7.0,
    "surrogate": "highway-env",
}
COMMON = {"seed"}
"""What every method looks at."""
NOT_THE_METHODS = {
    "method", "metric", "spec", "pem", "simulator", "smooth_beta_per_m", "repetitions",
    "step_time_limit_s", "reference", "target", "scenario", "memory_s", "memory_curve",
    "plan", "rules", "frailty", "position_errors", "encounter", "start", "encounters_per_hour",
    "keep", "sumo", "carla", "assumed_memory_s", "measured_memory", "lost",
    "memory_law", "varying_frailty", "varying_frailty_s",
}  # fmt: skip


class Heard:
    """The stages of a run, and its reports of progress."""

    def __init__(self):
        self.stages = []
        self.reports = []

    def notify(self, event):
        match event:
            case RolloutsDone(again=False):
                self.reports.append(event)
            case StageDone():
                self.stages.append(event.stage)
            case _:
                pass


@cache
def short_run(name: str) -> tuple[Experiment, Heard, int]:
    """A run in which violations are common enough, and how often batches were asked for."""
    config = ExperimentConfig(
        method=name,
        scenario=ScenarioConfig(states=60),
        spec="always[0,59] (gap >= 5.0)",
        stages=2,
        rollouts=40,
        final_rollouts=60,
        epochs=20,
        seed=3,
        measured_memory=False,
    )
    experiment = build_experiment(config)
    asked = []

    def counted(*arguments):
        asked.append(None)
        return run_here(*arguments)

    problem = replace(
        experiment.problem,
        pem=constant_pem(detection_probability=0.8),
        run_batches=counted,
        batch_rollouts=16,
    )
    heard = Heard()
    run(replace(experiment, problem=problem), observers=[heard])
    return experiment, heard, len(asked)


def test_the_configuration_names_those_that_are_shipped():
    assert tuple(method.name for method in SHIPPED) == METHODS.shipped
    assert [by_name(name) for name in METHODS.shipped] == list(SHIPPED)


@EVERY
def test_what_is_built_has_the_descriptions_name(method):
    assert build_method(ExperimentConfig(method=method.name)).name == method.name
    assert "\n" not in method.summary
    assert 20 < len(method.summary) < 90


@EVERY
def test_settings_are_exactly_what_changes_the_method(method):
    config = ExperimentConfig(method=method.name)
    assert ExperimentConfig.__dataclass_fields__.keys() == CHANGES.keys() | COMMON | NOT_THE_METHODS
    plain = build_method(config)
    assert plain == build_method(config)
    changing = {n for n, v in CHANGES.items() if build_method(replace(config, **{n: v})) != plain}
    assert method.settings == changing


def test_settings_that_no_configuration_has_are_refused():
    with pytest.raises(ValueError, match="settings momentum: a configuration has no such field"):
        replace(SHIPPED[0], settings=frozenset({"momentum", "alpha"}))


@PLANNED
def test_the_budget_is_what_a_run_simulates(method: MethodDescription):
    experiment, heard, _ = short_run(method.name)
    simulated = sum(stage.scored.rollouts.count for stage in heard.stages)
    assert method.budget(experiment.config).rollouts == simulated == experiment.planned_rollouts


@EVERY
def test_a_budget_is_kept_and_too_small_a_one_refused(method: MethodDescription):
    config = ExperimentConfig(method=method.name)
    for rollouts in (60, 1200, 2400, 11_000):
        assert method.budget(method.with_budget(config, rollouts)).rollouts == rollouts
    with pytest.raises(InputError, match=f"rollouts = 1: must be at least .* for {method.name}"):
        method.with_budget(config, 1)


@PLANNED
def test_rollouts_follow_the_model_where_the_description_says_so(method: MethodDescription):
    _, heard, _ = short_run(method.name)
    alike = all(
        np.array_equal(stage.scored.rollouts.log_p, stage.scored.rollouts.log_q)
        for stage in heard.stages
    )
    assert method.follows_model == alike


@PLANNED
def test_stages_are_what_the_description_says(method: MethodDescription):
    _, heard, _ = short_run(method.name)
    kinds = [stage.kind for stage in heard.stages]
    learned = [stage.learned is not None for stage in heard.stages]
    if method.stages == "learning":
        assert learned == [True] * (len(kinds) - 1) + [False]
    else:
        assert set(kinds) == {"final"}
        assert not any(learned)
    # a run's estimate is a product over levels, all others are averages over the stage's rollouts
    for stage in heard.stages:
        rollouts, violated = stage.scored.rollouts, stage.scored.violated
        average = float(np.mean(np.where(violated, np.exp(rollouts.log_weight), 0.0)))
        assert (method.interval_basis == "runs") == (stage.probability != pytest.approx(average))


@EVERY
def test_only_what_restarts_simulates_outside_batches(method: MethodDescription):
    *_, batches = short_run(method.name)
    repeats = 1  # of some rollouts of all stages, whatever the method
    assert ("restarts" in method.needs) == (batches == repeats)


@EVERY
def test_progress_is_counted_as_the_description_says(method: MethodDescription):
    """In rollouts, the reports of a stage end at its size and name every batch on the way."""
    _, heard, _ = short_run(method.name)
    for stage in heard.stages:
        reports = [event for event in heard.reports if event.stage == stage.stage]
        done = [event.done for event in reports]
        assert done == sorted(done)
        assert done[-1] == reports[-1].total == stage.scored.rollouts.count
        # batches are of 16 rollouts at most, but a level has no such step
        steps = np.diff([0, *done])
        assert (method.counting == "rollouts") == bool(np.all((steps > 0) & (steps <= 16)))


@EVERY
def test_weights_are_diagnosed_where_the_answer_rests_on_them(method: MethodDescription):
    experiment, heard, _ = short_run(method.name)
    assert experiment.has_likelihood_ratios == (method.interval_basis != "runs")
    assert method.rests_on_weights == (not method.follows_model)
    if not method.has_likelihood_ratios:
        assert all(stage.ess is None for stage in heard.stages)
