"""Exponentials in log space: sums are scipy's, to the last bit; softplus is numpy's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy.special import logsumexp

from pemviz.arrays import log_sum_exp, softplus

NUMBERS = st.floats(-1e4, 1e4) | st.sampled_from([-np.inf, np.inf, 0.0, -0.0, 1.0])


@given(
    values=arrays(np.float64, array_shapes(max_dims=3, max_side=40), elements=NUMBERS),
    order=st.sampled_from("CF"),
    data=st.data(),
)
@settings(deadline=None)
def test_it_is_scipys_to_the_last_bit(values, order, data):
    values = np.asarray(values, order=order)
    axis = data.draw(st.sampled_from([None, *range(values.ndim)]))
    expected = logsumexp(values, axis=axis)
    found = log_sum_exp(values, axis=axis)
    assert np.shape(found) == np.shape(expected)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [(0,), (0, 3), (3, 0)])
def test_of_nothing_the_sum_is_zero(shape):
    values = np.zeros(shape)
    np.testing.assert_array_equal(log_sum_exp(values), -np.inf)
    np.testing.assert_array_equal(log_sum_exp(values, axis=0), np.full(shape[1:], -np.inf))


@given(arrays(np.float64, array_shapes(max_dims=2, max_side=40), elements=NUMBERS))
def test_softplus_is_the_log_of_one_more(values):
    np.testing.assert_allclose(softplus(values), np.logaddexp(0.0, values), rtol=4e-16)
    assert softplus(np.array([-700.0, 0.0, 700.0])).tolist() == [np.exp(-700.0), np.log(2.0), 700.0]
