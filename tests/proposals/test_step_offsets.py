"""Proposals that look at the step alone, against a minimiser and against refits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import expit, logit

from pemviz.proposals.offset_logistic import OffsetLogisticProposal, PolynomialBasis, SignalFeatures
from pemviz.proposals.offset_logistic_fit import WeightedOutcomes
from pemviz.proposals.step_offsets import RIDGE, fit_step_offsets
from pemviz.types import Signal, StateBatch

STEPS = 30
NEEDED = (4, 5, 20)


def outcomes_of(missed, weight, miss):
    """Outcomes ``[N, T-1]`` of rollouts of weights ``[N]``, under probabilities ``[T-1]``."""
    count, steps = missed.shape
    outcomes = WeightedOutcomes(
        basis=np.zeros((missed.size, 0)),
        missed=missed.ravel(),
        offset=np.tile(logit(miss), count),
        weight=np.repeat(weight, steps),
    )
    return outcomes, np.tile(np.arange(steps), count), np.repeat(np.arange(count), steps)


def fitted_to(missed, weight, miss):
    outcomes, step, group = outcomes_of(missed, weight, miss)
    count, steps = missed.shape
    return fit_step_offsets(outcomes, step=step, steps=steps, group=group, count=count)


def log_likelihood(missed, offset, miss):
    """Of outcomes ``[N, T-1]`` each, offsets added to logits ``[T-1]``."""
    probability = expit(logit(miss) + offset)
    return np.log(np.where(missed, probability, 1.0 - probability))


@pytest.fixture(scope="module")
def learned():
    """40 rollouts that miss where it is needed, and otherwise as the model has it."""
    generator = np.random.default_rng(1)
    miss = generator.uniform(0.02, 0.3, STEPS)
    missed = generator.random((40, STEPS)) < miss
    missed[:, list(NEEDED)] = generator.random((40, len(NEEDED))) < 0.9
    return missed, generator.uniform(0.2, 1.0, 40), miss


def test_offsets_are_where_the_penalised_likelihood_is_largest(learned):
    missed, weight, miss = learned
    found = fitted_to(missed, weight, miss)
    assert np.flatnonzero(found.offsets).tolist() == list(NEEDED)
    for step in NEEDED:

        def loss(offset, step=step):
            of_each = log_likelihood(missed[:, [step]], offset, miss[[step]])[:, 0]
            return 0.5 * RIDGE * offset**2 - weight @ of_each

        expected = minimize_scalar(loss, bounds=(-12.0, 12.0), method="bounded").x
        assert found.offsets[step] == pytest.approx(expected, abs=1e-4)


def test_what_each_rollout_is_overstated_by_is_what_a_fit_without_it_loses(learned):
    """Within a tenth for the sum, a fifth for those that it matters for."""
    missed, weight, miss = learned
    found = fitted_to(missed, weight, miss)
    own = log_likelihood(missed, found.offsets, miss).sum(axis=1)
    without = np.array(
        [
            log_likelihood(missed[[row]], fitted_to(missed, left, miss).offsets, miss).sum()
            for row, left in enumerate(weight * ~np.eye(40, dtype=bool))
        ]
    )
    assert found.optimism.sum() == pytest.approx((own - without).sum(), rel=0.1)
    large = found.optimism > 0.1
    assert large.sum() >= 3
    np.testing.assert_allclose(found.optimism[large], (own - without)[large], rtol=0.2)
    assert found.log_likelihood == pytest.approx(weight @ (own - found.optimism))


def test_outcomes_that_follow_the_model_move_nothing():
    """100 fits of 30 steps; one in 30 would move a step at 2 log 30 nats: 4 standard errors."""
    generator = np.random.default_rng(2)
    miss = np.full(STEPS, 0.2)
    moved = [
        fitted_to(generator.random((60, STEPS)) < miss, np.ones(60), miss).offsets.any()
        for _ in range(100)
    ]
    assert sum(moved) <= 10


def test_a_model_that_hardly_ever_misses_is_moved_by_no_more_than_a_proposal_may():
    missed = np.ones((500, 3), dtype=bool)
    found = fitted_to(missed, np.ones(500), np.full(3, 1e-200))
    assert found.offsets.tolist() == [12.0] * 3
    assert np.isfinite(found.log_likelihood)


@pytest.mark.parametrize("by_row", [False, True])
def test_a_proposal_adds_the_offset_of_the_step(by_row):
    """Mixed with the error model, whatever the state; in each row its own."""
    signal = Signal(name="x", key="x", unit="1", low=0.0, high=1.0)
    offsets = np.array([[0.0, 2.0, -1.0], [1.0, 0.0, 3.0]])
    basis = PolynomialBasis(np.zeros(2), np.ones(2), 1)
    proposal = OffsetLogisticProposal(
        features=SignalFeatures((signal,)),
        basis=basis,
        coefficients=np.zeros((2, 3)) if by_row else np.zeros(3),
        violated="nothing",
        defensive=0.1,
        by_step=offsets if by_row else offsets[1],
    )
    for step in range(3):
        states = StateBatch(step=np.array(step), signals={"x": np.array([0.3, 0.9])})
        found = proposal.logit(states, np.array([1.0, 2.0]))
        raised = offsets[:, step] if by_row else offsets[[1, 1], step]
        detected = 0.9 * expit(np.array([1.0, 2.0]) - raised) + 0.1 * expit(np.array([1.0, 2.0]))
        np.testing.assert_allclose(expit(found), detected)
    if not by_row:  # all steps of rollouts at once
        states = StateBatch(step=np.arange(3)[None], signals={"x": np.zeros((2, 3))})
        whole = proposal.logit(states, np.full((2, 3), 1.0))
        one = replace(proposal, by_step=np.zeros(3)).logit(states, np.full((2, 3), 1.0))
        assert (np.abs(whole - one) > 0.1).tolist() == [[True, False, True]] * 2
        assert proposal.arrays()["by_step"].tolist() == offsets[1].tolist()
