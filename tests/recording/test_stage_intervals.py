"""The interval that a recording draws around a stage's estimate is of that estimate, or absent."""

import math
from dataclasses import replace

import pytest
from scipy import stats

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.recording.learning import stage_figures
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from tests.recording.conftest import Listener
from tests.toy import constant_pem


def stages_of(method):
    """The stages of a short run under an error model that misses one time in five."""
    config = ExperimentConfig(
        method=method,
        scenario=ScenarioConfig(states=60),
        spec="always[0,59] (gap >= 5.0)",
        stages=2,
        rollouts=40,
        final_rollouts=200,
        epochs=50,
        seed=3,
    )
    experiment = build_experiment(config)
    pem = constant_pem(detection_probability=0.8)
    problem = replace(experiment.problem, pem=pem)
    listener = Listener()
    run(replace(experiment, problem=problem), observers=[listener])
    return listener.stages


@pytest.mark.parametrize(
    "method", ["adaptive", "mixture", "zero-variance", "splitting", "monte-carlo", "naive"]
)
def test_no_interval_contradicts_its_estimate(method):
    figures = [stage_figures(stage, method=method) for stage in stages_of(method)]
    assert any(row.failures for row in figures)
    for row in figures:
        if row.log10_ci_low is None or row.log10_probability is None:
            continue
        assert row.log10_ci_low <= row.log10_probability <= row.log10_ci_high


def test_a_run_of_splitting_has_an_estimate_and_no_interval():
    """One run tells nothing of how far runs differ, and its particles carry no weights."""
    for stage in stages_of("splitting"):
        row = stage_figures(stage, method="splitting")
        assert row.log10_probability == stage.log10_probability < 0.0
        assert (row.log10_ci_low, row.log10_ci_high) == (None, None)


def test_a_share_has_the_exact_binomial_interval():
    (stage,) = stages_of("monte-carlo")
    row = stage_figures(stage, method="monte-carlo")
    exact = stats.binomtest(row.failures, row.rollouts).proportion_ci(0.95, method="exact")
    assert row.log10_ci_high == pytest.approx(math.log10(exact.high))
