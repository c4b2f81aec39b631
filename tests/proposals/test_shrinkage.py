"""Values drawn towards what they have in common, against estimates that know how they came about.

Risks are means over a thousand values; bounds leave 10 standard errors, so that none fails by
chance once in 1e20 seeds, and seeds are fixed.
"""

import numpy as np
import pytest

from pemviz.proposals.shrinkage import shrinkage

COUNT, VARIANCE = 1000, 0.04


def sampled(true, seed=0):
    values = true + np.sqrt(VARIANCE) * np.random.default_rng(seed).standard_normal(true.size)
    error = np.full(true.size, VARIANCE)
    return values, shrinkage(values, error).of(values)


def test_the_errors_of_values_that_are_the_same_are_gone():
    """Their mean is known to VARIANCE / COUNT."""
    _, found = sampled(np.full(COUNT, 0.46))
    assert np.mean((found - 0.46) ** 2) < 0.02 * VARIANCE


def test_one_that_stands_out_keeps_its_place():
    true = np.zeros(100)
    true[17] = 5.0
    values, found = sampled(true)
    assert found[17] == pytest.approx(values[17], abs=0.05)
    others = np.delete(found, 17)
    assert np.mean(others**2) < 0.1 * VARIANCE


def test_normal_values_are_known_as_well_as_by_who_knows_their_spread():
    """The least risk is v t / (v + t), for errors of variance v and values of variance t."""
    spread = 0.09
    true = 2.0 + np.sqrt(spread) * np.random.default_rng(1).standard_normal(COUNT)
    _, found = sampled(true)
    least = VARIANCE * spread / (VARIANCE + spread)
    assert np.mean((found - true) ** 2) < least * (1.0 + 10.0 * np.sqrt(2.0 / COUNT))


def test_values_far_apart_stay():
    true = 10.0 * np.arange(12.0)
    values, found = sampled(true)
    np.testing.assert_allclose(found, values, atol=0.02)


def test_few_values_tell_nothing_of_each_other():
    values = np.array([1.0, 1.01, 1.02])
    np.testing.assert_array_equal(shrinkage(values, np.full(3, 1.0)).of(values), values)


def test_it_does_not_depend_on_where_values_lie():
    values = np.random.default_rng(2).standard_normal(40)
    one, other = (shrinkage(some, np.full(40, 0.5)) for some in (values, values + 7.0))
    np.testing.assert_allclose(one.own, other.own, rtol=1e-9)
    np.testing.assert_allclose(one.of(values) + 7.0, other.of(values + 7.0), rtol=1e-9)
