"""k-hat is arviz-stats', to the last bit, and that of distributions whose shape is known."""

import numpy as np
import pytest
from arviz_stats.base.array import array_stats
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.sampling.estimates.importance_weights import fitted_shape, pareto_k_hat, tail_shape


def by_arviz(log_weight):
    """k-hat of weights; psislw takes log likelihoods, whose negatives are its log weights."""
    with np.errstate(all="ignore"):
        return float(array_stats.psislw(-log_weight)[1])


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(25, 2000),
    spread=st.floats(1e-6, 30.0),
    centre=st.floats(-700.0, 50.0),
    digits=st.integers(0, 15),
)
@settings(deadline=None, max_examples=150)
def test_it_is_arviz_stats_to_the_last_bit(seed, count, spread, centre, digits):
    rng = np.random.default_rng(seed)
    log_weight = centre + np.round(spread * rng.standard_normal(count), digits)  # ties too
    try:
        expected = by_arviz(log_weight)
    except ValueError:
        with pytest.raises(ValueError, match="the same"):
            tail_shape(log_weight)
        return
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(tail_shape(log_weight), expected)


@pytest.mark.parametrize("shape", [0.2, 0.5, 0.9])
def test_the_shape_of_a_pareto_distribution(shape):
    # the estimator's standard deviation is about (1 + k) / sqrt(n): 0.02; false alarms below 1e-6
    uniform = np.random.default_rng(3).random(10_000)
    excess = np.sort(np.expm1(-shape * np.log(uniform)) / shape)
    assert fitted_shape(excess) == pytest.approx(shape, abs=0.1)


def test_where_there_is_no_figure():
    rng = np.random.default_rng(0)
    assert pareto_k_hat(rng.standard_normal(24)) is None  # a tail of four
    assert pareto_k_hat(np.zeros(100)) is None
    one_alone = np.concatenate([np.full(99, -900.0), [0.0]])
    assert pareto_k_hat(one_alone) == by_arviz(one_alone)
    assert pareto_k_hat(rng.standard_normal(25)) is not None
