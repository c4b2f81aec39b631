"""The text form, and errors that a person can act on."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings

from pemviz.errors import InputError
from pemviz.stl import (
    Agm,
    Classical,
    FormulaError,
    SmoothCumulative,
    parse,
    robustness,
    violated,
)
from pemviz.stl import formulas as fo
from pemviz.stl.parsing import MAX_TEXT

from .strategies import deep_predicates, formulas, lawful


@settings(lawful, max_examples=500)
@given(formulas(4, deep_predicates))
def test_print_parses_back(formula):
    text = str(formula)
    again = parse(text)
    assert again == formula
    assert str(again) == text
    assert hash(again) == hash(formula)


def tree(node):
    """A formula as nested tuples: operator and parts; signals and numbers as they are."""
    parts = tuple(tree(part) for part in node.children())
    match node:
        case fo.Signal(name=leaf) | fo.Constant(value=leaf):
            return leaf
        case fo.Predicate(comparison=sign):
            return parts[0], sign, parts[1]
        case fo.Always() | fo.Eventually() | fo.Until():
            return node.word, node.first, node.last, *parts
    return type(node).__name__, *parts


TRUE, GAP, V = ("Truth",), ("gap", ">", 1.0), ("v", ">", 1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("always[0,99] (gap >= 2.0)", ("always", 0, 99, ("gap", ">=", 2.0))),
        ("G[0:99] gap>=2", ("always", 0, 99, ("gap", ">=", 2.0))),
        ("F[3,4](gap < -2)", ("eventually", 3, 4, ("gap", "<", -2.0))),
        ("(gap > 1) U[0,5] (v <= 3)", ("until", 0, 5, GAP, ("v", "<=", 3.0))),
        ("!gap > 1 && v > 1 || true", ("Or", ("And", ("Not", GAP), V), TRUE)),
        ("not gap > 1 and v > 1 or true", ("Or", ("And", ("Not", GAP), V), TRUE)),
        ("gap>1 -> v>1 -> true", ("Implies", GAP, ("Implies", V, TRUE))),
        ("gap>1 or v>1 -> true", ("Implies", ("Or", GAP, V), TRUE)),
        ("gap>1 or v>1 and true", ("Or", GAP, ("And", V, TRUE))),
        ("gap>1 and v>1 until[0,1] true", ("And", GAP, ("until", 0, 1, V, TRUE))),
        ("not gap>1 until[0,1] true", ("until", 0, 1, ("Not", GAP), TRUE)),
        ("always[0,1] gap>1 until[0,1] true", ("until", 0, 1, ("always", 0, 1, GAP), TRUE)),
        ("gap>1 and v>1 and true", ("And", GAP, V, TRUE)),
        ("(gap>1 and v>1) and true", ("And", ("And", GAP, V), TRUE)),
        (
            "gap - v - 1 > 2 * gap / v",
            (
                ("Difference", ("Difference", "gap", "v"), 1.0),
                ">",
                ("Quotient", ("Product", 2.0, "gap"), "v"),
            ),
        ),
        (
            "gap - (v - 1) > -gap",
            (("Difference", "gap", ("Difference", "v", 1.0)), ">", ("Negative", "gap")),
        ),
        ("abs(gap - v) <= 1e-3", (("Absolute", ("Difference", "gap", "v")), "<=", 1e-3)),
        (
            "min(gap, v, 3) > max(1, v)",
            (("Minimum", "gap", "v", 3.0), ">", ("Maximum", 1.0, "v")),
        ),
        ("gap + v > 1", (("Sum", "gap", "v"), ">", 1.0)),
        ("2 < gap", (2.0, "<", "gap")),
        ("false", ("Not", TRUE)),
        ("orbit > 1 and nothing < 2", ("And", ("orbit", ">", 1.0), ("nothing", "<", 2.0))),
        (" \n gap\t>= .5", ("gap", ">=", 0.5)),
        ("((((gap))) > (2))", ("gap", ">", 2.0)),
    ],
)
def test_what_a_text_says(text, expected):
    formula = parse(text)
    assert tree(formula) == expected
    assert parse(str(formula)) == formula


def test_what_a_formula_tells_of_itself():
    formula = parse("always[2,10] (gap - v > 0 until[1,4] eventually[0,3] (v < 1))")
    assert formula.horizon_steps() == 10 + 4 + 3
    assert formula.signals() == {"gap", "v"}
    assert isinstance(formula, fo.Formula)
    assert parse("true").signals() == frozenset()
    with pytest.raises(AttributeError):
        formula.first = 3


MISTAKES = [
    ("alway[0,9] (gap > 1)", 6, "did you mean 'always'"),
    ("Always[0,9] (gap > 1)", 7, "did you mean 'always'"),
    ("always (gap > 1)", 8, "'always' needs an interval in steps, as in always[0,99]"),
    ("gap > 1 until v > 1", 15, "'until' needs an interval"),
    ("always[9,0] (gap > 1)", 8, "reversed; did you mean [0,9]?"),
    ("gap>1 until[9,0] v>1", 13, "reversed"),
    ("always[-1,3] (gap > 1)", 8, "interval bound -1 is negative"),
    ("always[0,9.5] (gap > 1)", 10, "interval bound 9.5 must be a whole number of steps"),
    ("always[0,1e3] (gap > 1)", 10, "must be a whole number"),
    ("always[0,99999999999] (gap > 1)", 10, "too large"),
    ("always[0,1000000001] (gap > 1)", 10, "too large"),
    ("always[0] (gap > 1)", 9, "expected ','"),
    ("always[0,9 (gap > 1)", 12, "expected ']'"),
    ("always[0,9] gap", 13, "'gap' is a number, but 'always' needs a formula"),
    ("gap", 1, "'gap' is a number, but the specification needs a formula"),
    ("gap and v > 1", 1, "'gap' is a number, but 'and' needs a formula"),
    ("not gap", 5, "'gap' is a number, but 'not' needs a formula"),
    ("v > 1 -> gap - 1", 10, "'gap - 1.0' is a number, but '->' needs a formula"),
    ("(gap > 1) + 2 > 3", 2, "'gap > 1.0' is a formula (true or false), but '+' needs a number"),
    ("(gap > 1) > 3", 2, "is a formula (true or false), but '>' needs a number"),
    ("abs(gap > 1) > 3", 5, "is a formula (true or false), but 'abs' needs a number"),
    ("-true > 3", 2, "'true' is a formula"),
    ("1 < gap < 3", 9, "comparisons cannot be chained; write (1.0 < gap) and (gap < 3.0)"),
    ("v>1 until[0,1] v>2 until[0,1] v>3", 20, "chained until needs parentheses"),
    ("gap >= ", 7, "the formula ends here; expected a number or '('"),
    ("", 1, "the formula ends here; expected a formula"),
    ("(gap > 1", 9, "expected"),
    ("gap > 1)", 8, "unexpected ')'"),
    ("gap > 1 v > 2", 9, "unexpected 'v'"),
    ("gap > 1 AND v > 2", 9, "did you mean 'and'?"),
    ("gap > 1 implies v > 2", 9, "'implies' is written ->"),
    ("gap = 2", 5, "comparisons are >= > <= <"),
    ("gap == 2", 5, "abs(a - b) <= tolerance"),
    ("gap != 2", 5, "unexpected '!'"),
    ("gap >= 2 & v > 1", 10, "conjunction is written 'and' or '&&'"),
    ("gap ≥ 2", 5, "at least is written >="),
    ("gap >= 2 $", 10, "character '$' is not part of the language"),
    ("sqrt(gap) > 2", 5, "no function 'sqrt'; there are abs, min, max"),
    ("mim(gap, v) > 2", 4, "did you mean 'min'?"),
    ("gap[3] > 2", 4, "'gap' takes no interval or index"),
    ("abs gap > 2", 5, "'abs' is a function, as in abs(x - y)"),
    ("min(gap) > 2", 1, "min takes two or more numbers"),
    ("abs(gap, v) > 2", 10, "'abs' takes one number"),
    ("1e999 > gap", 1, "too large for double precision"),
    ("2gap > 1", 2, "unexpected 'gap'"),
    ("always > 1", 8, "'always' needs an interval"),
]


@pytest.mark.parametrize(("text", "column", "message"), MISTAKES)
def test_mistakes_are_located_and_explained(text, column, message):
    with pytest.raises(FormulaError) as caught:
        parse(text)
    error = caught.value
    assert isinstance(error, InputError)
    assert message in str(error)
    assert "\n" not in str(error)
    assert (error.line, error.column) == (1, column)
    assert str(error).startswith(f"formula, line 1, column {column}: ")


def test_mistakes_in_later_lines():
    with pytest.raises(FormulaError) as caught:
        parse("always[0,9] (\n  gap >= 2 and\n  speed ? 1)")
    assert (caught.value.line, caught.value.column) == (3, 9)


def test_unknown_signals_get_suggestions():
    known = ["gap", "ego_speed", "lead_speed"]
    with pytest.raises(FormulaError, match=r"column 13: unknown signal 'ego_sped'; did you mean"):
        parse("gap >= 2 or ego_sped > 1", signals=known)
    with pytest.raises(FormulaError, match="known: ego_speed, gap, lead_speed"):
        parse("zzz >= 2", signals=known)
    with pytest.raises(FormulaError, match="unknown signal 'gpa'; did you mean 'gap'"):
        robustness(parse("gpa >= 2"), {"gap": np.ones((1, 2))}, Classical())
    assert parse("gap >= 2", signals=known) == parse("gap >= 2")


def test_a_horizon_past_the_end_is_never_cut():
    formula = parse("always[0,100] (gap >= 2)")
    with pytest.raises(FormulaError, match="needs 101 states; the rollouts have 100"):
        violated(formula, {"gap": np.ones((3, 100))})
    with pytest.raises(FormulaError, match="needs 6 states"):
        violated(parse("eventually[0,2] always[0,3] gap > 1"), {"gap": np.ones((1, 5))})
    assert not violated(formula, {"gap": np.full((3, 101), 2.0)}).any()


def test_limits_on_size():
    deep = "not " * 90 + "gap > 1"
    assert parse(str(parse(deep))) == parse(deep)
    robustness(parse(deep), {"gap": np.ones((1, 1))}, SmoothCumulative())
    with pytest.raises(FormulaError, match="nested too deeply; at most 100 levels"):
        parse("not " * 200 + "gap > 1")
    with pytest.raises(FormulaError, match="nested too deeply"):
        parse("-(" * 200 + "gap" + ")" * 200 + " > 1")
    assert parse("(" * 20_000 + "gap > 1" + ")" * 20_000) == parse("gap > 1")
    with pytest.raises(FormulaError, match=f"at most {MAX_TEXT}"):
        parse("gap > 1" + " " * MAX_TEXT)
    with pytest.raises(FormulaError, match="too long; at most 10000 parts"):
        parse(" and ".join(["gap > 1"] * 5000))
    formula = parse("gap > 1")
    for _ in range(11):
        formula = fo.And((formula, formula))
    with pytest.raises(FormulaError, match="too long"):
        fo.And((formula, formula))
    assert len(parse(" or ".join(["gap > 1"] * 3000)).children()) == 3000


def test_what_is_no_text_is_refused():
    with pytest.raises(FormulaError, match="must be text"):
        parse(3)


def batch(**changes):
    signals = {"gap": np.full((3, 5), 4.0), "v": np.full((3, 5), 1.0)}
    return {**signals, **changes}


def test_signals_that_do_not_fit_are_named():
    formula = parse("always[0,2] (gap >= 2 or v < 1)")
    bad = np.full((3, 5), 4.0)
    bad[1, 4] = np.nan
    for wrong, message in (
        (batch(gap=bad), "signal 'gap' is nan at rollout 1, step 4; it must be finite"),
        (batch(gap=bad * np.inf), "signal 'gap' is inf at rollout 0, step 0"),
        (batch(gap=np.ones(5)), r"signal 'gap' has shape \(5,\); must be \[N, T\]"),
        (batch(v=np.ones((3, 4))), "all must be equal"),
        (batch(v=np.full((3, 5), "x")), "must be real numbers"),
        (batch(v=np.ones((3, 5), complex)), "must be real numbers"),
    ):
        for metric in (Classical(), Agm({"gap": (-9, 9), "v": (0, 9)}), SmoothCumulative()):
            with pytest.raises(InputError, match=message):
                robustness(formula, wrong, metric)
    late = np.full((2000, 100), 4.0)
    late[1777, 99] = np.nan
    with pytest.raises(InputError, match="rollout 1777, step 99"):
        violated(parse("gap > 1"), {"gap": late})
    zero = np.ones((2, 3))
    zero[1, 2] = 0.0
    with pytest.raises(InputError, match=r"'1.0 / gap >= 0.0' is inf at rollout 1, step 2"):
        violated(parse("always[0,2] (1 / gap >= 0)"), {"gap": zero})
    with pytest.raises(InputError, match="is nan"):
        violated(parse("gap > 1 / 0 - 1 / 0"), batch())
    with pytest.raises(InputError, match="no signals given"):
        violated(parse("true"), {})
    with pytest.raises(InputError, match="beyond the largest number"):
        violated(parse("gap > -1e308"), {"gap": np.full((1, 1), 1.7e308)})


def test_empty_batches_and_constants():
    assert robustness(parse("gap > 1"), {"gap": np.ones((0, 5))}, Classical()).shape == (0,)
    for metric in (Classical(), Agm({"gap": (-1, 1)}), SmoothCumulative()):
        assert (robustness(parse("3 > 2"), batch(), metric) > 0).all()
        assert robustness(parse("true"), batch(), metric).shape == (3,)
    np.testing.assert_array_equal(robustness(parse("3 > 2"), batch(), Agm({})), np.ones(3))
    np.testing.assert_array_equal(robustness(parse("false"), batch(), Agm({})), -np.ones(3))


def test_agm_bounds():
    formula = parse("always[0,4] (gap - v >= 2)")
    assert hash(Agm({"gap": (-25, 25)})) == hash(Agm({"gap": (-25.0, 25.0)}))
    value = robustness(formula, batch(), Agm({"gap": (-25, 25), "v": (0, 40)}))
    np.testing.assert_allclose(value, np.expm1(np.log1p(1.0 / 90.0)))
    for wrong, message in (
        (Agm({"gap": (-25, 3), "v": (0, 40)}), r"'gap' is 4.0 at rollout 0, step 0; declared"),
        (Agm({"gap": (-25, 25)}), "no bounds for signal 'v'; declared: gap"),
    ):
        with pytest.raises(InputError, match=message):
            robustness(formula, batch(), wrong)
    for pair in ((3, 1), (0, np.inf), (1,), "ab", (1, 1)):
        with pytest.raises(InputError, match="bounds of signal 'gap'"):
            Agm({"gap": pair})
    with pytest.raises(InputError, match="'v' can be 0 within the declared bounds, as a divisor"):
        robustness(parse("gap / v > 1"), batch(), Agm({"gap": (0, 9), "v": (0, 9)}))


def test_agm_clipping_keeps_the_sign():
    clipped = Agm({"gap": (-10, 10)}, clip=True)
    signals = {"gap": np.array([[30.0, 5.0], [-30.0, 5.0]])}
    value = robustness(parse("gap >= 2"), signals, clipped)
    np.testing.assert_allclose(value, [8 / 20, -12 / 20])
    with pytest.raises(InputError, match="clipping to the bounds would change whether"):
        robustness(parse("gap >= 20"), signals, clipped)


def test_metric_parameters_are_checked():
    for beta in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="must be finite and > 0"):
            SmoothCumulative(beta=beta)
    with pytest.raises(InputError, match="positive or negative"):
        SmoothCumulative(part="both")


def test_on_the_boundary_the_comparison_decides():
    at_two = {"gap": np.array([[2.0], [np.nextafter(2.0, 0.0)], [3.0]])}
    for text, at_boundary in (("gap >= 2", False), ("not (gap < 2)", False), ("gap > 2", True)):
        verdict = violated(parse(text), at_two)
        assert verdict.dtype == bool
        np.testing.assert_array_equal(verdict, [at_boundary, True, False])


def test_importing_needs_neither_torch_nor_lark():
    code = "import sys, pemviz.stl; sys.exit(any(m in sys.modules for m in ('torch', 'lark')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
