"""A final batch drawn in parts is as good as one, and every method adds the parts up."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.sampling.adaptive.method import AdaptiveSampling
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.estimates.estimate import importance_sampling_estimate, monte_carlo_estimate
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.rollouts.large_stages import WeighedRollouts, largest_part, part_sizes, weighed
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.types import RolloutBatch, ScoredRollouts
from tests.toy import exact_failure_probability

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
        state = method.init(problem, repetition=0)
        stages = []
        while not method.is_done(state):
            state, stage = method.step(problem, state)
            stages.append(stage)
        assert len(stages) == method.stages
        assert [stage.stage for stage in stages] == list(range(len(stages)))
        final = [stage.scored.rollouts.count for stage in stages if stage.kind == "final"]
        assert final == ([1000] * 3 if largest == 1000 else [3000])
        estimate = method.estimate(state)
        drawn = sum(stage.scored.rollouts.count for stage in stages)
        assert estimate.rollouts_simulated == drawn
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
