"""Which rollouts of a stage are kept, what slots' outcomes become, and a stage's own interval."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.special import expit

import pemviz
from pemviz import figures
from pemviz.cli.main import main
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.recording import paths
from pemviz.recording.learning import stage_figures
from pemviz.recording.rollouts import choose, quota
from pemviz.recording.worst import outcome_frame
from pemviz.runs.drawn_rollout import faultless, faultless_probability
from pemviz.runs.engine import run
from pemviz.runs.experiment import build_experiment
from pemviz.simulators.slots import Slot
from tests.recording.conftest import Listener, record
from tests.recording.read_back import read_stages, strips, texts, values_at
from tests.sampling.test_slots import experiment_of
from tests.toy import constant_pem

scores = st.lists(
    st.floats(min_value=-10, max_value=10) | st.just(1.0), min_size=1, max_size=300
).map(np.array)


@given(robustness=scores, limit=st.integers(min_value=8, max_value=400))
def test_the_least_robust_are_kept_and_come_last(robustness, limit):
    chosen = choose(robustness, limit)
    assert len(set(chosen.tolist())) == chosen.size == min(limit, robustness.size)
    assert (np.diff(robustness[chosen]) <= 0).all()
    least = min(limit, robustness.size) // 4
    np.testing.assert_array_equal(robustness[chosen][::-1][:least], np.sort(robustness)[:least])


@given(robustness=scores)
def test_all_are_kept_without_a_limit(robustness):
    chosen = choose(robustness, None)
    assert sorted(chosen.tolist()) == list(range(robustness.size))


def test_the_others_are_an_even_sample():
    robustness = np.arange(1000.0)
    chosen = choose(robustness, 100)
    others = np.sort(chosen[robustness[chosen] >= 25])
    assert others.size == 75
    assert np.ptp(np.diff(others)) <= 1


def test_a_quota_is_shared_by_the_stages():
    assert quota(rollouts=1200, stages=12) is None
    assert quota(rollouts=10_000, stages=1) == 3000
    assert quota(rollouts=100_000, stages=10) == 300
    assert quota(rollouts=10_000_000, stages=1000) == 10


def test_outcomes_and_probabilities_are_those_of_no_error_in_any_slot(tmp_path):
    worst = pemviz.LeastRobust()
    experiment = experiment_of("false brake", method="naive", final_rollouts=40, seed=4)
    recorded = record(experiment, tmp_path, observers=[worst])
    (stage,) = recorded.stages
    rollouts = stage.scored.rollouts
    ghost = np.array([slot.nominal for slot in experiment.folding.simulator.slots])
    found = read_stages(recorded.path)[0]
    np.testing.assert_array_equal(found.detected, (rollouts.detected == ghost).all(axis=-1))
    p = expit(rollouts.pem_logit)
    expected = np.where(ghost, p, 1.0 - p).prod(axis=-1)
    np.testing.assert_allclose(found.series["p_detected_pem"], expected, rtol=1e-12)
    assert "errs in none of them" in texts(recorded.path)[paths.CONTENTS]
    index = recorded.result.least_robust[0].rollout
    right = (rollouts.detected[index] == ghost).all(axis=-1)
    np.testing.assert_array_equal(worst.rollout.missed_steps, np.flatnonzero(~right))
    for row, (name, detected) in enumerate(zip(("car", "ghost"), (True, False), strict=True), 1):
        _, *strokes = strips(recorded.path, paths.outcomes(row))
        frame = outcome_frame(["row"] * 8, steps=15, dt_s=0.1)
        at_s = [values_at(frame, stroke)[0][0] for stroke in strokes]
        errors = rollouts.detected[index][:, row - 1] != detected
        np.testing.assert_allclose(at_s, (np.flatnonzero(errors) + 0.5) * 0.1, atol=1e-4)
        np.testing.assert_array_equal(worst.rollout.right_by_slot[name], ~errors)
    assert "perception errs about car at" in str(worst)
    assert figures.robustness_distribution(stages=[stage]).axes


def test_a_report_of_a_ghost_is_an_error_and_silence_is_none():
    slots = (Slot(name="car"), Slot(name="ghost", nominal=False))
    detected = np.array([[[True, False], [True, True], [False, False]]])
    np.testing.assert_array_equal(faultless(detected, slots=slots), [[True, False, False]])
    np.testing.assert_array_equal(faultless(detected[..., 1], slots=slots[1:]), [[1, 0, 1]])
    np.testing.assert_array_equal(faultless(detected[..., 0], slots=()), detected[..., 0])
    logit = np.log(np.array([[[3.0, 1.0 / 4.0]]]))
    np.testing.assert_allclose(faultless_probability(logit, slots=slots), [[0.75 * 0.8]])


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
        measured_memory=False,
    )
    experiment = build_experiment(config)
    pem = constant_pem(detection_probability=0.8)
    problem = replace(experiment.problem, pem=pem)
    listener = Listener()
    run(replace(experiment, problem=problem), observers=[listener])
    return listener.stages


@pytest.mark.parametrize(
    "method",
    ["adaptive", "mixture", "zero-variance", "splitting", "subset", "monte-carlo", "naive"],
)
def test_no_interval_contradicts_its_estimate(method):
    figures = [stage_figures(stage, method=method) for stage in stages_of(method)]
    assert any(row.failures for row in figures)
    for row in figures:
        if row.log10_ci_low is None or row.log10_probability is None:
            continue
        assert row.log10_ci_low <= row.log10_probability <= row.log10_ci_high


@pytest.mark.parametrize("method", ["splitting", "subset"])
def test_a_run_of_particles_has_an_estimate_and_no_interval(method):
    """One run tells nothing of how far runs differ, and its particles carry no weights."""
    for stage in stages_of(method):
        row = stage_figures(stage, method=method)
        assert row.log10_probability == stage.log10_probability < 0.0
        assert (row.log10_ci_low, row.log10_ci_high) == (None, None)


def test_a_share_has_the_exact_binomial_interval():
    (stage,) = stages_of("monte-carlo")
    row = stage_figures(stage, method="monte-carlo")
    exact = stats.binomtest(row.failures, row.rollouts).proportion_ci(0.95, method="exact")
    assert row.log10_ci_high == pytest.approx(math.log10(exact.high))


def test_zero_variance_with_frailty_is_recorded(tmp_path):
    """Its proposal takes states of one step; with a step for each gap the run failed."""
    words = "--method zero-variance --memory-s 0.25 --frailty 0.7 --scenario.states 40"
    spec = ("--spec", "always[0,39] (gap >= 9.0)", "--no-plan", "--no-measured-memory")
    out = ("--final-rollouts", "20", "--out", str(tmp_path))
    assert main(["record", *words.split(), *spec, *out]) == 0
    (recording,) = tmp_path.glob("*/run.rrd")
    assert recording.stat().st_size > 0
