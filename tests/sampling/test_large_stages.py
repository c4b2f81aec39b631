"""Stages sampled in parts: what stays of them, what is learned, and what every method adds up."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.runs.ranking import LEAST_ROBUST
from pemviz.sampling.adaptive.method import AdaptiveSampling, FromAll, FromElites
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.estimators import importance_sampling_estimate, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import smoothed_weights
from pemviz.sampling.method import elite_threshold, elites
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.rollouts.large_stages import (
    LISTED,
    Thinned,
    WeighedRollouts,
    largest_held,
    largest_part,
    part_sizes,
    weighed,
)
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.types import RolloutBatch, ScoredRollouts, numbers_of, place_of
from tests.pooled import pool_outcomes
from tests.toy import carried_out, exact_failure_probability, simulated_in

TRUTH = exact_failure_probability(steps=6, miss_probability=0.1)


@given(count=st.integers(1, 10**7), largest=st.integers(1, 10**6))
def test_parts_add_up_and_are_alike(count, largest):
    if count / largest > 10_000:
        return
    sizes = part_sizes(count, largest=largest)
    assert sum(sizes) == count
    assert max(sizes) <= largest
    assert max(sizes) - min(sizes) <= 1
    assert len(sizes) == -(-count // largest)


@pytest.mark.parametrize(("states", "expected"), [(100, 20_000), (2_000, 1_000), (10**7, 1)])
def test_long_rollouts_make_small_parts(states, expected):
    assert largest_part(states=states) == expected


def below_zero(states):
    return states.signals["gap"] < 0.0


def methods(simulator, *, largest):
    shared = {"seed": 3, "largest_part": largest}
    learning = {"learning_stages": 3, "rollouts": 400, "final_rollouts": 3000}
    return {
        "naive": DirectSampling(
            name="naive", proposal=ConstantProposal(0.5), rollouts=3000, **shared
        ),
        "monte-carlo": DirectSampling(
            name="monte-carlo", proposal=PemProposal(), rollouts=3000, **shared
        ),
        "zero-variance": ZeroVarianceSampling(twin=simulator, rollouts=3000, **shared),
        "mixture": MixtureSampling(**learning, **shared),
        "adaptive": AdaptiveSampling(
            **learning, **shared, sigma=0.95, alpha=0.1, epochs=50, learning_rate=1e-2
        ),
    }


@pytest.mark.parametrize("name", ["naive", "monte-carlo", "zero-variance", "mixture", "adaptive"])
def test_parts_estimate_what_the_whole_does(toy_problem, name):
    """Two-sided at 5 standard errors around the exact answer: false alarm 6e-7 each."""
    problem = replace(toy_problem, unsafe=below_zero)
    found = {}
    for largest in (1000, 10_000):
        method = methods(problem.simulator, largest=largest)[name]
        estimate, stages = carried_out(method, problem)
        assert len(stages) == method.stages
        assert [stage.stage for stage in stages] == list(range(len(stages)))
        final = [stage.scored.rollouts.count for stage in stages if stage.kind == "final"]
        assert final == ([1000] * 3 if largest == 1000 else [3000])
        assert estimate.rollouts_simulated == simulated_in(stages)
        assert estimate.unbiased_probability == pytest.approx(
            TRUTH, abs=5 * estimate.unbiased_std_error + 1e-12
        )
        found[largest] = estimate
    assert found[1000].failures != 0
    assert np.isclose(found[1000].std_error, found[10_000].std_error, rtol=0.6, atol=1e-6)


@given(
    violated=st.lists(st.booleans(), min_size=2, max_size=40),
    cut=st.integers(1, 39),
    seed=st.integers(0, 2**31),
)
def test_what_is_kept_of_parts_gives_the_estimate_of_all_their_rollouts(violated, cut, seed):
    """Held against the averages written out over all rollouts, those of weight 0 too."""
    scored = random_scores(np.array(violated), np.random.default_rng(seed))
    parts = [scored.take(slice(cut)), scored.take(slice(cut, None))]
    joined = WeighedRollouts.concatenate([weighed(part) for part in parts])
    whole = weighed(scored)
    for name in ("row", "log_weight", "log_p"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name), err_msg=name)
    assert joined.count == len(violated)
    for kept, fails in (
        (joined, scored.violated),
        (joined.under_rule("odd"), scored.broken["odd"]),
    ):
        estimate = importance_sampling_estimate(kept, method="naive", rollouts_simulated=0)
        weight = np.exp(scored.rollouts.log_weight) * fails
        assert estimate.failures == kept.failures == fails.sum()
        assert estimate.rollouts_in_estimate == len(violated)
        assert estimate.probability == pytest.approx(weight.mean(), rel=1e-12)
        if fails.any():
            error = weight.std(ddof=1) / np.sqrt(weight.size)
            assert estimate.std_error == pytest.approx(error, rel=1e-9, abs=1e-14)
            log_p = scored.rollouts.log_p.sum(axis=1)[fails]
            assert estimate.nll_mean == pytest.approx(-log_p.mean(), rel=1e-12)


def random_scores(violated, generator):
    shape = (violated.size, 5)
    rollouts = RolloutBatch(
        signals={},
        memory={},
        detected=generator.random(shape) < 0.5,
        pem_logit=generator.normal(size=shape),
        proposal_logit=generator.normal(size=shape),
    )
    broken = {"odd": violated & (np.arange(violated.size) % 2 == 1)}
    return ScoredRollouts(rollouts, generator.normal(size=violated.size), violated, broken=broken)


def test_an_estimate_from_a_hundred_million_rollouts_keeps_the_violations_alone():
    """As many parts as 10^8 rollouts take; the interval is that of the beta distribution."""
    part = WeighedRollouts(20_000, np.array([19_999]), np.zeros(1), np.array([-3.0]))
    whole = WeighedRollouts.concatenate([part] * 5_000)
    assert (whole.count, whole.failures) == (100_000_000, 5_000)
    assert whole.row.dtype == np.int64
    assert whole.row[-1] == 99_999_999
    estimate = monte_carlo_estimate(whole, method="monte-carlo")
    assert estimate.probability == 5e-5
    assert estimate.rollouts_in_estimate == 100_000_000
    assert estimate.std_error == pytest.approx(np.sqrt(5e-5 * (1 - 5e-5) / 1e8), rel=1e-12)
    assert estimate.ci_low == pytest.approx(stats.beta.ppf(0.025, 5_000, 1e8 - 4_999), rel=1e-9)
    assert estimate.ci_high == pytest.approx(stats.beta.ppf(0.975, 5_001, 1e8 - 5_000), rel=1e-9)
    assert estimate.nll_mean == 3.0


COUNT, STEPS = 400, 6


def stage_of(seed, *, level=0.0, count=COUNT):
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
    scored = stage_of(seed, level=level)
    so_far = Thinned(count=COUNT, most=most)
    for batch in batches(scored, cuts):
        so_far = so_far.extended(batch)
    held, sampled = so_far.done()
    least = np.lexsort((scored.robustness, ~scored.violated))[:most]
    listed = [
        np.argsort(ranks, kind="stable")[:LISTED]
        for ranks in (scored.robustness, scored.rule_robustness["other"])
    ]
    even = np.arange(0, COUNT, sampled.every)
    expected = np.unique(np.concatenate([least, *listed, even]))
    np.testing.assert_array_equal(sampled.row, expected)
    np.testing.assert_array_equal(np.flatnonzero(sampled.even), np.searchsorted(expected, even))
    for name in ("detected", "pem_logit"):
        values = getattr(scored.rollouts, name)[expected]
        np.testing.assert_array_equal(getattr(held.rollouts, name), values)
    np.testing.assert_array_equal(held.broken["other"], scored.broken["other"][expected])
    assert sampled.count == COUNT
    for name in ("robustness", "violated"):
        np.testing.assert_array_equal(getattr(sampled, name), getattr(scored, name))
    np.testing.assert_array_equal(sampled.log_weight, scored.rollouts.log_weight)


def test_rows_that_wait_are_bounded(monkeypatch):
    """However many violate: those that stay, as many that wait, and a batch."""
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.LISTED", 3)
    monkeypatch.setattr("pemviz.sampling.rollouts.large_stages.EVEN", 10)
    so_far, most = Thinned(count=100 * COUNT, most=50), 0
    for seed in range(100):
        so_far = so_far.extended(stage_of(seed, level=-12.0))
        most = max(most, sum(part.rollouts.count for part in so_far.held))
    assert sum(part.sum() for part in so_far.violated) > 35_000
    assert 50 < most <= 50 + 3 + 3 + 10 + 50
    held, sampled = so_far.done()
    assert held.rollouts.count == sampled.row.size <= 50 + 3 + 3 + 10


def test_a_long_scenario_s_rollouts_are_fewer():
    assert largest_held(states=100) == 10 * largest_held(states=1000)
    assert largest_held(states=10**6) == LISTED >= LEAST_ROBUST


def test_places_of_rollouts_that_a_stage_holds():
    scored = stage_of(3)
    _, sampled = Thinned(count=COUNT, most=20).extended(scored).done()
    seventh = int(sampled.row[7])
    assert numbers_of(sampled.row.size, sampled)[place_of(seventh, sampled)] == seventh
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
    scored = stage_of(seed, level=level)
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
    scored = stage_of(seed)
    lesson = FromAll.of(COUNT)
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
        lesson = lesson.extended(stage_of(seed, level=level))
        most = max(most, sum(part.robustness.size for part in lesson.held))
    assert 400 <= most <= bound
