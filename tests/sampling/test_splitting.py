"""Multilevel splitting against exactly known probabilities."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from pemviz.sampling.problem import Problem
from pemviz.sampling.splitting.method import SplittingSampling, split
from pemviz.sampling.splitting.particles import draw_particles, restarted
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_robustness,
    toy_violated,
)


def problem_of(simulator, pem):
    return Problem(
        simulator=simulator,
        pem=pem,
        robustness=toy_robustness,
        violated=toy_violated,
    )


def test_runs_are_unbiased():
    """Mean of 150 runs at 6e-6: t-test at level 1e-4; the seed is fixed."""
    simulator, pem = ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.5)
    truth = toy_probability_by_recursion(simulator, pem)
    assert truth < 1e-4
    generator = np.random.default_rng(3)
    problem = problem_of(simulator, pem)
    logs = [split(problem, count=60, generator=generator).log_probability for _ in range(150)]
    assert stats.ttest_1samp(np.exp(logs) / truth, 1.0).pvalue > 1e-4


def test_estimate_is_near_the_truth_and_says_how_near():
    simulator, pem = ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.5)
    truth = toy_probability_by_recursion(simulator, pem)
    method = SplittingSampling(stages=10, rollouts=150, seed=4)
    problem = problem_of(simulator, pem)
    state = method.init(problem, repetition=0)
    while not method.is_done(state):
        state, stage = method.step(problem, state)
        assert stage.log10_probability is not None
    found = method.estimate(state)
    assert found.ci_low < truth < found.ci_high
    assert found.probability == pytest.approx(truth, rel=0.5)
    assert found.rollouts_simulated > found.rollouts_in_estimate == 1500


def test_restarted_particles_share_the_past():
    problem = problem_of(ToySimulator(), ToyPem(at_zero=0.0, slope=0.0))
    generator = np.random.default_rng(5)
    first = draw_particles(problem, count=40, generator=generator)
    cut = np.full(40, 6)
    again = restarted(problem, first, cut=cut, generator=generator)
    np.testing.assert_array_equal(again.rollouts.detected[:, :6], first.rollouts.detected[:, :6])
    assert (again.rollouts.detected[:, 6:] != first.rollouts.detected[:, 6:]).any()
    gap = again.rollouts.signals["gap"]
    moved = np.minimum(gap[:, :-1] + np.where(again.rollouts.detected, 1.0, -1.0), 8.0)
    np.testing.assert_array_equal(gap[:, 1:], moved)


def test_last_score_is_the_robustness():
    problem = problem_of(ToySimulator(), ToyPem())
    particles = draw_particles(problem, count=50, generator=np.random.default_rng(6))
    robustness = problem.robustness(particles.rollouts.signals)
    np.testing.assert_allclose(particles.lowest, robustness)


def test_a_violation_out_of_reach_is_no_bare_zero():
    problem = problem_of(ToySimulator(initial_gap=8, states=5), ToyPem())
    method = SplittingSampling(stages=2, rollouts=20, seed=7)
    state = method.init(problem, repetition=0)
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    found = method.estimate(state)
    assert found.probability == 0.0
    assert found.ci_high is None
    assert found.warnings


def test_progress_follows_the_levels_down_and_never_exceeds_the_whole():
    """About twelve cuts at 2e-7: every one moves it, long before anything violates."""
    heard = []
    problem = replace(
        problem_of(ToySimulator(initial_gap=6, states=14), ToyPem(at_zero=2.5)),
        progress=lambda done, total: heard.append((done, total)),
    )
    found = split(problem, count=60, generator=np.random.default_rng(8))
    done = [part for part, _ in heard]
    assert all(total == 60 for _, total in heard)
    assert done == sorted(done)
    assert done[0] == 0
    assert done[-1] == 60
    assert len(set(done)) >= 4
    assert len(heard) == found.levels + 2
