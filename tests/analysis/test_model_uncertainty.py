"""Other models' answers from the same rollouts, against binomial tails."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pemviz.analysis.model_uncertainty import (
    ENOUGH_FAILURES,
    MOST_FAILURES,
    extrapolation_warnings,
    member_estimates,
    model_interval,
)
from pemviz.config import ExperimentConfig
from pemviz.pem import load_pem, save_pem
from pemviz.proposals.fixed import ConstantProposal
from pemviz.runs.engine import run_experiment
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sampling.problem import sample
from tests.toy import ConstantPem, MissCounter, exact_failure_probability


@dataclass(frozen=True)
class Models:
    members: tuple[ConstantPem, ...]
    name: str = "constants"


@dataclass(frozen=True)
class SalientMissCounter(MissCounter):
    """Shows the eleven salient variables that reweighting expects."""

    def salient(self, signals):
        return np.zeros((*signals["gap"].shape, 11))


MISS = (0.02, 0.05, 0.1, 0.2)


@pytest.fixture
def scored(toy_problem):
    return sample(
        toy_problem, proposal=ConstantProposal(0.5), count=50_000, seeds=np.random.SeedSequence(3)
    )


def test_every_member_gets_its_own_answer(scored):
    """Four z-tests at 4 standard errors: false alarm 3e-4 together; the seed is fixed."""
    ensemble = Models(members=tuple(ConstantPem(miss) for miss in MISS))
    estimates = member_estimates(scored, simulator=SalientMissCounter(states=7), ensemble=ensemble)
    enough = math.ceil(scored.violated.size * ENOUGH_FAILURES / scored.violated.sum())
    assert enough < scored.violated.size
    misses = (~scored.rollouts.detected).sum(axis=1)[:enough]
    for log_mu, miss in zip(estimates.log_mu, MISS, strict=True):
        weight = (2 * miss) ** misses * (2 * (1 - miss)) ** (6 - misses) * scored.violated[:enough]
        assert math.exp(log_mu) == pytest.approx(weight.mean(), rel=1e-9)
        error = weight.std() / math.sqrt(weight.size)
        truth = exact_failure_probability(steps=6, miss_probability=miss)
        assert abs(math.exp(log_mu) - truth) < 4 * error


def test_every_member_gets_its_own_answer_to_every_rule(scored):
    """Weights by hand: (p/q)^misses ((1-p)/(1-q))^hits, q = 1/2, over all rollouts looked at.

    The rarer rule decides how many are: as many as hold enough that break it.
    """
    missed = ~scored.rollouts.detected
    broken = {"any": scored.violated, "all missed": missed.all(axis=1) & scored.violated}
    assert 0 < broken["all missed"].sum() < scored.violated.sum()
    ensemble = Models(members=tuple(ConstantPem(miss) for miss in MISS))
    simulator = SalientMissCounter(states=7)
    found = member_estimates(replace(scored, broken=broken), simulator=simulator, ensemble=ensemble)
    seen = scored.violated.size * MOST_FAILURES / scored.violated.sum()
    seen = math.ceil(min(seen, scored.violated.size))
    for name, some in broken.items():
        for log_mu, miss in zip(found.rules[name].log_mu, MISS, strict=True):
            misses = missed[:seen].sum(axis=1)
            weight = (2 * miss) ** misses * (2 * (1 - miss)) ** (6 - misses) * some[:seen]
            assert math.exp(log_mu) == pytest.approx(weight.mean(), rel=1e-9)
    np.testing.assert_array_equal(found.log_mu, found.rules["any"].log_mu)


def test_repetitions_are_pooled_by_their_mean(scored):
    ensemble = Models(members=tuple(ConstantPem(miss) for miss in MISS))
    simulator = SalientMissCounter(states=7)
    once = member_estimates(scored, simulator=simulator, ensemble=ensemble)
    assert model_interval([once, once]).low == pytest.approx(model_interval([once]).low)
    interval = model_interval([once])
    assert interval.members == 4
    assert interval.low is not None
    assert interval.high is not None
    assert math.exp(once.log_mu.min()) <= interval.low < interval.high
    assert interval.high <= math.exp(once.log_mu.max()) * (1 + 1e-9)


def test_the_default_scenario_is_told_to_extrapolate():
    result = run_experiment(
        ExperimentConfig(method="naive", final_rollouts=50, measured_memory=False)
    )
    text = " ".join(result.warnings)
    assert "no training obstacle" in text
    assert "132 training obstacles" in text
    assert "2 of 27" in text
    assert result.data_bound is not None
    # by recursion over all reachable states the bounding model gives 6.98e-5
    assert 6.98e-5 < result.data_bound.probability < 2e-3
    assert f"up to {result.data_bound.probability:.1g}" in text


def test_the_reference_stands_beside_the_estimate():
    result = run_experiment(
        ExperimentConfig(method="naive", final_rollouts=50, reference=True, measured_memory=False)
    )
    assert result.reference is not None
    # exact recursion over the reachable states: log mu = -32.3785
    assert math.log(result.reference.probability) == pytest.approx(-32.3785, abs=0.002)
    assert "trust the reference" in result.warnings[-1]
    assert run_diagnostics(result)[-1].text == result.warnings[-1]


def test_a_model_without_counts_is_said_to_have_none(scored):
    warnings = extrapolation_warnings(
        scored, simulator=SalientMissCounter(states=7), pem=ConstantPem(0.1)
    )
    assert len(warnings) == 1
    assert "no counts" in warnings[0]


def test_a_memory_of_slow_tracks_is_said_not_to_reach_as_far(tmp_path):
    """RRC's memory as if of tracks that hardly come closer; without one there is nothing to say."""
    pem = load_pem("rrc")
    memory = {**pem.card.memory, "closing_mps": 0.5}
    path = tmp_path / "slow.safetensors"
    save_pem(replace(pem, card=replace(pem.card, memory=memory)), path)
    asked = ExperimentConfig(
        pem=str(path), method="monte-carlo", final_rollouts=2_000, measured_memory=False
    )
    told = [words for words in run_experiment(asked).warnings if "of the memory" in words]
    assert len(told) == 1
    assert "close at under 0.5 m/s" in told[0]
    alone = run_experiment(replace(asked, memory_s=0.0, frailty=0.0))
    assert not any("of the memory" in words for words in alone.warnings)
