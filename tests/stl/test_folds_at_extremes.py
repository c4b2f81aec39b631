"""Folds of whole rollouts where numbers are hard: by loops, by numpy and by the definitions."""

import math

import numpy as np
import pytest

from pemviz.errors import InputError
from pemviz.stl import Agm, Classical, SmoothCumulative, compiled, parse

from . import naive
from .test_compiled_folds import LOOPS, by_numpy, robustness_by_loops

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
LENGTHS = (1, 2, 7, 8, 9, 15, 16, 17, 31, 33, 64, 65, 100, 129)
THRESHOLD = 0.25


@pytest.fixture(params=["as they stand", pytest.param("compiled", marks=pytest.mark.slow)])
def loops(request):
    """The loops; compiling takes seconds."""
    if request.param == "as they stand":
        return LOOPS
    pytest.importorskip("numba")
    return compiled.compiled_loops()


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


def answer(way, *args):
    """Values, or the words of an error."""
    try:
        return way(*args)
    except InputError as error:
        return str(error)


def within(rows, metric):
    """Those rows that the metric's bounds allow."""
    if not isinstance(metric, Agm):
        return rows
    low, high = metric.bounds["gap"]
    return rows[((rows >= low) & (rows <= high)).all(axis=1)]


def formulas(states):
    yield f"always[0,{states - 1}] (gap >= {THRESHOLD})"
    yield f"always[{states // 3},{states // 2}] ({THRESHOLD} > gap)"
    yield f"eventually[{states // 2},{states - 1}] (gap <= {THRESHOLD})"


@pytest.mark.parametrize("metric", METRICS, ids=str)
@pytest.mark.parametrize("order", "CF")
def test_loops_and_numpy_agree_to_the_last_bit(loops, metric, order):
    for states in LENGTHS:
        rows = within(hard_rollouts(states), metric)
        for text in formulas(states):
            if "eventually" in text and isinstance(metric, SmoothCumulative):
                continue
            batch = {"gap": np.array(rows, order=order)}
            found = answer(robustness_by_loops, parse(text), batch, metric, loops)
            np.testing.assert_array_equal(found, answer(by_numpy, parse(text), batch, metric))


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
def test_loops_agree_with_the_definitions(loops, metric):
    for states in (1, 8, 17, 100):
        rows = within(hard_rollouts(states), metric)
        formula = parse(next(formulas(states)))
        found = robustness_by_loops(formula, {"gap": rows}, metric, loops)
        expected = [defined(formula, gap, metric) for gap in rows]
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("metric", METRICS, ids=str)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("states", [1, 8, 11])
def test_what_is_not_finite_is_refused_wherever_it_stands(loops, metric, value, states):
    formula = parse(f"always[0,{states - 1}] (gap >= {THRESHOLD})")
    for step in range(states):
        gap = np.full((3, states), 0.5)
        gap[1, step] = value
        with pytest.raises(InputError, match=f"rollout 1, step {step}"):
            robustness_by_loops(formula, {"gap": gap}, metric, loops)
