"""Quantile functions of latents, against scipy's in either tail."""

import numpy as np
import pytest
from scipy import stats

from pemviz import quantiles
from pemviz.errors import ConfigError

Z = np.array([-8.0, -3.0, -0.5, 0.0, 0.5, 3.0, 8.0])
TAIL = stats.norm.sf(np.abs(Z))
SAMPLE = np.random.default_rng(0).gamma(2.0, size=50)


def by_tail(of):
    return np.where(Z < 0.0, of.ppf(TAIL), of.isf(TAIL))


@pytest.mark.parametrize(
    ("found", "of"),
    [
        (quantiles.normal(Z, mean=2.0, sd=3.0), stats.norm(2.0, 3.0)),
        (quantiles.log_normal(Z, median=2.0, spread=0.4), stats.lognorm(0.4, scale=2.0)),
        (quantiles.distribution(Z, stats.gamma(2.0)), stats.gamma(2.0)),
    ],
)
def test_both_tails_are_exact(found, of):
    np.testing.assert_allclose(found, by_tail(of), rtol=1e-11)
    assert np.all(np.diff(found) > 0.0)


def test_uniform_keeps_its_digits_at_both_ends():
    found = quantiles.uniform(Z, low=0.0, high=2.0)
    np.testing.assert_allclose(found[:4], 2.0 * TAIL[:4], rtol=1e-14)
    np.testing.assert_allclose(2.0 - found[3:6], 2.0 * TAIL[3:6], rtol=1e-12)
    assert quantiles.uniform(-Z, low=-2.0, high=0.0)[0] == -2.0 * TAIL[0]


def test_empirical_is_the_quantile_of_the_sample():
    share = np.linspace(0.001, 0.999, 57)
    found = quantiles.empirical(stats.norm.ppf(share), sample=SAMPLE)
    np.testing.assert_allclose(found, np.quantile(SAMPLE, share), rtol=1e-10)
    low, high = quantiles.empirical(np.array([-40.0, 40.0]), sample=SAMPLE)
    assert (low, high) == (SAMPLE.min(), SAMPLE.max())


def test_parameters_may_differ_from_one_value_to_the_next():
    sd = np.linspace(1.0, 2.0, 7)
    np.testing.assert_array_equal(quantiles.normal(Z, mean=sd, sd=sd), sd + sd * Z)
    found = quantiles.uniform(Z, low=sd, high=2.0 * sd)
    np.testing.assert_allclose(found, sd + sd * stats.norm.cdf(Z), rtol=1e-14)
    with pytest.raises(ConfigError, match=r"normal: sd = -0\.5"):
        quantiles.normal(Z, mean=0.0, sd=sd - 1.5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: quantiles.normal(Z, mean=0.0, sd=0.0), "normal: sd = 0: must be above 0"),
        (lambda: quantiles.log_normal(Z, median=-1.0, spread=1.0), "median = -1"),
        (lambda: quantiles.log_normal(Z, median=1.0, spread=np.nan), "spread = nan"),
        (
            lambda: quantiles.uniform(Z, low=1.0, high=1.0),
            "high - low = 0: must be above 0",
        ),
        (lambda: quantiles.empirical(Z, sample=np.ones(1)), "1 values: must be two"),
        (
            lambda: quantiles.empirical(Z, sample=np.array([1.0, np.inf])),
            "must be two finite",
        ),
    ],
)
def test_what_is_no_distribution_is_refused(call, words):
    with pytest.raises(ConfigError, match=words):
        call()
