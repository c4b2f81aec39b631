"""Whole rollouts where numbers are hard, by the definitions; and where a margin is exactly 0."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.errors import InputError
from pemviz.stl import (
    Agm,
    Classical,
    SmoothCumulative,
    parse,
    robustness,
    smooth_cumulative,
    violated,
)

from . import naive
from .strategies import BOUNDS, lawful

WIDE = {"gap": (-1e150, 1e150)}
METRICS = (
    Classical(),
    Agm(WIDE),
    Agm({"gap": (-1.0, 1.0)}),
    SmoothCumulative(),
    SmoothCumulative(part="negative"),
    SmoothCumulative(beta=1e-3),
    SmoothCumulative(beta=1e6),
)
THRESHOLD = 0.25


def hard_rollouts(states):
    """Rows [n, states], each hard in a way of its own."""
    rng = np.random.default_rng(states)
    at = rng.integers(0, states, 5)
    rows = {
        "all on the threshold": np.full(states, THRESHOLD),
        "all zero": np.zeros(states),
        "both zeros": np.where(rng.random(states) < 0.5, 0.0, -0.0),
        "denormal": rng.choice([5e-324, -5e-324, 2.0**-1060, 0.0], states),
        "next to the threshold": THRESHOLD + rng.choice([-1.0, 1.0], states) * 2.0**-54,
        "above by a last digit": np.full(states, np.nextafter(THRESHOLD, 1.0)),
        "all equal": np.full(states, 0.75),
        "far apart": rng.choice([-1e150, 1e150, 1e-150, 1.0], states),
        "far above": np.full(states, 1e150),
        "far below": np.full(states, -1e150),
        "falling": THRESHOLD + np.linspace(0.9, 1e-9, states),
        "about the reach": THRESHOLD + rng.choice([0.0, 0.5, 0.56, 0.57, 0.6], states),
        "one step fails": np.where(np.arange(states) == at[0], 0.2499, 0.9),
        "one step is on it": np.where(np.arange(states) == at[1], THRESHOLD, 0.9),
        "ties": rng.choice([0.3, 0.35], states),
    }
    return np.array(list(rows.values()))


def within(rows, metric):
    """Those rows that the metric's bounds allow."""
    if not isinstance(metric, Agm):
        return rows
    low, high = metric.bounds["gap"]
    return rows[((rows >= low) & (rows <= high)).all(axis=1)]


def defined(formula, gap, metric):
    signals = {"gap": [float(value) for value in gap]}
    match metric:
        case Classical():
            return naive.classical(formula, signals)
        case Agm(bounds=bounds):
            return naive.agm(formula, signals, bounds)
        case SmoothCumulative(beta=beta, part=part):
            return naive.smooth(formula, signals, beta, part == "positive")


@pytest.mark.parametrize("metric", METRICS, ids=str)
@pytest.mark.parametrize("states", [1, 8, 17, 100])
def test_whole_rollouts_agree_with_the_definitions(metric, states):
    rows = within(hard_rollouts(states), metric)
    formula = parse(f"always[0,{states - 1}] (gap >= {THRESHOLD})")
    found = robustness(formula, {"gap": rows}, metric)
    expected = [defined(formula, gap, metric) for gap in rows]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("metric", METRICS, ids=str)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("states", [1, 8, 11])
def test_what_is_not_finite_is_refused_wherever_it_stands(metric, value, states):
    formula = parse(f"always[0,{states - 1}] (gap >= {THRESHOLD})")
    for step in range(states):
        gap = np.full((3, states), 0.5)
        gap[1, step] = value
        with pytest.raises(InputError, match=f"rollout 1, step {step}"):
            robustness(formula, {"gap": gap}, metric)


def test_a_step_exactly_on_the_threshold_leaves_nothing_of_either_sign():
    """Where agm is discontinuous; whether it violates is up to the comparison."""
    gap = np.full((2, 9), 5.0)
    gap[1, 4] = 2.0
    always, metric = parse("always[0,8] (gap >= 2)"), Agm(BOUNDS)
    np.testing.assert_allclose(robustness(always, {"gap": gap}, metric), [3.0 / 50.0, 0.0])
    lowest = robustness(parse("eventually[0,8] (gap <= 2)"), {"gap": gap}, metric)
    np.testing.assert_allclose(lowest, [-3.0 / 50.0, 0.0])
    assert not violated(always, {"gap": gap}).any()
    strict = parse("always[0,8] (gap > 2)")
    np.testing.assert_array_equal(violated(strict, {"gap": gap}), [False, True])


def test_both_zeros_lie_within_a_bound_of_zero():
    speed = np.array([[0.0, -0.0, 3.0], [-0.0, 0.0, 0.0]])
    formula = parse("always[0,2] (ego_speed <= 1)")
    assert robustness(formula, {"ego_speed": speed}, Agm({"ego_speed": (0.0, 40.0)})).shape == (2,)
    below = Agm({"ego_speed": (-40.0, 0.0)})
    assert robustness(formula, {"ego_speed": -speed}, below).shape == (2,)


@settings(lawful, max_examples=200)
@given(
    st.integers(0, 2**32 - 1), st.sampled_from((0.01, 1.0, 20.0)), st.booleans(),
    st.integers(1, 90), st.integers(1, 9),
)  # fmt: skip
def test_few_and_many_near_steps_add_up_to_the_same_digits(seed, scale, positive, width, count):
    rng = np.random.default_rng(seed)
    margin = rng.normal(rng.normal(0.0, 2.0 * scale), scale, (width, count))
    metric = SmoothCumulative(5.0, "positive" if positive else "negative")

    def soft_minimum(margin):
        return metric.always_predicate(None, margin, width)[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(smooth_cumulative, "FEW", 0)
        few = soft_minimum(margin)
        patch.setattr(smooth_cumulative, "FEW", width * count + 1)
        many = soft_minimum(margin)
    np.testing.assert_array_equal(few, many)
    alone = [soft_minimum(np.ascontiguousarray(column[:, None]))[0] for column in margin.T]
    np.testing.assert_array_equal(alone, soft_minimum(margin))
