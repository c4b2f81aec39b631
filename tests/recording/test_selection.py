import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pemviz.recording.selection import Quota, choose, quota

scores = st.lists(
    st.floats(min_value=-10, max_value=10) | st.just(1.0), min_size=1, max_size=300
).map(np.array)


@given(robustness=scores, limit=st.integers(min_value=8, max_value=400))
def test_the_least_robust_are_kept_and_come_last(robustness, limit):
    chosen = choose(robustness, Quota(per_stage=limit))
    assert len(set(chosen.tolist())) == chosen.size == min(limit, robustness.size)
    assert (np.diff(robustness[chosen]) <= 0).all()
    least = min(limit, robustness.size) // 4
    np.testing.assert_array_equal(robustness[chosen][::-1][:least], np.sort(robustness)[:least])


@given(robustness=scores)
def test_all_are_kept_without_a_limit(robustness):
    chosen = choose(robustness, Quota(per_stage=None))
    assert sorted(chosen.tolist()) == list(range(robustness.size))


def test_the_others_are_an_even_sample():
    robustness = np.arange(1000.0)
    chosen = choose(robustness, Quota(per_stage=100))
    others = np.sort(chosen[robustness[chosen] >= 25])
    assert others.size == 75
    assert np.ptp(np.diff(others)) <= 1


def test_a_quota_is_shared_by_the_stages():
    assert quota(rollouts=1200, stages=12).per_stage is None
    assert quota(rollouts=10_000, stages=1).per_stage == 3000
    assert quota(rollouts=100_000, stages=10).per_stage == 300
    assert quota(rollouts=10_000_000, stages=1000).per_stage == 10
