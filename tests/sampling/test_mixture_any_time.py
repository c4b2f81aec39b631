"""Violations that can begin at any time, and frequent ones, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.mixture.balance_heuristic import PLAIN
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.mixture.plain import PlainRollouts
from pemviz.sampling.mixture.stages import watching
from pemviz.sampling.problem import sample
from tests.misses_in_a_row import STEPS, MissesInARow, probability, problem_of
from tests.toy import carried_out, stepped_through


def test_one_miss_is_geometric_waiting():
    assert probability(MissesInARow(), 1e-3) == pytest.approx(1.0 - 0.999**STEPS, rel=1e-12)


@pytest.mark.parametrize(
    ("system", "miss", "at_least"),
    [
        (MissesInARow(), 0.005, 0.3),
        (MissesInARow(), 1e-4, 0.005),
        (MissesInARow(2), 0.03, 0.05),
        (MissesInARow(3, shown=True), 0.01, 5e-5),
    ],
)
def test_right_where_violations_begin_at_any_time(system, miss, at_least):
    """20 runs of 360 rollouts each: geometric waiting, and two misses that no feature tells of.

    Were 93 % of unwarned intervals to hold the truth, fewer than all but five would in 2e-3.
    """
    truth, problem = probability(system, miss), problem_of(system, miss)
    assert at_least < truth < 2.1 * at_least
    method = MixtureSampling(learning_stages=4, rollouts=60, final_rollouts=60, seed=3)
    found = [carried_out(method, problem, repetition=number)[0] for number in range(20)]
    unwarned = [each for each in found if not each.warnings]
    assert len(unwarned) >= 8
    assert sum(each.ci_low <= truth <= each.ci_high for each in unwarned) >= len(unwarned) - 5


def test_where_violations_are_frequent_most_rollouts_are_plain():
    """And where they are rare none is after the first stage, of which few are."""
    method = MixtureSampling(learning_stages=4, rollouts=60, final_rollouts=60, seed=3)
    drift = replace(MissesInARow(12, shown=True), states=81)
    shares = {}
    for miss in (0.75, 1e-3):
        state, _ = stepped_through(method, problem_of(drift, miss))
        plain = state.pool.component == PLAIN
        shares[miss] = plain[:60].mean(), plain[60:].mean()
        judged = state.pool.judged
        row = np.flatnonzero(plain[:-60] & ~judged.violated[:-60])
        assert np.isnan(judged.log_weight[row]).all()  # they count
        bound = -np.log(max(plain.mean(), 1e-9))
        assert judged.log_weight[judged.violated].max() <= bound + 1e-9
    assert shares[1e-3] == (0.05, 0.0)
    assert shares[0.75][0] == 0.05
    assert shares[0.75][1] > 0.2


def test_plain_rollouts_from_before_count():
    """20 runs beside 2,000 plain rollouts each, of which the violating ones are handed over.

    The mean against the truth by a t-test at level 1e-4; all intervals but five, as above.
    """
    system = MissesInARow(2)
    truth, problem = probability(system, 0.01), problem_of(system, 0.01)
    method = MixtureSampling(learning_stages=2, rollouts=60, final_rollouts=60, seed=4)
    found = []
    for number in range(20):
        seeds = np.random.SeedSequence(number)
        scored = sample(watching(problem), proposal=PemProposal(), count=2_000, seeds=seeds)
        row = np.flatnonzero(scored.violated)
        plain = PlainRollouts(2_000, row, scored.take(row))
        state = method.init(problem, repetition=number, plain=plain)
        state, _ = stepped_through(method, problem, state)
        found.append(method.estimate(state))
        assert state.pool.sampled == 2_000 + 4 * 60
        assert (state.pool.component == PLAIN).sum() >= 2_000
        np.testing.assert_array_equal(np.flatnonzero(state.pool.judged.violated[:2_000]), plain.row)
    ratio = np.array([each.probability for each in found]) / truth
    assert ratio.std() < 1.1 / np.sqrt(2_000 * truth)
    assert stats.ttest_1samp(ratio, 1.0).pvalue > 1e-4
    assert sum(each.ci_low <= truth <= each.ci_high for each in found) >= 15
