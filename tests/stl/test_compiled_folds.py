"""Loops give what numpy's operators give, to the last bit, errors included."""

import importlib.util

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pemviz import compiling
from pemviz.errors import InputError
from pemviz.stl import (
    Agm,
    Classical,
    SmoothCumulative,
    compiled,
    dominant,
    evaluation,
    folds,
    parse,
    robustness,
    violated,
)
from pemviz.stl import expressions as ex
from pemviz.stl import formulas as fo
from pemviz.stl import temporal as te
from pemviz.stl.classical import ClassicalSemantics

from .strategies import BOUNDS, comparisons, constants, rollouts, signals

thorough = settings(
    max_examples=200, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)
STATES = 23
METRICS = (
    Classical(),
    Agm(BOUNDS),
    SmoothCumulative(),
    SmoothCumulative(part="negative"),
    SmoothCumulative(beta=0.3),
)
predicates = st.one_of(
    st.builds(ex.Predicate, signals, comparisons, constants),
    st.builds(ex.Predicate, constants, comparisons, signals),
)
terms = st.recursive(
    st.one_of(signals, constants),
    lambda parts: st.one_of(
        st.builds(ex.Sum, parts, parts),
        st.builds(ex.Difference, parts, parts),
        st.builds(ex.Product, parts, parts),
        parts.map(ex.Negative),
        parts.map(ex.Absolute),
    ),
    max_leaves=4,
)
predicates_of_many = st.builds(ex.Predicate, terms, comparisons, terms).filter(
    lambda predicate: predicate.signals()
)
windows = st.tuples(st.integers(0, STATES - 1), st.integers(0, STATES - 1)).map(sorted)
fold_formulas = st.builds(
    lambda kind, window, predicate: kind(*window, predicate),
    st.sampled_from((te.Always, te.Eventually)),
    windows,
    st.one_of(predicates, predicates_of_many),
)


def joined(depth=2):
    if depth == 0:
        return fold_formulas
    parts = st.deferred(lambda: joined(depth - 1))
    few = st.lists(parts, min_size=2, max_size=3).map(tuple)
    return st.one_of(
        fold_formulas,
        few.map(fo.And),
        few.map(fo.Or),
        parts.map(fo.Not),
        st.builds(fo.Implies, parts, parts),
    )


def loops_as_they_stand():
    """The loops' module, not compiled: in Python, as they are written."""
    with pytest.MonkeyPatch.context() as patch:
        for way in ("translated", "inlined"):
            patch.setattr(compiling, way, lambda function: function)
        spec = importlib.util.find_spec("pemviz.stl.loops")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


LOOPS = loops_as_they_stand()


@pytest.fixture(params=["blocks of all", "blocks of few"])
def by_loops(request, monkeypatch):
    """Robustness by the loops."""
    if request.param == "blocks of few":
        for name in ("BLOCK_VALUES", "COPIED_VALUES", "EXPONENTS"):
            monkeypatch.setattr(folds, name, 64)
    return robustness_by_loops


def robustness_by_loops(formula, batch, metric, loops=LOOPS):
    """It fails where they are not asked."""
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled.DECISION, "loops_for", lambda values: asked.append(values) or loops)
        try:
            return robustness(formula, batch, metric)
        finally:
            assert asked or not covers(metric, formula) or lies_by_steps(metric, batch)


def by_numpy(formula, batch, metric):
    """By the metric's operators."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "folded_robustness", lambda *_: None)
        return robustness(formula, batch, metric)


def lies_by_steps(metric, batch):
    """Whether numpy folds without the loops."""
    return metric == Classical() and all(values.T.flags.c_contiguous for values in batch.values())


def covers(metric, formula):
    """Whether the metric has bounds for all signals of the formula, if it needs any."""
    return not isinstance(metric, Agm) or formula.signals() <= metric.bounds.keys()


def is_known(formula, metric):
    """Not to the smooth metric: it folds no eventually by the loops."""
    has_eventually = any(isinstance(part, te.Eventually) for part in formula.walk())
    return not (isinstance(metric, SmoothCumulative) and has_eventually)


@thorough
@given(
    joined(), st.sampled_from(METRICS), st.integers(0, 2**32 - 1),
    st.sampled_from((1.0, 0.3, 0.02)), st.sampled_from("CF"), st.sampled_from((1, 2)),
)  # fmt: skip
def test_loops_give_numpys_values_to_the_last_bit(formula, metric, seed, scale, order, every):
    batch = {
        name: np.array(values, order=order)[::every]
        for name, values in rollouts(seed, STATES, 11, scale).items()
    }
    expected = by_numpy(formula, batch, metric)
    if is_known(formula, metric):
        np.testing.assert_array_equal(robustness_by_loops(formula, batch, metric), expected)
    np.testing.assert_array_equal(robustness(formula, batch, metric), expected)


@pytest.mark.slow  # some seconds, to compile
@pytest.mark.parametrize("metric", METRICS, ids=str)
def test_compiled_they_do_as_well(metric):
    pytest.importorskip("numba")
    loops = compiled.compiled_loops()
    assert loops is not None
    for states in (1, 2, 7, 9, 16, 100, 333):
        rng = np.random.default_rng(states)
        gap = rng.uniform(-25.0, 25.0, (200, states)) * rng.choice([1.0, 0.02], (200, 1))
        for signal in (gap, np.asfortranarray(gap), np.abs(gap) + 2.0 ** -rng.integers(0, 70)):
            batch = {"gap": np.minimum(signal, 25.0)}
            for last in {0, states // 2, states - 1}:
                formula = parse(
                    f"always[{last // 3},{last}] (gap >= 0) and always[0,{last}] (2 >= gap)"
                )
                expected = by_numpy(formula, batch, metric)
                found = robustness_by_loops(formula, batch, metric, loops)
                np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("metric", METRICS, ids=str)
@pytest.mark.parametrize("states", [1, 2, 7, 8, 9, 16, 17, 100, 333])
def test_rollouts_of_any_length(by_loops, metric, states):
    rng = np.random.default_rng(states)
    batch = {"gap": rng.uniform(-25.0, 25.0, (40, states))}
    batch["gap"][::2] = np.abs(batch["gap"][::2]) * 0.9 + 1e-9
    for text in (
        f"always[0,{states - 1}] (gap >= 0)",
        f"always[{states // 3},{states // 2}] (gap < 9)",
    ):
        formula = parse(text)
        found = by_loops(formula, batch, metric)
        np.testing.assert_array_equal(found, by_numpy(formula, batch, metric))


@pytest.mark.parametrize("metric", METRICS[1:4], ids=str)
@pytest.mark.parametrize("states", [7, 8, 13])
@pytest.mark.parametrize("count", [1, 7, 8, 9, 30])
def test_rollouts_side_by_side_in_blocks_that_do_not_come_out_even(
    monkeypatch, metric, states, count
):
    monkeypatch.setattr(folds, "COPIED_VALUES", 11 * states)
    gap = np.random.default_rng(count).uniform(-25.0, 25.0, (states, count)).T
    formula = parse(f"always[1,{states - 1}] (gap >= -24)")
    found = robustness_by_loops(formula, {"gap": gap}, metric)
    np.testing.assert_array_equal(found, by_numpy(formula, {"gap": gap}, metric))
    some = {"gap": gap[:, ::-1]}
    np.testing.assert_array_equal(
        robustness_by_loops(formula, some, metric), by_numpy(formula, some, metric)
    )


FINITE = "always[2,5] (gap >= 0)"


@pytest.mark.parametrize("metric", METRICS[:4], ids=str)
@pytest.mark.parametrize("value", [np.nan, -np.nan, np.inf, -np.inf, 25.1, -1e300])
@pytest.mark.parametrize("step", [0, 3, 11])
@pytest.mark.parametrize("order", "CF")
def test_what_is_wrong_is_told_in_the_same_words(by_loops, metric, value, step, order):
    gap = np.array(np.random.default_rng(0).uniform(-20.0, 20.0, (30, 12)), order=order)
    gap[17, step] = value
    formula = parse(FINITE)
    words = [told(way, formula, {"gap": gap}, metric) for way in (by_loops, by_numpy)]
    assert words[0] == words[1]
    assert "rollout 17" in words[0] or np.isfinite(value)


def told(way, formula, batch, metric):
    """Of an error the words, otherwise nothing."""
    try:
        way(formula, batch, metric)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("bounds", [{}, {"ego_speed": (-1.7e308, 1.7e308)}])
def test_a_metric_without_a_range_is_told_in_the_same_words(by_loops, bounds):
    batch = {"gap": np.zeros((3, 12)), "ego_speed": np.zeros((3, 12))}
    formula = parse("always[0,3] (gap >= 0) and always[0,3] (ego_speed >= 1e308)")
    metric = Agm({"gap": (-1.0, 1.0)} | bounds)
    with pytest.raises(InputError) as expected:
        by_numpy(formula, batch, metric)
    with pytest.raises(InputError) as raised:
        by_loops(formula, batch, metric)
    assert str(raised.value) == str(expected.value)


def test_both_zeros_lie_within_a_bound_of_zero(by_loops):
    speed = np.array([[0.0, -0.0, 3.0], [-0.0, 0.0, 0.0]])
    metric = Agm({"ego_speed": (0.0, 40.0)})
    formula = parse("always[0,2] (ego_speed <= 1)")
    found = by_loops(formula, {"ego_speed": speed}, metric)
    np.testing.assert_array_equal(found, by_numpy(formula, {"ego_speed": speed}, metric))
    below = Agm({"ego_speed": (-40.0, 0.0)})
    assert by_loops(formula, {"ego_speed": -speed}, below).shape == (2,)


def test_a_step_exactly_on_the_threshold_leaves_nothing_of_either_sign(by_loops):
    """Where agm is discontinuous; whether it violates is up to the comparison."""
    gap = np.full((2, 9), 5.0)
    gap[1, 4] = 2.0
    formula = parse("always[0,8] (gap >= 2)")
    assert by_loops(formula, {"gap": gap}, Agm(BOUNDS))[1] == 0.0
    assert by_loops(formula, {"gap": gap}, Agm(BOUNDS))[0] == pytest.approx(3.0 / 50.0)
    lowest = by_loops(parse("eventually[0,8] (gap <= 2)"), {"gap": gap}, Agm(BOUNDS))
    np.testing.assert_allclose(lowest, [-3.0 / 50.0, 0.0])
    assert not (by_loops(formula, {"gap": gap}, Classical()) < 0.0).any()
    assert not violated(formula, {"gap": gap}).any()
    strict = parse("always[0,8] (gap > 2)")
    np.testing.assert_array_equal(violated(strict, {"gap": gap}), [False, True])


def test_loops_serve_what_they_know_and_nothing_else():
    batch = rollouts(0, STATES)
    for text in (
        "always[0,9] (gap / ego_speed >= 2)",
        "always[0,9] (min(gap, ego_speed) >= 2)",
        "always[0,9] (1 >= 2)",
        "always[0,9] (gap >= 2 and ego_speed < 9)",
        "always[0,3] (eventually[0,4] (gap >= 2))",
        "(gap >= 2) until[0,9] (ego_speed < 3)",
        "always[0,9] (gap >= 2) and true",
        "gap >= 2",
    ):
        for order in "CF":
            some = {name: np.array(values, order=order) for name, values in batch.items()}
            assert not folds.is_served(parse(text), ClassicalSemantics(), some)


@thorough
@given(
    st.integers(0, 2**32 - 1), st.sampled_from((0.01, 1.0, 20.0)), st.booleans(),
    st.integers(1, 90), st.integers(1, 9),
)  # fmt: skip
def test_few_and_many_near_steps_add_up_to_the_same_digits(seed, scale, positive, width, count):
    rng = np.random.default_rng(seed)
    margin = rng.normal(rng.normal(0.0, 2.0 * scale), scale, (width, count))
    steps = dominant.DominantSteps(beta=5.0, positive=positive, width=width)
    base = steps.base(margin.min(axis=0))
    near = margin <= base + steps.reach
    few, many = steps._few(margin, base, near), steps._many(margin, base, near)
    np.testing.assert_array_equal(few, many)
    for i in range(count):
        alone = steps.always(np.ascontiguousarray(margin[:, i : i + 1]))
        np.testing.assert_array_equal(alone[0], steps.always(margin)[0, i : i + 1])


def test_without_numba_numpy_answers(monkeypatch):
    monkeypatch.setattr(compiled, "is_installed", lambda: False)
    assert compiled.compiled_loops.__wrapped__() is None


OF_MANY = "always[2,5] (2 * gap - abs(ego_speed) >= 1) and eventually[0,3] (ego_speed + gap > 0)"


@pytest.mark.parametrize("metric", [Classical(), Agm(BOUNDS)], ids=str)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 41.0, 1e308])
@pytest.mark.parametrize("step", [0, 3, 11])
@pytest.mark.parametrize("order", "CF")
def test_what_is_wrong_in_one_of_several_signals_is_told_in_the_same_words(
    by_loops, metric, value, step, order
):
    rng = np.random.default_rng(0)
    batch = {
        "gap": np.array(rng.uniform(-20.0, 20.0, (30, 12)), order=order),
        "ego_speed": np.array(rng.uniform(0.0, 20.0, (30, 12)), order=order),
    }
    formula = parse(OF_MANY)
    expected = by_numpy(formula, batch, metric)
    np.testing.assert_array_equal(by_loops(formula, batch, metric), expected)
    batch["ego_speed"][17, step] = value
    words = [told(way, formula, batch, metric) for way in (by_loops, by_numpy)]
    assert words[0] == words[1]
    assert "rollout 17" in words[0] or (metric == Classical() and np.isfinite(value))


def test_signals_that_lie_differently_in_memory(by_loops):
    rng = np.random.default_rng(1)
    gap, speed = rng.uniform(0.0, 20.0, (2, 30, 12))
    formula = parse("always[0,11] (gap - ego_speed >= 0)")
    expected = by_numpy(formula, {"gap": gap, "ego_speed": speed}, Agm(BOUNDS))
    for first in (gap, np.asfortranarray(gap), np.repeat(gap, 2, axis=0)[::2]):
        batch = {"gap": first, "ego_speed": np.asfortranarray(speed)}
        np.testing.assert_array_equal(by_loops(formula, batch, Agm(BOUNDS)), expected)
