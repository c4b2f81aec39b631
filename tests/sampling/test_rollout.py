from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz.config import ScenarioConfig
from pemviz.pem import load_pem
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.gap_network import GapNetwork
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollouts.simulate import replay, simulate
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import outcome_log_likelihood


def random_network(seed: int) -> GapNetwork:
    generator = np.random.default_rng(seed)
    shapes = ((32, 1), (32, 32), (2, 32))
    return GapNetwork(
        weights=tuple(generator.normal(size=shape) for shape in shapes),
        biases=tuple(generator.normal(size=shape[0]) for shape in shapes),
    )


@pytest.fixture(scope="module")
def braking() -> Problem:
    return Problem(
        simulator=VectorizedSimulator(ScenarioConfig()),
        pem=load_pem("ml-nn"),
        robustness=lambda signals: np.min(signals["gap"], axis=1) - 2.0,
        violated=lambda signals: np.min(signals["gap"], axis=1) < 2.0,
    )


@pytest.mark.parametrize("batch", [1, 7, 64])
def test_batches_do_not_change_a_bit(braking, batch):
    def drawn(batch_rollouts):
        return sample(
            replace(braking, batch_rollouts=batch_rollouts),
            proposal=random_network(3), count=64, seeds=np.random.SeedSequence(5),
        )  # fmt: skip

    whole, parts = drawn(4096), drawn(batch)
    for name in whole.rollouts.signals:
        np.testing.assert_array_equal(whole.rollouts.signals[name], parts.rollouts.signals[name])
    np.testing.assert_array_equal(whole.rollouts.log_weight, parts.rollouts.log_weight)
    np.testing.assert_array_equal(whole.rollouts.detected, parts.rollouts.detected)


def test_rollouts_replay_from_their_outcomes(braking):
    scored = sample(
        braking, proposal=ConstantProposal(0.5), count=20, seeds=np.random.SeedSequence(1)
    )
    again = replay(simulator=braking.simulator, detected=scored.rollouts.detected)
    for name, values in again.items():
        np.testing.assert_array_equal(values, scored.rollouts.signals[name])


def test_weights_agree_with_a_naive_product(braking):
    proposal = random_network(11)
    rollouts = sample(braking, proposal=proposal, count=5, seeds=np.random.SeedSequence(2)).rollouts
    for row in range(5):
        weight = 1.0
        for step in range(99):
            gap_m = rollouts.signals["gap"][row, step : step + 1]
            p = 1 / (1 + np.exp(-braking.pem.logit(braking.simulator.salient({"gap": gap_m}))[0]))
            q = 1 / (1 + np.exp(-proposal.logit_at(gap_m)[0]))
            hit = rollouts.detected[row, step]
            weight *= (p / q) if hit else (1 - p) / (1 - q)
        assert np.exp(rollouts.log_weight[row]) == pytest.approx(weight, rel=1e-9)


def test_outcomes_follow_the_proposal(toy_problem):
    """60,000 draws at 0.3: binomial z-test at 4 standard deviations, false alarm 6e-5."""
    scored = sample(
        toy_problem, proposal=ConstantProposal(0.3), count=10_000, seeds=np.random.SeedSequence(0)
    )
    share = scored.rollouts.detected.mean()
    assert abs(share - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 60_000)


def test_a_draw_on_the_boundary_detects(toy_problem):
    """P(miss) = 0.1: draws below it miss, draws at or above it detect."""
    uniforms = np.array([[0.0, 0.0999, 0.1001, 0.5, 0.9999, 0.0]])
    rollouts = simulate(
        simulator=toy_problem.simulator, pem=toy_problem.pem,
        proposal=PemProposal(), uniforms=uniforms,
    )  # fmt: skip
    assert rollouts.detected.tolist() == [[False, False, True, True, True, False]]


@given(st.floats(-700, 700), st.booleans())
def test_outcome_log_likelihood_is_finite_and_normalised(logit, detected):
    logits = np.array([logit, logit])
    both = outcome_log_likelihood(logits, np.array([True, False]))
    assert np.isfinite(both).all()
    assert np.exp(both).sum() == pytest.approx(1.0)
    chosen = outcome_log_likelihood(logits[:1], np.array([detected]))[0]
    assert chosen == both[0 if detected else 1]
