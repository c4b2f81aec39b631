"""Every operator under every metric, against an evaluator written from the definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.stl import Agm, Classical, SmoothCumulative, parse, robustness, robustness_trace

from . import naive
from .strategies import BOUNDS, formula_and_rollouts, lawful, row

exhaustive = settings(lawful, max_examples=500)


def expected_trace(reference, formula, batch, *args):
    count, states = batch["gap"].shape
    steps = range(states - formula.horizon_steps())
    return np.array(
        [[reference(formula, row(batch, i), *args, t=t) for t in steps] for i in range(count)]
    )


def assert_agrees(formula, batch, metric, reference, *args, exact=False):
    expected = expected_trace(reference, formula, batch, *args)
    whole, start = robustness_trace(formula, batch, metric), robustness(formula, batch, metric)
    assert whole.dtype == start.dtype == np.float64
    assert whole.shape == expected.shape
    if exact:
        np.testing.assert_array_equal(whole, expected)
        np.testing.assert_array_equal(start, expected[:, 0])
    else:
        np.testing.assert_allclose(whole, expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(start, expected[:, 0], rtol=1e-12, atol=1e-12)


# Each example is a formula with four rollouts, at one to four steps: 2,000 pairs a metric.
@exhaustive
@given(formula_and_rollouts(count=4))
def test_classical_is_exact(case):
    formula, batch = case
    assert_agrees(formula, batch, Classical(), naive.classical, exact=True)


@exhaustive
@given(formula_and_rollouts(count=4))
def test_agm(case):
    formula, batch = case
    assert_agrees(formula, batch, Agm(BOUNDS), naive.agm, BOUNDS)


@exhaustive
@given(formula_and_rollouts(count=4), st.sampled_from((75.0, 3.0, 0.25)), st.booleans())
def test_smooth_cumulative(case, beta, positive):
    formula, batch = case
    metric = SmoothCumulative(beta=beta, part="positive" if positive else "negative")
    assert_agrees(formula, batch, metric, naive.smooth, beta, positive)


@pytest.mark.parametrize("states", [1, 2, 3, 7, 16, 17, 100, 333])
def test_long_windows(states):
    """Windows of every kind of length, at one step and at many."""
    rng = np.random.default_rng(states)
    batch = {name: rng.uniform(*BOUNDS[name], (3, states + 5)) for name in BOUNDS}
    batch["gap"][0] = np.abs(batch["gap"][0]) * 0.9 + 0.1
    last = states - 1
    for text in (
        f"always[0,{last}] (gap >= 0)",
        f"eventually[0,{last}] (gap >= 20)",
        f"(x_1 >= -2.9) until[{last // 2},{last}] (gap >= 0)",
        f"always[0,{last}] (gap >= 0 or x_1 >= 0)",
    ):
        formula = parse(text)
        assert_agrees(formula, batch, Classical(), naive.classical, exact=True)
        assert_agrees(formula, batch, Agm(BOUNDS), naive.agm, BOUNDS)
        assert_agrees(formula, batch, SmoothCumulative(), naive.smooth, 75.0, True)
        assert_agrees(formula, batch, SmoothCumulative(part="negative"), naive.smooth, 75.0, False)
