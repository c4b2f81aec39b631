"""Laws that the metrics' papers state, as properties of random formulas and rollouts."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pemviz.errors import InputError
from pemviz.stl import Agm, Classical, SmoothCumulative, parse, robustness, robustness_trace
from pemviz.stl import formulas as fo

from . import naive
from .strategies import BOUNDS, NAMES, formula_and_rollouts, formulas, lawful, rollouts, row

POSITIVE, NEGATIVE = SmoothCumulative(), SmoothCumulative(part="negative")
METRICS = (Classical(), Agm(BOUNDS), POSITIVE, NEGATIVE)
TRUE = fo.Truth()


def no_margin_is_zero(formula, batch):
    predicates = [node for node in formula.walk() if isinstance(node, fo.Predicate)]
    return all(
        (np.abs(robustness_trace(p, batch, Classical())) > 1e-9).all()
        for p in predicates
        if p.signals()
    ) and all(p.signals() for p in predicates)


def dual(formula):
    """The negation of ``formula``, pushed inwards to the predicates."""
    match formula:
        case fo.Not(operand=a):
            return a
        case fo.And(parts=parts):
            return fo.Or(tuple(dual(a) for a in parts))
        case fo.Or(parts=parts):
            return fo.And(tuple(dual(a) for a in parts))
        case fo.Implies(premise=a, conclusion=b):
            return fo.And((a, dual(b)))
        case fo.Always(first=first, last=last, operand=a):
            return fo.Eventually(first, last, dual(a))
        case fo.Eventually(first=first, last=last, operand=a):
            return fo.Always(first, last, dual(a))
    return fo.Not(formula)


@lawful
@given(formula_and_rollouts())
def test_classical_is_dual(case):
    formula, batch = case
    np.testing.assert_array_equal(
        robustness_trace(dual(formula), batch, Classical()),
        -robustness_trace(formula, batch, Classical()),
    )


@lawful
@given(formula_and_rollouts())
def test_agm_is_dual_away_from_zeros(case):
    formula, batch = case
    assume(no_margin_is_zero(formula, batch))
    np.testing.assert_allclose(
        robustness_trace(dual(formula), batch, Agm(BOUNDS)),
        -robustness_trace(formula, batch, Agm(BOUNDS)),
        rtol=1e-12,
        atol=1e-15,
    )


def test_smooth_cumulative_is_not_dual():
    batch = {"gap": np.full((1, 5), 3.0)}
    formula = parse("always[0,4] (gap >= 2)")
    assert robustness(dual(formula), batch, POSITIVE) > -robustness(formula, batch, POSITIVE)
    np.testing.assert_array_equal(
        robustness(fo.Not(formula), batch, POSITIVE), -robustness(formula, batch, NEGATIVE)
    )


@lawful
@given(formula_and_rollouts(), st.sampled_from((Classical(), Agm(BOUNDS))))
def test_the_sign_is_sound(case, metric):
    formula, batch = case
    assume(no_margin_is_zero(formula, batch))
    values = robustness_trace(formula, batch, metric)
    for i, trace in enumerate(values):
        expected = [naive.holds(formula, row(batch, i), t) for t in range(len(trace))]
        np.testing.assert_array_equal(trace > 0, expected)
        np.testing.assert_array_equal(trace < 0, np.logical_not(expected))


@pytest.mark.parametrize("size", [1e-12, 1e-200, 25.0])
def test_the_sign_of_agm_survives_tiny_margins(size):
    gap = np.array([[25.0] * 40, [-25.0] * 40])
    gap[0, 7] = -size
    gap[1, 7] = size
    batch = {"gap": gap}
    for width in (40, 13):
        last = width - 1
        lowest = robustness(parse(f"always[0,{last}] (gap >= 0)"), batch, Agm(BOUNDS))
        highest = robustness(parse(f"eventually[0,{last}] (gap >= 0)"), batch, Agm(BOUNDS))
        assert lowest[0] < 0 < highest[1]
    batch = {"gap": np.full((1, 40), size)}
    assert robustness(parse("always[0,39] (gap >= 0)"), batch, Agm(BOUNDS)) > 0
    assert robustness(parse("always[0,12] (gap >= 0)"), batch, Agm(BOUNDS)) > 0


@lawful
@given(
    st.lists(st.floats(-0.2, 0.3), min_size=1, max_size=120),
    st.sampled_from((75.0, 10.0, 300.0)),
)
def test_positive_part_of_always_is_at_most_zero_where_the_sigmoids_add_up_to_one(gaps, beta):
    total = math.fsum(1.0 / (1.0 + math.exp(beta * gap)) for gap in gaps)
    assume(abs(total - 1.0) > 1e-12)
    formula = parse(f"always[0,{len(gaps) - 1}] (gap >= 0)")
    value = robustness(formula, {"gap": np.array([gaps])}, SmoothCumulative(beta=beta))[0]
    assert (value <= 0.0) == (total >= 1.0)
    assert value == pytest.approx(-math.log(total) / beta, rel=1e-12, abs=1e-14)


def test_smooth_cumulative_misses_a_shallow_violation_and_flags_near_misses():
    formula = parse("always[0,99] (gap >= 0)")
    shallow = np.full((1, 100), 3.0)
    shallow[0, 50] = -0.001
    near = np.full((1, 100), 0.05)
    assert robustness(formula, {"gap": shallow}, POSITIVE) > 0
    assert robustness(formula, {"gap": near}, POSITIVE) < 0


@lawful
@given(formula_and_rollouts(depth=2), st.sampled_from((POSITIVE, NEGATIVE)))
def test_smooth_minimum_and_maximum_enclose_the_sharp_ones(case, metric):
    part, batch = case
    inner = robustness_trace(part, batch, metric)
    finite = np.isfinite(inner)
    for formula, count, sign in (
        (fo.Always(0, 0, part), 1, 1),
        (fo.And((part, part)), 2, 1),
        (fo.Or((part, part)), 2, -1),
    ):
        smooth = robustness_trace(formula, batch, metric)
        loss = sign * (inner[finite] - smooth[finite])
        assert (loss >= -1e-12).all()
        assert (loss <= math.log(count) / metric.beta + 1e-12).all()
        np.testing.assert_array_equal(inner[~finite], smooth[~finite])


@lawful
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 3))
def test_smooth_minimum_over_time_lies_within_log_m_of_the_minimum(seed, width, extra):
    batch = rollouts(seed, width + extra)
    formula = parse(f"always[0,{width - 1}] (gap >= 1)")
    whole = robustness_trace(formula, batch, POSITIVE)
    inner = robustness_trace(formula.operand, batch, POSITIVE)
    for t in range(whole.shape[1]):
        least = inner[:, t : t + width].min(axis=1)
        assert (whole[:, t] <= least + 1e-12).all()
        assert (whole[:, t] >= least - math.log(width) / 75.0 - 1e-12).all()


@lawful
@given(formula_and_rollouts(), st.integers(1, 3), st.sampled_from(METRICS))
def test_time_shift(case, delay, metric):
    formula, batch = case
    later = {name: np.pad(v, ((0, 0), (delay, 0)), mode="edge") for name, v in batch.items()}
    expected = robustness_trace(formula, batch, metric)
    shifted = robustness_trace(formula, later, metric)[:, delay:]
    np.testing.assert_allclose(shifted, expected, rtol=1e-12, atol=1e-12)
    moved = robustness(fo.Always(delay, delay, formula), later, metric)
    np.testing.assert_allclose(moved, expected[:, 0], rtol=1e-12, atol=1e-12)


@lawful
@given(formula_and_rollouts(depth=2), st.sampled_from(METRICS))
def test_truth_is_neutral(case, metric):
    formula, batch = case
    value = robustness_trace(formula, batch, metric)
    if not isinstance(metric, Agm):  # its means count true as one value among others
        in_and, in_or = fo.And((formula, TRUE)), fo.Or((formula, fo.Not(TRUE)))
        if metric != NEGATIVE:  # whose `true` is 0, as good as any violation gets
            np.testing.assert_allclose(robustness_trace(in_and, batch, metric), value, atol=1e-12)
        if metric != POSITIVE:  # whose `not true` is 0
            np.testing.assert_allclose(robustness_trace(in_or, batch, metric), value, atol=1e-12)
    if metric != NEGATIVE:
        reached = fo.Until(0, 0, TRUE, formula)
        if not isinstance(metric, Agm):
            np.testing.assert_allclose(robustness_trace(reached, batch, metric), value, atol=1e-12)


@lawful
@given(formula_and_rollouts(count=7), st.sampled_from(METRICS), st.integers(1, 6))
def test_a_rollout_does_not_depend_on_its_batch(case, metric, split):
    formula, batch = case
    together = robustness_trace(formula, batch, metric)
    at_start = robustness(formula, batch, metric)
    for rows in (slice(0, 1), slice(split, None), slice(None, split)):
        some = {name: values[rows] for name, values in batch.items()}
        np.testing.assert_array_equal(robustness_trace(formula, some, metric), together[rows])
        np.testing.assert_array_equal(robustness(formula, some, metric), at_start[rows])


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("states", [100, 3000])
def test_blocks_leave_no_trace(metric, states):
    """Batches larger than a block, in any memory layout, give what single rollouts give."""
    rng = np.random.default_rng(5)
    count = 1500 if states == 100 else 40
    batch = {name: rng.uniform(*BOUNDS[name], (count, states)) for name in NAMES}
    formula = parse(
        "always[0,60] (gap >= 2 or eventually[0,20] (ego_speed < 1))"
        " and (ego_speed > 0.1) until[0,30] (x_1 > 0)"
    )
    whole = robustness(formula, batch, metric)
    for rows in (slice(0, 1), slice(17, 23), slice(count - 1, None), slice(None, None, 7)):
        for order in "CF":
            some = {name: np.array(v[rows], order=order) for name, v in batch.items()}
            np.testing.assert_array_equal(robustness(formula, some, metric), whole[rows])
    single = {name: v.astype(np.float32) for name, v in batch.items()}
    assert robustness(formula, single, metric).dtype == np.float64


@lawful
@given(formulas(3), formulas(2))
def test_horizon_adds_up(left, right):
    assert fo.Eventually(2, 5, left).horizon_steps() == 5 + left.horizon_steps()
    longer = max(left.horizon_steps(), right.horizon_steps())
    assert fo.And((left, right)).horizon_steps() == longer
    assert fo.Until(1, 4, left, right).horizon_steps() == 4 + longer


def test_values_far_beyond_the_exponential_stay_finite():
    gap = np.array([[25.0, -25.0, 0.0], [400.0] * 3, [-400.0] * 3, [1e5, -1e5, 0.0]])
    for text in (
        "always[0,2] (gap >= 2)",
        "eventually[0,2] (gap >= 2)",
        "not (gap >= 2)",
        "(gap >= 2) until[0,2] (gap <= 3)",
        "gap >= 2 and gap <= 5 or gap >= 7",
        "always[0,1] (gap >= 2 -> gap >= 1)",
    ):
        for metric in (POSITIVE, NEGATIVE, Classical(), Agm({"gap": (-2e5, 2e5)})):
            assert np.isfinite(robustness_trace(parse(text), {"gap": gap}, metric)).all()
    # Far from the threshold the positive part is the margin itself: no digit is lost.
    high = robustness(parse("always[0,0] (gap >= 2)"), {"gap": gap}, POSITIVE)
    np.testing.assert_allclose(high, [23.0, 398.0, 0.0, 99998.0], rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("metric", [Agm(bounds={"gap": (-25.0, 25.0)}), SmoothCumulative()])
def test_blocks_change_no_bit_and_the_first_error_is_told(metric):
    gap = np.random.default_rng(0).uniform(-20.0, 20.0, (12_000, 100))
    formula = parse("always[0,99] (gap >= 2.0)")
    whole = robustness(formula, {"gap": gap}, metric)
    parts = [robustness(formula, {"gap": part}, metric) for part in np.array_split(gap, 40)]
    np.testing.assert_array_equal(whole, np.concatenate(parts))
    gap[7_000, 3] = gap[300, 50] = np.nan
    with pytest.raises(InputError, match="300"):
        robustness(formula, {"gap": gap}, metric)
