"""Expected robustness and that of the worst hundredth, against closed forms of the normal law."""

import json

import numpy as np
import pytest
from scipy import stats

from pemviz.analysis.robustness_tail import robustness_tail
from pemviz.config import ExperimentConfig
from pemviz.runs.engine import run_experiment
from pemviz.runs.observers import KeptStages
from pemviz.runs.result_file import result_document, result_from_document

WORST = 0.01
MEAN, SD = 3.0, 2.0
QUANTILE = stats.norm.ppf(WORST, MEAN, SD)
SHORTFALL = MEAN - SD * stats.norm.pdf(stats.norm.ppf(WORST)) / WORST
"""The mean of the worst hundredth of a normal robustness."""
SEEDS = 200


def weighted(rng, count, *, shift):
    """Half drawn from the law itself, half from it moved down, weighed against both."""
    moved = rng.random(count) < 0.5
    values = rng.normal(MEAN, SD, count) - shift * moved
    log_p = stats.norm.logpdf(values, MEAN, SD)
    log_q = np.logaddexp(log_p, stats.norm.logpdf(values, MEAN - shift, SD)) - np.log(2.0)
    return values, log_p - log_q


@pytest.mark.parametrize("shift", [0.0, 4.0])
def test_both_means_are_unbiased_and_their_errors_hold(shift):
    """A z beyond 4.5 in one of four comparisons: false alarms below 1 in 30,000."""
    found = [
        robustness_tail(*weighted(np.random.default_rng(seed), 4000, shift=shift))
        for seed in range(SEEDS)
    ]
    for values, errors, truth, rough in (
        ([f.expected for f in found], [f.expected_std_error for f in found], MEAN, 0.0),
        ([f.worst for f in found], [f.worst_std_error for f in found], SHORTFALL, 0.02),
    ):
        spread = np.std(values, ddof=1)
        assert abs(np.mean(values) - truth) < 4.5 * spread / np.sqrt(SEEDS) + rough
        assert spread == pytest.approx(np.mean(errors), rel=0.3)
    assert np.mean([f.quantile for f in found]) == pytest.approx(QUANTILE, abs=0.05)


def test_importance_weights_sharpen_the_worst():
    plain, sharp = (
        robustness_tail(*weighted(np.random.default_rng(1), 4000, shift=shift))
        for shift in (0.0, 4.0)
    )
    assert sharp.worst_std_error < 0.6 * plain.worst_std_error


def test_rollouts_that_were_drawn_where_violations_are_tell_nothing():
    rng = np.random.default_rng(2)
    values = rng.normal(MEAN - 8.0 * SD, SD, 4000)
    log_weight = stats.norm.logpdf(values, MEAN, SD) - stats.norm.logpdf(
        values, MEAN - 8.0 * SD, SD
    )
    assert robustness_tail(values, log_weight) is None
    assert robustness_tail(values, np.full(4000, -30.0)) is None
    assert robustness_tail(np.append(values, -np.inf), np.zeros(4001)) is None


def test_what_weights_are_short_of_their_sum_is_no_robustness():
    """They lack a twentieth of what has no other robustness: the mean is it, and known."""
    log_weight = np.log(np.random.default_rng(4).uniform(0.9, 1.0, 4000))
    found = robustness_tail(np.full(4000, 1.5), log_weight)
    assert found.expected == pytest.approx(1.5, rel=1e-12)
    assert found.expected_std_error < 1e-12
    assert found.worst == pytest.approx(1.5, rel=1e-12)


def test_too_few_of_the_worst_tell_the_mean_alone():
    values, log_weight = weighted(np.random.default_rng(3), 400, shift=0.0)
    found = robustness_tail(values, log_weight)
    assert found.expected == pytest.approx(MEAN, abs=4.5 * found.expected_std_error)
    assert found.worst is None


def test_a_run_tells_what_its_rollouts_have_and_keeps_it():
    """Plain rollouts weigh the same: the means are those of numpy."""
    kept = KeptStages()
    config = ExperimentConfig(
        method="monte-carlo",
        final_rollouts=3000,
        memory_s=0.25,
        frailty=0.68,
        seed=3,
        measured_memory=False,
    )
    result = run_experiment(config, observers=[kept])
    (stage,) = kept.stages
    robustness = np.sort(stage.scored.robustness)
    found = result.robustness_tail
    assert found.rollouts == robustness.size
    assert found.expected == pytest.approx(np.mean(robustness), rel=1e-12)
    assert found.worst == pytest.approx(np.mean(robustness[:30]), rel=1e-9)
    read = result_from_document(json.loads(json.dumps(result_document(result))))
    assert read.robustness_tail == found


def test_proposals_that_look_for_violations_alone_tell_nothing():
    rare = run_experiment(
        ExperimentConfig(
            method="zero-variance", final_rollouts=100, plan=False, measured_memory=False
        )
    )
    assert rare.robustness_tail is None
    assert "robustness_tail" not in result_document(rare)
