"""What a formula is the conjunction of: all of it holds exactly where the formula does."""

import numpy as np
import pytest
from hypothesis import given, settings

from pemviz.stl import conjuncts, parse, violated
from pemviz.stl.conjuncts import MOST
from pemviz.stl.formulas import MAX_DEPTH, Always

from .strategies import formula_and_rollouts, formula_and_tied_rollouts, lawful

tied = settings(lawful, max_examples=300)


def check(formula, batch):
    parts = conjuncts(formula)
    assert 1 <= len(parts) <= MOST
    assert all(part.horizon_steps() <= formula.horizon_steps() for part in parts)
    fails = np.any([violated(part, batch) for part in parts], axis=0)
    np.testing.assert_array_equal(fails, violated(formula, batch))


@tied
@given(formula_and_tied_rollouts())
def test_a_formula_is_violated_where_one_of_them_is(sample):
    check(*sample)


@lawful
@given(formula_and_rollouts(depth=5, count=20))
def test_so_it_is_of_deep_formulas(sample):
    check(*sample)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("always[0,9] (gap >= 2)", ["always[0,9] (gap >= 2.0)"]),
        (
            "always[0,9] (gap >= 2 and abs(x) < 1)",
            ["always[0,9] (gap >= 2.0)", "always[0,9] (x < 1.0)", "always[0,9] (-x < 1.0)"],
        ),
        (
            "(gap > 2) until[3,9] (gap > 7)",
            [
                "eventually[3,9] (gap > 7.0)",
                "eventually[3,9] (gap > 7.0) -> (gap > 2.0) until[3,9] (gap > 7.0)",
            ],
        ),
        ("x > 1 or v > 3 -> gap > 2", ["x > 1.0 -> gap > 2.0", "v > 3.0 -> gap > 2.0"]),
        (
            "not (eventually[0,9] (x > 1 or v > 3))",
            ["not (eventually[0,9] (x > 1.0))", "not (eventually[0,9] (v > 3.0))"],
        ),
        ("always[0,9] (2 <= min(gap, v))", ["always[0,9] (2.0 <= gap)", "always[0,9] (2.0 <= v)"]),
        ("always[0,9] (abs(x) >= 1)", ["always[0,9] (abs(x) >= 1.0)"]),
        ("eventually[0,9] (x > 1 and v > 3)", ["eventually[0,9] (x > 1.0 and v > 3.0)"]),
    ],
)
def test_which_they_are(text, parts):
    assert [str(one) for one in conjuncts(parse(text))] == parts


def test_a_formula_of_many_is_left_as_it_is():
    many = parse(" and ".join(f"always[0,{last}] (gap > {last})" for last in range(1, MOST + 2)))
    assert conjuncts(many) == (many,)


def test_so_is_one_that_is_nested_as_deeply_as_any_may_be():
    formula = parse("(gap > 2) until[3,9] (gap > 7)")
    while formula._depth < MAX_DEPTH:
        formula = Always(0, 0, formula)
    assert conjuncts(formula) == (formula,)
