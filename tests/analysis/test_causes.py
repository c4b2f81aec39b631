"""Causes and sensitivities against exact recursions; which rollouts carry an estimate."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from pemviz.analysis.causes import (
    carrying,
    contributions,
    failures_of,
    likeliest_chains,
    miss_probability_by_step,
    misses_by_distance,
)
from pemviz.analysis.explanation import explain
from pemviz.analysis.sensitivity import band_sensitivities
from pemviz.config import ExperimentConfig
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.runs.engine import run_experiment
from pemviz.runs.result_file import result_document
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.problem import sample
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_enumeration,
    toy_probability_by_recursion,
    toy_problem_of,
)
from tests.toy import exact_failure_probability

SIMULATOR, PEM = ToySimulator(initial_gap=4, states=13), ToyPem(at_zero=3.0, slope=0.2)
EDGES = (1.0, 3.0, 5.0, 9.0)


@dataclass(frozen=True)
class Improved:
    """The toy's error model with misses in a band ``factor`` times as likely."""

    factor: float
    low: float
    high: float

    def logit(self, salient):
        gap = salient[..., 0]
        miss = expit(-PEM.logit(salient))
        inside = (gap >= self.low) & (gap < self.high)
        return -logit(np.where(inside, self.factor * miss, miss))


@pytest.fixture(scope="module")
def failures():
    problem = toy_problem_of(SIMULATOR, PEM)
    method = ZeroVarianceSampling(twin=SIMULATOR, rollouts=20_000, seed=8)
    _, stage = method.step(problem, method.init(problem, repetition=0))
    found = failures_of(stage.scored)
    assert found is not None
    return found


TRUTH = toy_probability_by_recursion(SIMULATOR, PEM)


def test_elasticity_is_the_derivative_of_the_exact_answer(failures):
    """Five standard errors, which 20,000 failures make about 1 %; the seed is fixed."""
    rows = band_sensitivities(failures, log_probability=math.log(TRUTH), edges=EDGES)
    for row, (low, high) in zip(rows[1:], itertools.pairwise(EDGES), strict=True):
        step = 1e-4
        changed = toy_probability_by_recursion(SIMULATOR, Improved(1.0 - step, low, high))
        expected = (math.log(TRUTH) - math.log(changed)) / -math.log(1.0 - step)
        assert abs(row.elasticity - expected) < 5.0 * row.std_error + 1e-9
        assert row.std_error < 0.01 * max(expected, 1.0)
    assert rows[0].elasticity == pytest.approx(sum(row.elasticity for row in rows[1:]), rel=1e-9)


def test_a_detection_that_the_model_holds_impossible_leaves_no_elasticity(failures):
    """One failure detects where a miss is certain: its likelihood is 0, and stays so for less."""
    rollouts = failures.rollouts
    place = np.argwhere(rollouts.detected & failures.deciding)[0]
    certain = rollouts.pem_logit.copy()
    certain[*place] = -1000.0
    changed = replace(failures, rollouts=replace(rollouts, pem_logit=certain))
    rows = band_sensitivities(changed, log_probability=math.log(TRUTH), edges=EDGES, target=1e-30)
    gap = rollouts.signals["gap"][*place]
    for row in rows:
        inside = row.low is None or row.low <= gap < row.high
        assert (row.elasticity is None) == inside
        assert row.target_factor is None or not inside


@pytest.mark.parametrize("share", [0.3, 0.03])
def test_factors_meet_the_target_exactly(failures, share):
    target = share * TRUTH
    rows = band_sensitivities(failures, log_probability=math.log(TRUTH), edges=EDGES, target=target)
    whole = toy_probability_by_recursion(SIMULATOR, Improved(rows[0].target_factor, 0.0, 99.0))
    assert whole == pytest.approx(target, rel=0.1)
    for row in rows[1:3]:
        assert row.target_factor is not None
        pem = Improved(row.target_factor, row.low, row.high)
        assert toy_probability_by_recursion(SIMULATOR, pem) == pytest.approx(target, rel=0.1)


def test_a_target_that_is_met_needs_nothing(failures):
    rows = band_sensitivities(failures, log_probability=math.log(TRUTH), edges=EDGES, target=0.5)
    assert all(row.target_factor == 1.0 for row in rows)


def test_a_band_that_is_never_missed_in_cannot_help(failures):
    rows = band_sensitivities(
        failures, log_probability=math.log(TRUTH), edges=(20.0, 30.0), target=TRUTH / 2
    )
    assert rows[1].target_factor is None
    assert rows[1].warning is not None


def test_shares_add_up(failures):
    bands = misses_by_distance(failures, edges=EDGES)
    assert sum(band.share for band in bands) == pytest.approx(1.0)
    by_step = miss_probability_by_step(failures)
    assert by_step.sum() == pytest.approx(sum(band.misses for band in bands))
    # from gap 4 the walk needs four misses more than detections
    assert by_step.sum() >= 4.0


def test_likeliest_chain_is_four_misses_at_once(failures):
    chains = likeliest_chains(failures)
    assert chains[0].missed_steps == (0, 1, 2, 3)
    gaps = np.array([4.0, 3.0, 2.0, 1.0])
    likelihood = np.prod(expit(-PEM.logit(gaps[:, None])))
    assert chains[0].nll == pytest.approx(-np.log(likelihood), rel=1e-9)
    assert chains[0].share == pytest.approx(likelihood / TRUTH, rel=0.05)
    assert pytest.approx(toy_probability_by_enumeration(SIMULATOR, PEM), rel=1e-9) == TRUTH


def test_no_failures_no_causes(failures):
    problem = toy_problem_of(SIMULATOR, PEM, unsafe=None)
    scored = sample(problem, proposal=PemProposal(), count=3, seeds=np.random.SeedSequence(1))
    assert failures_of(scored) is None


weights = st.lists(st.floats(min_value=-80, max_value=0), min_size=1, max_size=40).map(np.array)


@given(log_weight=weights, data=st.data())
def test_shares_are_those_of_plain_sums(log_weight, data):
    violated = np.array(data.draw(st.lists(st.booleans(), min_size=log_weight.size,
                                           max_size=log_weight.size)))  # fmt: skip
    plain = np.where(violated, np.exp(log_weight), 0.0)
    expected = plain / plain.sum() if violated.any() else plain
    np.testing.assert_allclose(contributions(log_weight, violated=violated), expected, rtol=1e-12)


def test_shares_far_below_what_numbers_can_hold():
    share = contributions(np.array([-2000.0, -2000.0 + np.log(3.0)]), violated=np.full(2, True))
    np.testing.assert_allclose(share, [0.25, 0.75], rtol=1e-12)


@given(log_weight=weights, part=st.floats(min_value=0.1, max_value=0.999))
def test_the_fewest_that_make_up_the_part_and_what_ties_with_them(log_weight, part):
    share = contributions(log_weight, violated=np.full(log_weight.size, True))
    chosen = carrying(share, part=part)
    assert share[chosen].sum() >= part * (1.0 - 1e-12)
    least = share[chosen].min()
    assert (share[~chosen] < least).all()
    assert share[chosen & (share > least)].sum() < part


def test_equal_shares_all_carry():
    assert carrying(np.full(7, 1 / 7)).all()


def test_nothing_carries_where_nothing_fails():
    assert not carrying(contributions(np.zeros(3), violated=np.full(3, False))).any()


def test_a_pile_up_of_misses_does_not_carry():
    share = contributions(np.array([-46.0, 0.0, 0.0]), violated=np.full(3, True))
    assert carrying(share).tolist() == [False, True, True]
    assert share[0] == pytest.approx(np.exp(-46.0) / 2, rel=1e-9)


def test_elasticity_is_the_derivative_of_the_binomial_tail(toy_problem):
    """Its Monte Carlo error at 50,000 rollouts is below 1 %; 3 % is allowed, the seed is fixed."""
    method = DirectSampling(name="naive", proposal=ConstantProposal(0.5), rollouts=50_000, seed=0)
    _, stage = method.step(toy_problem, method.init(toy_problem, repetition=0))
    features = SignalFeatures(toy_problem.simulator.signals)
    target = exact_failure_probability(steps=6, miss_probability=0.05)
    found = explain(stage, features=features, farthest_m=4.0, target=target, dt_s=0.05)
    assert found is not None
    step = 1e-5
    higher = exact_failure_probability(steps=6, miss_probability=0.1 * np.exp(step))
    lower = exact_failure_probability(steps=6, miss_probability=0.1 * np.exp(-step))
    slope = (np.log(higher) - np.log(lower)) / (2 * step)
    everywhere = found.sensitivity[0]
    assert everywhere.elasticity == pytest.approx(slope, rel=0.03)
    assert everywhere.target_factor == pytest.approx(0.5, rel=0.03)


def test_a_run_explains_itself():
    config = ExperimentConfig(
        method="naive", final_rollouts=200, target=1e-60, measured_memory=False
    )
    result = run_experiment(config)
    assert result.explanation is not None
    document = result_document(result)
    assert len(document["sensitivity"]) == 1 + 8
    assert document["causes"]["misses_by_distance"][0]["low"] == 0.0
    assert len(document["causes"]["miss_probability_by_step"]) == 99
    shares = [chain["share"] for chain in document["causes"]["chains"]]
    assert shares == sorted(shares, reverse=True)
    assert 0.0 < sum(shares) <= 1.0 + 1e-9


def test_nothing_is_explained_where_nothing_failed():
    result = run_experiment(
        ExperimentConfig(method="monte-carlo", final_rollouts=50, measured_memory=False)
    )
    assert result.explanation is None
    assert result_document(result)["sensitivity"] is None
