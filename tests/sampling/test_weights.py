from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pemviz.sampling.estimates.importance_weights import (
    effective_sample_size,
    largest_share,
    log_mean_failing_weight,
    log_std_error,
    smoothed_weights,
)
from pemviz.sampling.method import elite_threshold, elites

logs = arrays(np.float64, st.integers(2, 30), elements=st.floats(-30, 30))


@given(logs, st.floats(0, 1))
def test_smoothed_weights_are_powers_that_sum_to_one(log_weight, alpha):
    weight = smoothed_weights(log_weight, alpha=alpha)
    assert weight.sum() == pytest.approx(1.0)
    naive = np.exp(log_weight) ** alpha
    np.testing.assert_allclose(weight, naive / naive.sum(), rtol=1e-12)


@given(logs, st.data())
def test_estimate_and_error_agree_with_the_plain_formulas(log_weight, data):
    violated = data.draw(arrays(np.bool_, log_weight.size))
    terms = np.exp(log_weight) * violated
    if not violated.any():
        assert log_mean_failing_weight(log_weight, violated) == -np.inf
        return
    assert np.exp(log_mean_failing_weight(log_weight, violated)) == pytest.approx(terms.mean())
    error = np.std(terms, ddof=1) / np.sqrt(terms.size)
    assert np.exp(log_std_error(log_weight, violated)) == pytest.approx(
        error, rel=1e-6, abs=1e-9 * terms.max()
    )


def test_weights_far_below_double_precision_keep_their_logs():
    log_weight = np.array([-10_000.0, -10_001.0, -9_000.0])
    violated = np.array([True, True, False])
    expected = -10_000.0 + np.log((1.0 + np.exp(-1.0)) / 3.0)
    assert log_mean_failing_weight(log_weight, violated) == pytest.approx(expected, abs=1e-9)
    assert np.isfinite(log_std_error(log_weight, violated))
    assert 1.0 < effective_sample_size(log_weight[violated]) < 2.0


def test_a_huge_weight_of_a_rollout_that_does_not_violate_changes_nothing():
    log_weight = np.array([0.0, 0.0, 5_000.0])
    violated = np.array([True, True, False])
    assert np.exp(log_mean_failing_weight(log_weight, violated)) == pytest.approx(2 / 3)
    assert np.exp(log_std_error(log_weight, violated)) == pytest.approx(1 / 3)


@given(logs)
def test_effective_sample_size_and_share(log_weight):
    weight = np.exp(log_weight)
    assert effective_sample_size(log_weight) == pytest.approx(
        weight.sum() ** 2 / (weight**2).sum(), rel=1e-9
    )
    assert largest_share(log_weight) == pytest.approx(weight.max() / weight.sum(), rel=1e-9)
    assert 1.0 - 1e-9 <= effective_sample_size(log_weight) <= log_weight.size + 1e-9


@given(
    st.lists(st.floats(-10, 10), min_size=1, max_size=200),
    st.sampled_from(["0.95", "0.96", "0.97", "0.98", "0.99"]),
)
def test_threshold_is_the_papers_order_statistic(values, sigma):
    robustness = np.array(values)
    index = min(int(Fraction(sigma) * len(values)), len(values) - 1)  # exact floor
    expected = max(sorted(values, reverse=True)[index], 0.0)
    assert elite_threshold(robustness, sigma=float(sigma)) == expected
    chosen = elites(robustness, threshold=expected)
    assert chosen.sum() == sum(value <= expected for value in values)


def test_a_hundred_rollouts_have_five_elites():
    robustness = np.arange(1.0, 101.0)
    threshold = elite_threshold(robustness, sigma=0.95)
    assert threshold == 5.0
    assert elites(robustness, threshold=threshold).sum() == 5
