"""Causes and sensitivities against the toy's exact recursion."""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit, logit

from pemviz.analysis.causes import (
    failures_of,
    likeliest_chains,
    miss_probability_by_step,
    misses_by_distance,
)
from pemviz.analysis.sensitivity import band_sensitivities
from pemviz.proposals.fixed import PemProposal
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_enumeration,
    toy_probability_by_recursion,
    toy_robustness,
    toy_unsafe,
    toy_violated,
)

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
    problem = Problem(
        simulator=SIMULATOR,
        pem=PEM,
        robustness=toy_robustness,
        violated=toy_violated,
        unsafe=toy_unsafe,
    )
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
    problem = Problem(
        simulator=SIMULATOR, pem=PEM, robustness=toy_robustness, violated=toy_violated
    )
    scored = sample(problem, proposal=PemProposal(), count=3, seeds=np.random.SeedSequence(1))
    assert failures_of(scored) is None
