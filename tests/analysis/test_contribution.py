"""Which rollouts carry an estimate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.analysis.causes import carrying, contributions

weights = st.lists(st.floats(min_value=-80, max_value=0), min_size=1, max_size=40).map(np.array)


@given(log_weight=weights, data=st.data())
def test_shares_are_those_of_plain_sums(log_weight, data):
    violated = np.array(data.draw(st.lists(st.booleans(), min_size=log_weight.size,
                                           max_size=log_weight.size)))  # fmt: skip
    plain = np.where(violated, np.exp(log_weight), 0.0)
    expected = plain / plain.sum() if violated.any() else plain
    np.testing.assert_allclose(contributions(log_weight, violated=violated), expected, rtol=1e-12)


def test_shares_far_below_what_numbers_can_hold():
    share = contributions(np.array([-2000.0, -2000.0 + np.log(3.0)]), violated=np.full(2, True))
    np.testing.assert_allclose(share, [0.25, 0.75], rtol=1e-12)


@given(log_weight=weights, part=st.floats(min_value=0.1, max_value=0.999))
def test_the_fewest_that_make_up_the_part_and_what_ties_with_them(log_weight, part):
    share = contributions(log_weight, violated=np.full(log_weight.size, True))
    chosen = carrying(share, part=part)
    assert share[chosen].sum() >= part * (1.0 - 1e-12)
    least = share[chosen].min()
    assert (share[~chosen] < least).all()
    assert share[chosen & (share > least)].sum() < part


def test_equal_shares_all_carry():
    assert carrying(np.full(7, 1 / 7)).all()


def test_nothing_carries_where_nothing_fails():
    assert not carrying(contributions(np.zeros(3), violated=np.full(3, False))).any()


def test_a_pile_up_of_misses_does_not_carry():
    share = contributions(np.array([-46.0, 0.0, 0.0]), violated=np.full(3, True))
    assert carrying(share).tolist() == [False, True, True]
    assert share[0] == pytest.approx(np.exp(-46.0) / 2, rel=1e-9)
