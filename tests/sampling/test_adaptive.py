from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pemviz.config import ScenarioConfig
from pemviz.pem import load_pem
from pemviz.proposals.fixed import PemProposal
from pemviz.proposals.gap_network import GapNetwork
from pemviz.sampling.adaptive.method import AdaptiveSampling
from pemviz.sampling.method import elite_threshold
from pemviz.sampling.problem import Problem
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from tests.toy import MissCounter, carried_out, constant_pem, exact_failure_probability


def method(**changes) -> AdaptiveSampling:
    settings = {
        "learning_stages": 3, "rollouts": 60, "final_rollouts": 40, "sigma": 0.95, "alpha": 0.1,
        "epochs": 20, "learning_rate": 1e-3, "seed": 0,
    }  # fmt: skip
    return AdaptiveSampling(**(settings | changes))


@pytest.fixture(scope="module")
def braking() -> Problem:
    return Problem(
        simulator=VectorizedSimulator(ScenarioConfig()),
        pem=load_pem("ml-nn"),
        robustness=lambda signals: np.min(signals["gap"], axis=1) - 2.0,
        violated=lambda signals: np.min(signals["gap"], axis=1) < 2.0,
    )


def test_stages_are_those_of_algorithm_1(braking):
    estimate, results = carried_out(method(), braking)
    assert [r.kind for r in results] == ["pretrain", "learn", "learn", "learn", "final"]
    assert [r.stage for r in results] == [0, 1, 2, 3, 4]
    assert isinstance(results[0].sampled_from, PemProposal)
    assert results[0].elites == 60
    for before, after in pairwise(results):
        assert after.sampled_from is before.learned
    for result in results[1:-1]:
        assert result.threshold == elite_threshold(result.scored.robustness, sigma=0.95)
        assert result.elites == (result.scored.robustness <= result.threshold).sum()
        assert result.threshold >= 0.0
    assert results[-1].learned is None
    assert estimate.rollouts_simulated == 4 * 60 + 40
    assert estimate.rollouts_in_estimate == 40
    assert estimate.failures == results[-1].failures


def test_pretraining_samples_from_the_model_and_weighs_all_rollouts_alike(braking):
    _, results = carried_out(method(), braking)
    np.testing.assert_array_equal(results[0].scored.rollouts.log_weight, 0.0)


def test_same_seed_same_numbers_and_other_seeds_other_numbers(braking):
    once, first = carried_out(method(), braking)
    again, second = carried_out(method(), braking)
    assert once == again
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.scored.robustness, b.scored.robustness)
        assert a.loss == b.loss
    _, other = carried_out(method(seed=1), braking)
    _, repeated = carried_out(method(), braking, repetition=1)
    for different in (other, repeated):
        assert not np.array_equal(
            first[1].scored.rollouts.detected, different[1].scored.rollouts.detected
        )


def test_a_repetition_does_not_depend_on_those_before_it(braking):
    alone, _ = carried_out(method(), braking, repetition=2)
    for repetition in range(3):
        found, _ = carried_out(method(), braking, repetition=repetition)
    assert found == alone


def test_it_finds_a_known_rare_probability():
    """Twelve steps that each miss with 2 %, four misses or more violate: mu = 6.9e-5.

    Eight repetitions; their median must lie within a factor of two of the truth. The fixed
    seed makes this repeatable; over 40 other seeds all medians of eight did.
    """
    problem = Problem(
        simulator=MissCounter(states=13),
        pem=constant_pem(detection_probability=0.98),
        robustness=lambda signals: np.min(signals["gap"], axis=1),
        violated=lambda signals: np.min(signals["gap"], axis=1) < 0.0,
    )
    truth = exact_failure_probability(steps=12, miss_probability=0.02)
    adaptive = method(learning_stages=6, rollouts=100, final_rollouts=200, epochs=300)
    found = [carried_out(adaptive, problem, repetition=r)[0] for r in range(8)]
    assert np.median([e.probability for e in found]) == pytest.approx(truth, rel=1.0)
    assert min(e.failures for e in found) > 20


def test_a_network_that_is_evaluated_before_the_end_says_so(braking):
    adaptive = method()
    with pytest.raises(ValueError, match="not been sampled"):
        adaptive.estimate(adaptive.init(braking, repetition=0))


def test_learned_proposals_are_gap_networks(braking):
    _, results = carried_out(method(learning_stages=1), braking)
    assert all(isinstance(r.learned, GapNetwork) for r in results[:-1])
    assert replace(results[0], loss=None).loss is None
