"""Samples of labelled obstacles, against scipy's own exact binomial bounds and tails."""

import math

import numpy as np
import pytest
from scipy.stats import binom, binomtest

from pemviz.analysis.binomial_plan import (
    MOST_LABELS,
    fewest_obstacles,
    labels_if_none_missed,
    labels_needed,
)


def upper(missed, obstacles, *, confidence):
    test = binomtest(missed, obstacles, alternative="less")
    return test.proportion_ci(confidence, method="exact").high


@pytest.mark.parametrize("missed", [0, 1, 7, 40])
@pytest.mark.parametrize("bound", [1e-4, 0.013, 0.3, 0.97])
def test_the_fewest_obstacles_show_the_bound_and_one_less_does_not(missed, bound):
    found = fewest_obstacles(missed, bound=bound, confidence=0.98)
    assert upper(missed, found, confidence=0.98) <= bound * (1.0 + 1e-7)
    if found > missed + 1:
        assert upper(missed, found - 1, confidence=0.98) > bound


def test_the_planned_sample_is_the_smallest_that_is_likely_enough_to_do():
    """By trying every number of misses that may be allowed."""
    known = {"obstacles": 60, "missed": 1}
    plan = labels_needed(**known, bound=0.03, assumed=0.01, confidence=0.95, power=0.9)
    total = plan.labels + 60
    assert upper(1 + plan.most_missed, total, confidence=0.95) <= 0.03
    assert upper(1 + plan.most_missed, total - 1, confidence=0.95) > 0.03
    assert plan.power == pytest.approx(binom.cdf(plan.most_missed, plan.labels, 0.01))
    assert plan.power >= 0.9
    fewer = fewest_obstacles(plan.most_missed, bound=0.03, confidence=0.95) - 60
    assert binom.cdf(plan.most_missed - 1, fewer, 0.01) < 0.9


def test_none_missed_is_the_rule_of_three():
    """1 - (1 - u)^n = 0.95: n is the least whole number above 3.0 / u."""
    for bound in (0.2, 0.01, 1e-3):
        labels = labels_if_none_missed(obstacles=0, missed=0, bound=bound, confidence=0.95)
        assert labels == math.ceil(math.log(0.05) / math.log1p(-bound))
    assert labels_if_none_missed(obstacles=400, missed=0, bound=0.01, confidence=0.95) == 0


def test_a_detector_that_misses_too_often_shows_nothing():
    often = {"obstacles": 0, "missed": 0, "confidence": 0.95}
    assert labels_needed(**often, bound=0.01, assumed=0.01) is None
    assert labels_needed(**often, bound=0.01, assumed=0.009999) is None  # over MOST_LABELS
    assert MOST_LABELS < 1e8


def test_what_is_labelled_already_needs_nothing_more():
    plan = labels_needed(obstacles=500, missed=0, bound=0.01, assumed=0.002, confidence=0.95)
    assert (plan.labels, plan.power) == (0, 1.0)
    assert np.isclose(upper(0, 500, confidence=0.95), 0.00597, rtol=1e-2)
