"""Bursts of misses, and what shorter ones would bring, over all chains of outcomes of a walk."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit, logit

from pemviz.analysis.causes import bursts_of, failures_of, weighted_spread
from pemviz.analysis.outcome_likelihood import IndependentOutcomes, RememberedOutcomes
from pemviz.analysis.sensitivity import band_sensitivities, memory_sensitivity
from pemviz.proposals.fixed import ConstantProposal
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.sampling.state.composed import ComposedPem, with_last_outcome
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.types import VIOLATED, RolloutBatch, ScoredRollouts
from tests.lattice_walk import ToyPem, ToySimulator, toy_violated
from tests.sampling.test_memory import by_enumeration

WALK = ToySimulator(initial_gap=3, largest_gap=5, states=10)
PEM = ToyPem(at_zero=2.0, slope=0.3)
EDGES = (1.0, 2.0, 4.0, 6.0)
TAUS_S = (0.4, 2.0, 30.0)
"""The walk takes 1 s a step."""


@dataclass(frozen=True)
class Scaled:
    """The walk's error model with misses in a band ``factor`` times as likely."""

    factor: float
    low: float
    high: float

    def logit(self, salient):
        gap, miss = salient[..., 0], expit(-PEM.logit(salient))
        inside = (gap >= self.low) & (gap < self.high)
        return -logit(np.where(inside, self.factor * miss, miss))


def all_failures(tau_s):
    """Every chain of outcomes that fails, by its own likelihood: expectations are exact."""
    steps = WALK.states - 1
    draws = np.array(list(itertools.product((0.25, 0.75), repeat=steps)))
    pem = ComposedPem(PEM, (LastOutcome(tau_s, WALK.dt_s),))
    rollouts = simulate(
        simulator=with_last_outcome(WALK, tau_s=tau_s),
        pem=pem,
        proposal=ConstantProposal(0.5),
        uniforms=draws,
    )
    violated = toy_violated(rollouts.signals)
    failed = np.cumsum(rollouts.signals["gap"] <= 0.0, axis=1) > 0
    scored = ScoredRollouts(
        replace(rollouts, memory={VIOLATED: failed}), np.where(violated, -1.0, 1.0), violated
    )
    failures = failures_of(scored)
    assert failures is not None
    return failures, math.log(np.exp(rollouts.log_weight[violated]).sum() / len(draws))


def difference(answer):
    """Derivative of log answer(factor) in the log of the factor, at 1."""
    step = 1e-4
    higher, lower = answer(math.exp(step)), answer(math.exp(-step))
    return (math.log(higher) - math.log(lower)) / (2.0 * step)


@pytest.mark.parametrize("tau_s", TAUS_S)
def test_sensitivities_are_derivatives_of_the_exact_answer(tau_s):
    failures, log_probability = all_failures(tau_s)
    truth = by_enumeration(WALK, PEM, tau_s=tau_s)
    assert math.exp(log_probability) == pytest.approx(truth, rel=1e-9)
    likelihood = RememberedOutcomes.of(failures.rollouts, tau_s=tau_s, dt_s=1.0)
    memory = memory_sensitivity(failures, likelihood, log_probability=log_probability)
    expected = difference(lambda factor: by_enumeration(WALK, PEM, tau_s=factor * tau_s))
    assert memory.elasticity == pytest.approx(expected, rel=1e-5)
    rows = band_sensitivities(
        failures, log_probability=log_probability, edges=EDGES, likelihood=likelihood
    )
    for row in rows:
        low, high = (0.0, 99.0) if row.low is None else (row.low, row.high)
        expected = difference(
            lambda factor, low=low, high=high: by_enumeration(
                WALK, Scaled(factor, low, high), tau_s=tau_s
            )
        )
        assert row.elasticity == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("tau_s", TAUS_S)
def test_requirements_meet_the_target_exactly(tau_s):
    failures, log_probability = all_failures(tau_s)
    likelihood = RememberedOutcomes.of(failures.rollouts, tau_s=tau_s, dt_s=1.0)
    target = 0.97 * math.exp(log_probability)
    aim = {"log_probability": log_probability, "target": target}
    rows = band_sensitivities(failures, edges=(0.0, 6.0), likelihood=likelihood, **aim)
    for row in rows:
        pem = Scaled(row.target_factor, 0.0, 99.0)
        assert by_enumeration(WALK, pem, tau_s=tau_s) == pytest.approx(target, rel=1e-6)
    memory = memory_sensitivity(failures, likelihood, **aim)
    if by_enumeration(WALK, PEM, tau_s=0.0) < target:
        found = by_enumeration(WALK, PEM, tau_s=memory.target_tau_s)
        assert found == pytest.approx(target, rel=1e-6)
    else:
        assert memory.target_tau_s is None
        assert "even without a memory" in memory.warning
    met = memory_sensitivity(failures, likelihood, log_probability=log_probability, target=0.999)
    assert met.target_tau_s == tau_s


def test_a_memory_that_is_over_between_two_frames_is_none():
    """At 1/700 of a step nothing is left of the outcome before."""
    failures, _ = all_failures(1.0 / 700.0)
    remembered = RememberedOutcomes.of(failures.rollouts, tau_s=1.0 / 700.0, dt_s=1.0)
    plain = IndependentOutcomes.of(failures.rollouts)
    np.testing.assert_allclose(remembered.slope(), plain.slope(), rtol=1e-12)
    one, other = (each.log_change(factor=0.3) for each in (remembered, plain))
    np.testing.assert_allclose(one, other, rtol=1e-12)
    np.testing.assert_allclose(remembered.slope_of_tau(), 0.0, atol=1e-12)


def two_rollouts():
    """Missed (x), at frames where the outcome matters (X), after the violation (v)."""
    texts = (".xX.XXXx.vv", "x..XX.Xx.XX")
    missed = np.array([[c in "xXv" for c in text] for text in texts])
    after = np.array([[c == "v" for c in text] + [False] for text in texts])
    after[0, 8:] = True
    log_p = np.linspace(-1.0, -3.0, missed.size).reshape(missed.shape)
    under = np.where(missed, np.log(np.expm1(-log_p)), -np.log(np.expm1(-log_p)))
    rollouts = RolloutBatch(
        signals={"gap": np.tile(np.arange(12.0, 0.0, -1.0), (2, 1))},
        memory={VIOLATED: after},
        detected=~missed,
        pem_logit=under,
        proposal_logit=under + np.array([[0.0], [0.1]]),
    )
    np.testing.assert_allclose(rollouts.log_p, log_p)
    scored = ScoredRollouts(rollouts, -np.ones(2), np.ones(2, dtype=bool))
    return scored, np.array([[c in "XV" for c in text] for text in texts]), log_p


def test_bursts_are_counted_by_hand():
    scored, mattering, log_p = two_rollouts()
    failures = failures_of(scored)
    share = failures.share
    found = bursts_of(failures, mattering=mattering, dt_s=0.1)
    assert found.count == pytest.approx(share @ [2, 3])
    assert found.misses == pytest.approx(share @ [6, 6])
    lengths, starts = np.array([4, 2]), np.array([4, 9])
    assert found.frames == weighted_spread(lengths, share)
    assert found.begins_s == weighted_spread(0.1 * starts, share)
    assert found.begins_gap_m == weighted_spread(12.0 - starts, share)
    log_start = log_p[[0, 1], starts]
    log_rest = np.array([log_p[0, 5:8].sum(), log_p[1, 10]])
    assert found.start == pytest.approx(math.exp(share @ log_start))
    assert found.whole == pytest.approx(math.exp(share @ log_rest))
    assert found.again == pytest.approx(math.exp(share @ log_rest / (share @ (lengths - 1))))
    assert bursts_of(failures, mattering=np.zeros_like(mattering), dt_s=0.1) is None


def test_a_weighted_spread_is_that_of_repeated_values():
    values, counts = np.array([3.0, 1.0, 2.0, 7.0]), np.array([2, 3, 4, 11])
    repeated = np.repeat(values, counts)
    found = weighted_spread(values, counts / counts.sum())
    expected = np.quantile(repeated, (0.5, 0.1, 0.9), method="inverted_cdf")
    assert (found.median, found.low, found.high) == tuple(expected)
