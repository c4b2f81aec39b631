"""Adaptive multiple importance sampling against exactly known probabilities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
from pemviz.sampling.mixture.balance_heuristic import balance_weights
from pemviz.sampling.mixture.fit import smoothing_exponent
from pemviz.sampling.mixture.method import MixtureSampling
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_problem_of,
)
from tests.toy import carried_out, simulated_in


def run(problem, *, repetition=0, rollouts=60, final=60, stages=6, seed=11):
    method = MixtureSampling(
        learning_stages=stages, rollouts=rollouts, final_rollouts=final, seed=seed
    )
    estimate, results = carried_out(method, problem, repetition=repetition)
    assert len(results) == method.stages
    return estimate, results


def test_close_to_the_truth_and_covering_it():
    """40 runs of 700 rollouts at a probability of 6e-8.

    Fewer than 31 covering would happen with probability 4e-4 at a true 90 %.
    """
    simulator, pem = ToySimulator(initial_gap=6, states=18), ToyPem(at_zero=3.5)
    truth = toy_probability_by_recursion(simulator, pem)
    problem = toy_problem_of(simulator, pem)
    found = [
        run(problem, repetition=repetition, rollouts=100, final=100, stages=5)[0]
        for repetition in range(40)
    ]
    ratio = np.array([estimate.probability for estimate in found]) / truth
    assert np.sqrt(np.mean((ratio - 1.0) ** 2)) < 0.1
    assert sum(e.ci_low < truth < e.ci_high for e in found) >= 31


def test_frozen_batch_is_unbiased():
    """Mean of 30 frozen batches, t-test at level 1e-4; the seed is fixed."""
    simulator, pem = ToySimulator(initial_gap=6, states=18), ToyPem(at_zero=3.5)
    truth = toy_probability_by_recursion(simulator, pem)
    problem = toy_problem_of(simulator, pem)
    found = [run(problem, repetition=repetition, stages=4)[0] for repetition in range(30)]
    ratio = [estimate.unbiased_probability / truth for estimate in found]
    assert stats.ttest_1samp(ratio, 1.0).pvalue > 1e-4


def test_all_rollouts_count():
    found, stages = run(toy_problem_of(ToySimulator(), ToyPem()), rollouts=30, final=20, stages=3)
    assert found.rollouts_in_estimate == 4 * 30 + 20 < found.rollouts_simulated
    assert found.rollouts_simulated == simulated_in(stages)
    assert [stage.kind for stage in stages] == ["pretrain", "learn", "learn", "learn", "final"]
    assert stages[-1].learned is None
    assert all(stage.learned is not None for stage in stages[:-1])


def test_same_seed_same_digits():
    problem = toy_problem_of(ToySimulator(), ToyPem())
    first, second = (run(problem, rollouts=30, final=20, stages=3)[0] for _ in range(2))
    assert first == second


def test_violations_that_nothing_reaches_are_reported_as_such():
    found, _ = run(toy_problem_of(ToySimulator(initial_gap=8, states=5), ToyPem()), rollouts=20)
    assert found.failures == 0
    assert found.probability == 0.0
    assert found.log10_probability is None
    assert found.ci_high is None
    assert found.warnings


def test_long_rollouts_stay_finite():
    """1,000 steps with 990 misses needed; whatever is found, no figure overflows."""
    simulator, pem = (
        ToySimulator(initial_gap=990, largest_gap=990, states=1000),
        ToyPem(at_zero=8.0, slope=0.0),
    )
    found, _ = run(toy_problem_of(simulator, pem), rollouts=20, final=20, stages=2)
    assert np.isfinite(found.probability)
    assert found.log10_probability is None or np.isfinite(found.log10_probability)


@given(st.lists(st.floats(-50.0, 50.0), min_size=12, max_size=12))
def test_balance_weights_sum_over_the_mixture(values):
    ratio = np.array(values).reshape(6, 2)
    component = np.array([0, 0, 0, 0, 1, 1])
    expected = -np.log((4 * np.exp(ratio[:, 0]) + 2 * np.exp(ratio[:, 1])) / 6)
    np.testing.assert_allclose(balance_weights(ratio, component), expected, rtol=1e-9, atol=1e-12)


def test_balance_weights_at_ten_thousand_nats():
    ratio = np.array([[1e4, -1e4], [-1e4, -1e4]])
    weights = balance_weights(ratio, np.array([0, 1]))
    np.testing.assert_allclose(weights, [np.log(2) - 1e4, 1e4], rtol=1e-12)


@given(
    log_weight=st.lists(st.floats(-400.0, 400.0), min_size=5, max_size=40),
    share=st.floats(0.05, 0.95),
)
def test_smoothing_leaves_the_effective_sample_size(log_weight, share):
    values = np.array(log_weight)
    least = share * values.size
    exponent = smoothing_exponent(values, least_ess=least)
    found = effective_sample_size(exponent * values)
    assert 0.0 <= exponent <= 1.0
    assert found == pytest.approx(least, rel=0.02) or (exponent == 1.0 and found >= least)
