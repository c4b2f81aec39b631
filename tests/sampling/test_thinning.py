"""A large stage that is learned from, a batch at a time: what stays of it, and what is learned."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.runs.ranking import LEAST_ROBUST
from pemviz.sampling.adaptive.method import FromAll, FromElites
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.method import elite_threshold, elites
from pemviz.sampling.rollouts.large_stages import LISTED, Thinned, largest_held
from pemviz.types import RolloutBatch, ScoredRollouts, numbers_of, place_of
from tests.pooled import pool_outcomes

COUNT, STEPS = 400, 6


def stage(seed, *, level=0.0, count=COUNT):
    """Robustness has ties; gaps come again; weights differ."""
    generator = np.random.default_rng(seed)
    shape = (count, STEPS)
    gap = generator.integers(0, 9, size=(count, STEPS + 1)) / 7.0
    robustness = generator.integers(-40, 200, size=count) / 20.0 + level
    rollouts = RolloutBatch(
        signals={"gap": gap},
        memory={},
        detected=generator.random(shape) < 0.6,
        pem_logit=generator.normal(size=shape),
        proposal_logit=generator.normal(size=shape),
    ).map(np.asfortranarray)
    other = generator.normal(size=count)
    return ScoredRollouts(
        rollouts, robustness, robustness < 0.0, {"other": other}, {"other": other < 0.0}
    )


def batches(scored, cuts):
    edges = [0, *sorted({cut % COUNT for cut in cuts} - {0}), COUNT]
    return [scored.take(slice(*pair)) for pair in itertools.pairwise(edges)]


anywhere = st.lists(st.integers(0, COUNT - 1), max_size=12)
seeds = st.integers(0, 2**31)


@given(seed=seeds, cuts=anywhere, most=st.integers(1, 150), level=st.sampled_from([-12, 0, 3]))
def test_what_stays_does_not_depend_on_batches(seed, cuts, most, level):
    scored = stage(seed, level=level)
    so_far = Thinned(count=COUNT, most=most)
    for batch in batches(scored, cuts):
        so_far = so_far.extended(batch)
    held, drawn = so_far.done()
    least = np.lexsort((scored.robustness, ~scored.violated))[:most]
    listed = [
        np.argsort(ranks, kind="stable")[:LISTED]
        for ranks in (scored.robustness, scored.rule_robustness["other"])
    ]
    even = np.arange(0, COUNT, drawn.every)
    expected = np.unique(np.concatenate([least, *listed, even]))
    np.testing.assert_array_equal(drawn.row, expected)
    np.testing.assert_array_equal(np.flatnonzero(drawn.even), np.searchsorted(expected, even))
    for name in ("detected", "pem_logit"):
        values = getattr(scored.rollouts, name)[expected]
        np.testing.assert_array_equal(getattr(held.rollouts, name), values)
    np.testing.assert_array_equal(held.broken["other"], scored.broken["other"][expected])
    assert drawn.count == COUNT
    for name in ("robustness", "violated"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(scored, name))
    np.testing.assert_array_equal(drawn.log_weight, scored.rollouts.log_weight)


def test_rows_that_wait_are_bounded(monkeypatch):
    """However many violate: those that stay, as many that wait, and a batch."""
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.LISTED", 3)
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.EVEN", 10)
    so_far, most = Thinned(count=100 * COUNT, most=50), 0
    for seed in range(100):
        so_far = so_far.extended(stage(seed, level=-12.0))
        most = max(most, sum(part.rollouts.count for part in so_far.held))
    assert sum(part.sum() for part in so_far.violated) > 35_000
    assert 50 < most <= 50 + 3 + 3 + 10 + 50
    held, drawn = so_far.done()
    assert held.rollouts.count == drawn.row.size <= 50 + 3 + 3 + 10


def test_a_long_scenario_s_rollouts_are_fewer():
    assert largest_held(states=100) == 10 * largest_held(states=1000)
    assert largest_held(states=10**6) == LISTED >= LEAST_ROBUST


def test_places_of_rollouts_that_a_stage_holds():
    scored = stage(3)
    _, drawn = Thinned(count=COUNT, most=20).extended(scored).done()
    assert numbers_of(drawn.row.size, drawn)[place_of(int(drawn.row[7]), drawn)] == drawn.row[7]
    assert place_of(7, None) == 7
    assert numbers_of(3, None).tolist() == [0, 1, 2]


def naive_table(scored, weight):
    """By gap: the weights of outcomes, one after the other in the order of the rollouts."""
    sums = {}
    gap = scored.rollouts.signals["gap"][:, :-1]
    for rollout, share in enumerate(weight.tolist()):
        for step in range(STEPS):
            pair = sums.setdefault(float(gap[rollout, step]), [0.0, 0.0])
            pair[not scored.rollouts.detected[rollout, step]] += share / STEPS
    return sums


def assert_same(table, expected):
    assert table.gap_m.tolist() == sorted(expected)
    pairs = list(zip(table.detected_weight.tolist(), table.missed_weight.tolist(), strict=True))
    assert [list(pair) for pair in pairs] == [expected[gap] for gap in sorted(expected)]


@given(seed=seeds, cuts=anywhere, level=st.sampled_from([-12, -5, 0, 3]))
def test_elites_teach_the_same_to_the_last_bit_in_batches(seed, cuts, level):
    scored = stage(seed, level=level)
    lesson = FromElites.of(COUNT, sigma=0.9, alpha=0.3)
    for batch in batches(scored, cuts):
        lesson = lesson.extended(batch)
    learned = lesson.learned(scored.robustness)
    threshold = elite_threshold(scored.robustness, sigma=0.9)
    chosen = elites(scored.robustness, threshold=threshold)
    assert (learned.threshold, learned.elites) == (threshold, chosen.sum())
    assert learned.elites >= COUNT // 10
    few = scored.take(chosen)
    weight = smoothed_weights(few.rollouts.log_weight, alpha=0.3)
    assert_same(learned.table, naive_table(few, weight))
    at_once = pool_outcomes(
        gap_m=few.rollouts.signals["gap"][:, :-1],
        detected=few.rollouts.detected,
        rollout_weight=weight,
    )
    assert_same(at_once, naive_table(few, weight))


@given(seed=seeds, cuts=anywhere)
def test_all_teach_the_same_to_the_last_bit_in_batches(seed, cuts):
    scored = stage(seed)
    lesson = FromAll(COUNT)
    for batch in batches(scored, cuts):
        lesson = lesson.extended(batch)
    learned = lesson.learned(scored.robustness)
    weight = smoothed_weights(np.zeros(COUNT), alpha=0.0)
    assert (learned.threshold, learned.elites) == (None, COUNT)
    assert_same(learned.table, naive_table(scored, weight))


@pytest.mark.parametrize(("level", "bound"), [(12.0, 1_600), (-20.0, 20_000)])
def test_candidates_are_few_where_elites_are(level, bound):
    """Of 20,000 rollouts 400 are elites, or all, where all violate."""
    lesson, most = FromElites.of(20_000, sigma=0.98, alpha=0.3), 0
    for seed in range(50):
        lesson = lesson.extended(stage(seed, level=level))
        most = max(most, sum(part.robustness.size for part in lesson.held))
    assert 400 <= most <= bound
