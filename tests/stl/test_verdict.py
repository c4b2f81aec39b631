"""The verdict against Boolean semantics written from the definition, ties included.

Signals take few values, whole numbers among them, so that in most rollouts some comparison has
equal sides. The monitor, which sees one state after the other, gives the same verdict.
"""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.stl import (
    Agm,
    Classical,
    FormulaMonitor,
    SmoothCumulative,
    parse,
    robustness,
    ties_hold,
    violated,
)
from pemviz.stl.formulas import Eventually, Until

from . import naive
from .strategies import formula_and_rollouts, formula_and_tied_rollouts, lawful, rollouts, row

tied = settings(lawful, max_examples=300)
BOUNDS = {"gap": (-2.0, 2.0), "ego_speed": (0.0, 2.0), "x_1": (0.0, 1.0)}
SHARP = 2000.0
"""Of smooth-cumulative robustness: a soft minimum of hundreds is off by 0.01 at most."""


def fails(formula, batch):
    """Which rollouts violate, by the definition."""
    count = len(batch["gap"])
    return np.array([not naive.holds(formula, row(batch, i)) for i in range(count)])


def watch(formula, batch):
    """Whether each prefix violates for sure, [N, T]."""
    monitor = FormulaMonitor(formula)
    count, states = next(iter(batch.values())).shape
    known = monitor.start(count=count)
    found = []
    for step in range(states):
        now = {name: values[:, step] for name, values in batch.items()}
        known = monitor.advance(known, step=step, signals=now)
        found.append(monitor.violated(known))
    return np.stack(found, axis=1)


def check(formula, batch):
    expected = fails(formula, batch)
    np.testing.assert_array_equal(violated(formula, batch), expected)
    np.testing.assert_array_equal(watch(formula, batch)[:, -1], expected)


@tied
@given(formula_and_tied_rollouts())
def test_it_is_the_boolean_semantics(case):
    check(*case)


@tied
@given(formula_and_rollouts(count=4))
def test_it_is_the_boolean_semantics_where_ties_are_rarer_and_formulas_larger(case):
    check(*case)


@pytest.mark.slow
@settings(tied, max_examples=int(os.environ.get("PEMVIZ_VERDICTS", "10000")))
@given(formula_and_tied_rollouts(count=1))
def test_ten_thousand_formulas(case):
    check(*case)


@tied
@given(formula_and_tied_rollouts())
def test_the_sign_of_every_metric_agrees_with_it_wherever_robustness_is_not_0(case):
    formula, batch = case
    expected = fails(formula, batch)
    for metric in (Classical(), Agm(BOUNDS)):
        value = robustness(formula, batch, metric)
        np.testing.assert_array_equal((value < 0.0)[value != 0.0], expected[value != 0.0])
    sign = np.sign(robustness(formula, batch, Classical()))
    np.testing.assert_array_equal(np.sign(robustness(formula, batch, Agm(BOUNDS))), sign)
    if any(isinstance(part, Eventually | Until) for part in formula.walk()):
        return  # of which the smooth metric takes sums: no sign is sound under a negation
    # elsewhere neither of its parts is sound near 0; the sharper they are, the nearer they come
    positive = robustness(formula, batch, SmoothCumulative(SHARP))
    negative = robustness(formula, batch, SmoothCumulative(SHARP, "negative"))
    np.testing.assert_array_equal(positive > 0.25, sign > 0.0)
    np.testing.assert_array_equal(negative < -0.25, sign < 0.0)


@tied
@given(formula_and_tied_rollouts())
def test_what_is_said_of_all_ties_is_true_of_each(case):
    formula, batch = case
    zero = robustness(formula, batch, Classical()) == 0.0
    if ties_hold(formula):
        assert not fails(formula, batch)[zero].any()
    if ties_hold(parse(f"not ({formula})")):
        assert fails(formula, batch)[zero].all()


@pytest.mark.parametrize(
    ("text", "held", "at_a_tie"),
    [
        ("always[0,2] (x >= 1)", True, True),
        ("always[0,2] (x > 1)", False, False),
        ("always[0,2] (2 - x < 1)", False, False),
        ("always[0,2] (1 <= x)", True, True),
        ("not eventually[0,2] (x <= 1)", False, False),
        ("not eventually[0,2] (x < 1)", True, True),
        ("always[0,2] (x <= 1 -> x > 5)", False, False),
        ("always[0,2] (x < 1 -> x > 5)", False, True),  # the premise decides
        ("(x >= 1) until[0,2] (x > 1)", False, True),
        ("(x > 1) until[1,2] (x >= 2)", False, False),
        ("always[0,2] (x >= 1 and x > 0)", False, True),
        ("eventually[1,1] (x > 1) or always[0,1] (x >= 1)", False, True),
        ("always[0,2] (2 > 2)", False, False),
        ("always[0,2] (2 >= 2)", True, True),
    ],
)
def test_a_tie_is_decided_by_the_comparison(text, held, at_a_tie):
    """Of 2, 1, 2: at step 1 the signal is exactly on the number."""
    formula = parse(text)
    assert ties_hold(formula) == held
    batch = {"x": np.array([[2.0, 1.0, 2.0], [2.0, 1.0, 2.0]])}
    np.testing.assert_array_equal(violated(formula, batch), [not at_a_tie] * 2)
    assert (robustness(formula, batch, Classical()) >= 0.0).all()


def test_the_next_number_is_no_tie():
    above, below = np.nextafter(0.0, 1.0), np.nextafter(0.0, -1.0)
    batch = {"x": np.array([[0.0], [-0.0], [above], [below]])}
    np.testing.assert_array_equal(violated(parse("x > 0"), batch), [True, True, False, True])
    np.testing.assert_array_equal(violated(parse("x >= 0"), batch), [False, False, False, True])


@given(formula_and_rollouts(depth=3, count=3), st.integers(0, 2**32 - 1))
@settings(lawful, max_examples=60)
def test_what_it_calls_violated_no_continuation_undoes(case, seed):
    formula, batch = case
    found = watch(formula, batch)
    count, states = found.shape
    assert (found[:, 1:] >= found[:, :-1]).all()
    for step in range(0, states - 1, 3):
        other = rollouts(seed + step, states, count)
        mixed = {
            name: np.where(np.arange(states) <= step, values, other[name])
            for name, values in batch.items()
        }
        assert violated(formula, mixed)[found[:, step]].all()


def first_violation(text, gaps):
    formula = parse(text, signals=["gap"])
    found = watch(formula, {"gap": np.array([gaps], dtype=float)})[0]
    return int(np.argmax(found)) if found.any() else None


@pytest.mark.parametrize(
    ("text", "gaps", "step"),
    [
        ("always[0,4] (gap >= 2)", [5, 3, 1, 5, 5], 2),
        ("eventually[0,2] (gap >= 2)", [0, 1, 0, 5], 2),
        ("eventually[1,2] (gap >= 2)", [5, 1, 2], None),
        # evaluated at step 1, when the gap falls below 3; nothing above it up to step 3
        ("always[0,3] (gap < 3 -> eventually[0,2] (gap >= 3))", [4, 2, 1, 2, 5, 5], 3),
        ("(gap >= 1) until[0,4] (gap >= 8)", [4, 3, 0, 9, 9], 2),
        ("not (eventually[0,3] (gap < 0))", [4, -1, 5, 5], 1),
        ("always[0,2] (gap >= 2) or eventually[2,3] (gap >= 8)", [1, 9, 9, 1], None),
        ("always[0,2] (gap >= 2) or eventually[2,3] (gap >= 8)", [1, 9, 7, 7], 3),
    ],
)
def test_a_violation_is_known_as_soon_as_nothing_can_undo_it(text, gaps, step):
    assert first_violation(text, gaps) == step


def test_what_is_known_is_never_changed():
    """A rollout may be continued twice from the same state."""
    monitor = FormulaMonitor(parse("always[0,3] (gap >= 2)", signals=["gap"]))
    start = monitor.start(count=1)
    bad = monitor.advance(start, step=0, signals={"gap": np.array([0.0])})
    good = monitor.advance(start, step=0, signals={"gap": np.array([9.0])})
    assert monitor.violated(bad)[0]
    assert not monitor.violated(good)[0]
    assert not monitor.violated(start)[0]
