"""A final batch drawn in parts is as good as one, and every method adds the parts up."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.sampling.adaptive.method import AdaptiveSampling
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.mixture.method import MixtureSampling
from pemviz.sampling.rollouts.final_batch import largest_part, part_sizes
from pemviz.sampling.value_twisted.method import ValueTwistedSampling
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
        "value-twisted": ValueTwistedSampling(twin=simulator, rollouts=3000, **shared),
        "mixture": MixtureSampling(**learning, **shared),
        "adaptive": AdaptiveSampling(
            **learning, **shared, sigma=0.95, alpha=0.1, epochs=50, learning_rate=1e-2
        ),
    }


@pytest.mark.parametrize("name", ["naive", "monte-carlo", "value-twisted", "mixture", "adaptive"])
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
