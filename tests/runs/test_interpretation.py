"""What a result means, from stages that are handed over one by one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.trust_cases import trust_cases
from benchmarks.trust_study import chosen
from pemviz.analysis.explanation import explain
from pemviz.analysis.model_uncertainty import member_estimates, model_interval
from pemviz.config import ExperimentConfig
from pemviz.reports.estimate_words import reference_text
from pemviz.reports.gate import decide_run
from pemviz.runs.engine import run, run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.interpretation import Interpreted, interpret
from pemviz.runs.observers import KeptStages
from pemviz.runs.ranking import with_stage
from pemviz.runs.supplements import beside_reference
from pemviz.runs.uncertainty import run_diagnostics, uncertainty_budget
from pemviz.sampling.method import final_stage
from pemviz.sampling.zero_variance.reference import Reference

CONFIG = ExperimentConfig(method="naive", final_rollouts=60, measured_memory=False)


@pytest.fixture(scope="module")
def experiment():
    return build_experiment(CONFIG)


@pytest.fixture(scope="module")
def heard(experiment):
    stages = KeptStages()
    run(experiment, observers=[stages])
    return stages


@pytest.fixture(scope="module")
def part(heard):
    """Makes a part of a final batch, with so many violations, of 40 rollouts."""
    (whole,) = heard.stages
    violating = np.flatnonzero(whole.scored.violated)

    def make(*, failures, stage, repetition=0):
        # rollouts may stand twice: a part of its own has 40 of the whole's 60
        rollouts = np.r_[violating[stage : stage + failures], [0] * (40 - failures)]
        scored = whole.scored.take(rollouts)
        violated = np.arange(40) < failures
        return final_stage(
            repetition=repetition,
            stage=stage,
            scored=replace(scored, violated=violated),
            sampled_from=whole.sampled_from,
        )

    return make


def interpreted_after(stages, *, experiment, empty):
    interpreted = Interpreted(empty)
    for stage in stages:
        interpreted = replace(interpreted, result=with_stage(interpreted.result, stage))
        for found in interpret(interpreted, experiment=experiment, stage=stage):
            interpreted = found
    return interpreted


def explanation_of(stage, experiment):
    return explain(
        stage,
        features=experiment.features,
        farthest_m=experiment.back_end.farthest_m,
        target=None,
        dt_s=experiment.back_end.simulator.dt_s,
    )


@pytest.mark.parametrize(
    ("failures", "best"), [((2, 9, 5), 1), ((9, 9, 2), 0), ((0, 0, 3), 2), ((7, 0, 0), 0)]
)
def test_the_part_with_most_failures_explains_the_first_of_equals(
    experiment, heard, part, failures, best
):
    stages = [part(failures=count, stage=stage) for stage, count in enumerate(failures)]
    found = interpreted_after(stages, experiment=experiment, empty=heard.started.result).result
    assert found.explanation == explanation_of(stages[best], experiment)
    assert found.explanation is not None


def test_the_last_repetition_with_a_failure_explains_by_its_own_best_part(experiment, heard, part):
    stages = [
        part(failures=9, stage=0),
        part(failures=2, stage=0, repetition=1),
        part(failures=5, stage=1, repetition=1),
        part(failures=0, stage=0, repetition=2),
    ]
    found = interpreted_after(stages, experiment=experiment, empty=heard.started.result).result
    assert found.explanation == explanation_of(stages[2], experiment)
    assert found.explanation.repetition == 1


def test_other_models_answer_for_all_parts_together(experiment, heard, part):
    stages = [part(failures=4, stage=0), part(failures=9, stage=1)]
    interpreted = interpreted_after(stages, experiment=experiment, empty=heard.started.result)
    simulator, ensemble = experiment.problem.simulator, experiment.ensemble
    each = [
        member_estimates(stage.scored, simulator=simulator, ensemble=ensemble) for stage in stages
    ]
    assert interpreted.result.pem_interval == model_interval(each)
    for found, expected in zip(interpreted.members, each, strict=True):
        np.testing.assert_array_equal(found.log_mu, expected.log_mu)


def test_a_step_changes_nothing_that_it_was_given(experiment, heard, part):
    stage = part(failures=5, stage=0)
    before = Interpreted(with_stage(heard.started.result, stage))
    first, second = (list(interpret(before, experiment=experiment, stage=stage)) for _ in range(2))
    assert before.result.explanation is None
    assert before.members == ()
    assert first[-1].result == second[-1].result
    assert [found.result.explanation is not None for found in first] == [True] * 4
    assert [found.result.robustness_tail for found in first] == [None] * 4  # of too few
    assert [found.result.pem_interval is not None for found in first] == [False, False, True, True]
    assert [bool(found.result.warnings) for found in first] == [False, False, False, True]


def test_what_learns_or_carries_no_weights_says_nothing(experiment, heard, part):
    stage, splitting = part(failures=5, stage=0), replace(CONFIG, method="splitting")
    interpreted = Interpreted(with_stage(heard.started.result, stage))
    learned = replace(stage, kind="learn")
    unweighted = build_experiment(splitting)
    assert list(interpret(interpreted, experiment=experiment, stage=learned)) == []
    assert list(interpret(interpreted, experiment=unweighted, stage=stage)) == []


def test_a_stop_keeps_the_steps_before(experiment):
    """The third pause after the stage is within the data's bound."""
    stages, asked = KeptStages(), []

    def should_stop():
        asked.extend([True] * bool(stages.stages))
        return len(asked) == 3

    found = run(experiment, observers=[stages], should_stop=should_stop)
    assert found.status == "stopped"
    assert found.explanation is not None
    assert found.pem_interval is not None
    assert found.warnings == ()
    assert found.data_bound is None


def test_disagreement_with_the_reference_is_a_diagnostic_of_the_run():
    result = run_experiment(CONFIG)
    assert run_diagnostics(result) == result.estimate.diagnostics
    far = Reference(1e-9, std_error=1e-12, log10_probability=-9.0)
    *own, last = run_diagnostics(replace(result, reference=far))
    assert tuple(own) == result.estimate.diagnostics
    assert last.kind == "reference-disagrees"
    agreeing = Reference(result.estimate.probability, 0.0, result.estimate.log10_probability)
    assert run_diagnostics(replace(result, reference=agreeing)) == result.estimate.diagnostics


def test_an_unreliable_reference_is_no_argument_against_the_estimate():
    result = run_experiment(CONFIG)
    estimate = result.estimate
    agreeing = Reference(estimate.probability, 0.0, estimate.log10_probability, ("k-hat is 2",))
    found = replace(result, reference=agreeing, warnings=())
    *own, last = run_diagnostics(found)
    assert tuple(own) == estimate.diagnostics
    assert last.kind == "reference-unreliable"
    assert "k-hat is 2" in last.text
    reliable = replace(found, estimate=replace(estimate, diagnostics=()))
    assert decide_run(reliable, limit=1.0).outcome == "passed"
    far = replace(reliable, reference=replace(agreeing, probability=1e-9))
    assert decide_run(far, limit=1.0).outcome == "undecided"


def test_no_reference_is_computed_unasked_where_states_are_many(experiment, heard):
    assert beside_reference(heard.started.result, experiment=experiment) is heard.started.result
    assert run(experiment).reference is None


def test_few_states_are_all_gone_through_unasked():
    """A chain that no signal points at carries 60 % of the probability; all methods miss it."""
    (case,) = chosen(["walk: two modes, every other step"], trust_cases())
    result = run(case.experiment(replace(case.config, method="naive", final_rollouts=400)))
    assert result.reference == Reference(
        pytest.approx(case.truth, rel=1e-12), 0.0, pytest.approx(math.log10(case.truth), rel=1e-12)
    )
    (source,) = [one for one in uncertainty_budget(result) if one.kind == "reference"]
    assert source.low == source.high == result.reference.probability
    assert "few states" in source.name
    assert reference_text(result.reference, result.estimate).startswith("3.211e-06 by recursion")
