"""Multilevel splitting against exactly known probabilities."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from pemviz.arrays import row_sums
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError
from pemviz.faults import SimulationError
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.splitting.importance import MOST_EVALUATIONS, OUT_OF_REACH, importance
from pemviz.sampling.splitting.particles import beginning, continued, restart
from pemviz.sampling.splitting.run import split
from pemviz.sampling.state.composed import with_component
from pemviz.sampling.state.violated import Monitored, Violated
from pemviz.stl import FormulaMonitor, parse
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_problem_of,
    toy_unsafe,
)
from tests.toy import ConstantPem, MissCounter, carried_out, splitting_runs


def sampled(problem, *, count, generator):
    (particles,) = continued(problem, [beginning(problem, count=count, generator=generator)])
    return particles


def test_runs_are_unbiased():
    """Mean of 150 runs at 6e-6: t-test at level 1e-4; the seed is fixed."""
    simulator, pem = ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.5)
    truth = toy_probability_by_recursion(simulator, pem)
    assert truth < 1e-4
    problem = toy_problem_of(simulator, pem)
    runs = split(problem, count=60, generators=np.random.default_rng(3).spawn(150))
    logs = [run.log_probability for run in runs]
    assert stats.ttest_1samp(np.exp(logs) / truth, 1.0).pvalue > 1e-4


def test_runs_are_unbiased_where_the_importance_function_misleads():
    """Only a miss at the very first step, then none, violates: every look at it comes too late.

    P = 0.2 * 0.8^5 = 0.0655; mean of 200 runs, t-test at level 1e-4; the seed is fixed.
    """
    problem = Problem(
        simulator=MissCounter(states=7),
        pem=ConstantPem(0.2),
        robustness=lambda signals: np.abs(signals["gap"][:, 1:] - 2.5).max(axis=1) - 0.5,
        violated=lambda signals: np.abs(signals["gap"][:, 1:] - 2.5).max(axis=1) < 0.5,
    )
    runs = split(problem, count=40, generators=np.random.default_rng(4).spawn(200))
    logs = [run.log_probability for run in runs]
    assert stats.ttest_1samp(np.exp(logs), 0.2 * 0.8**5).pvalue > 1e-4


def test_runs_that_keep_step_are_what_each_is_alone():
    """In batches of 40 rollouts runs of 30 go one by one, in batches of 90 by threes."""
    problem = toy_problem_of(ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.0))
    method = splitting_runs(stages=5, rollouts=30, seed=2)
    alone, *together = (
        carried_out(method, replace(problem, batch_rollouts=size)) for size in (40, 90, 4096)
    )
    for found, stages in together:
        assert found == alone[0]
        for stage, other in zip(stages, alone[1], strict=True):
            assert stage.log10_probability == other.log10_probability
            for name in ("detected", "pem_logit"):
                np.testing.assert_array_equal(
                    getattr(stage.scored.rollouts, name), getattr(other.scored.rollouts, name)
                )


def test_estimate_is_near_the_truth_and_says_how_near():
    simulator, pem = ToySimulator(initial_gap=5, states=12), ToyPem(at_zero=2.5)
    truth = toy_probability_by_recursion(simulator, pem)
    found, stages = carried_out(
        splitting_runs(stages=10, rollouts=150, seed=4), toy_problem_of(simulator, pem)
    )
    assert all(stage.log10_probability is not None for stage in stages)
    assert found.ci_low < truth < found.ci_high
    assert found.ci_low < found.probability < found.ci_high
    assert found.probability == pytest.approx(truth, rel=0.5)
    assert found.rollouts_simulated > found.rollouts_in_estimate == 1500


def test_restarted_particles_share_the_past():
    problem = toy_problem_of(ToySimulator(), ToyPem(at_zero=0.0, slope=0.0))
    generator = np.random.default_rng(5)
    first = sampled(problem, count=40, generator=generator)
    parent, cut = np.arange(40)[::-1], np.tile([9, 6], 20)
    (again,) = continued(problem, [restart(first, parent=parent, cut=cut, generator=generator)])
    order = np.argsort(cut, kind="stable")
    np.testing.assert_array_equal(again.ancestor, parent[order])
    for row, (own, last) in enumerate(zip(parent[order], cut[order], strict=True)):
        np.testing.assert_array_equal(
            again.rollouts.detected[row, :last], first.rollouts.detected[own, :last]
        )
        np.testing.assert_array_equal(again.score[row, : last + 1], first.score[own, : last + 1])
    assert (again.rollouts.detected[:, 9:] != first.rollouts.detected[parent[order], 9:]).any()
    gap = again.rollouts.signals["gap"]
    moved = np.minimum(gap[:, :-1] + np.where(again.rollouts.detected, 1.0, -1.0), 8.0)
    np.testing.assert_array_equal(gap[:, 1:], moved)


@pytest.fixture(scope="module")
def braking():
    return build_experiment(ExperimentConfig(method="splitting")).problem


def test_continuing_from_kept_states_is_replaying(braking):
    """After dozens of cuts every rollout is what its outcomes lead to from the start."""
    (run,) = split(braking, count=40, generators=[np.random.default_rng(1)])
    assert run.levels > 10
    rollouts = run.scored.rollouts
    again = replay(simulator=braking.simulator, detected=rollouts.detected)
    for name, values in again.items():
        np.testing.assert_array_equal(rollouts.signals[name], values)
    salient = braking.simulator.salient({n: v[:, :-1] for n, v in rollouts.signals.items()})
    np.testing.assert_array_equal(rollouts.pem_logit, braking.pem.logit(salient))
    assert not row_sums(rollouts.log_p - rollouts.log_q).any()


def test_looks_are_where_an_unlikely_outcome_changed_something(braking):
    """Beyond 10 m the ego takes no notice of what it detects."""
    particles = sampled(braking, count=300, generator=np.random.default_rng(2))
    fresh = np.diff(particles.evaluations, axis=1) > 0
    near = particles.rollouts.signals["gap"][:, :-1] < ExperimentConfig().scenario.emergency_gap_m
    np.testing.assert_array_equal(fresh[:, :-1], (near & ~particles.rollouts.detected)[:, :-1])
    assert not fresh[:, -1].any()  # the last state needs none
    assert 0 < fresh.sum() < (~particles.rollouts.detected).sum()


@dataclass
class CountedSteps:
    """A miss counter that counts the rows it steps."""

    states: int
    rows: int = 0

    def __getattr__(self, name):
        return getattr(MissCounter(states=self.states), name)

    def step(self, states, detected):
        self.rows += detected.size
        return MissCounter(states=self.states).step(states, detected)


@pytest.mark.parametrize("states", [50, 400])
def test_cost_is_linear_in_the_length_of_a_rollout(states):
    """Where half of all outcomes are misses that matter, looks ahead are what is rationed."""
    simulator = CountedSteps(states=states)
    problem = Problem(
        simulator=simulator,
        pem=ConstantPem(0.5),
        robustness=lambda signals: signals["gap"].min(axis=1) + 0.7 * states,
        violated=lambda signals: signals["gap"].min(axis=1) < -0.7 * states,
    )
    count, each = 20, 2 + math.ceil(math.log2(states))  # two extremes and a bisection
    particles = sampled(problem, count=count, generator=np.random.default_rng(0))
    assert particles.evaluations.max() <= MOST_EVALUATIONS
    assert simulator.rows <= (2 + each * MOST_EVALUATIONS) * states * count
    before = simulator.rows
    cut = np.full(count, states // 2)
    generator = np.random.default_rng(1)
    wanted = restart(particles, parent=np.arange(count), cut=cut, generator=generator)
    continued(problem, [wanted])
    assert simulator.rows - before <= (2 + each * MOST_EVALUATIONS) * (states - states // 2) * count


def counted(miss_probability, states=20):
    """The robustness is 3 m less a metre a miss: the fourth violates."""
    return Problem(
        simulator=MissCounter(states=states),
        pem=ConstantPem(miss_probability),
        robustness=lambda signals: signals["gap"].min(axis=1) - 0.5,
        violated=lambda signals: signals["gap"].min(axis=1) < 0.5,
    )


def test_importance_counts_the_misses_that_are_needed():
    """One, two or three more misses of probability q: minus as many times log q."""
    problem, q = counted(0.07), 0.07
    particles = sampled(problem, count=100, generator=np.random.default_rng(6))
    row, step = np.repeat(np.arange(100), 12), np.tile(np.arange(12), 100)
    needed = 3 - np.cumsum(~particles.rollouts.detected, axis=1)[row, step - 1] * (step > 0)
    found = importance(problem, particles.rollouts, row=row, step=step)
    between = needed >= 0
    np.testing.assert_allclose(found[between], -needed[between] * np.log(q), rtol=1e-9)
    assert (found[needed < 0] < 0.0).all()
    assert set(needed[between]) == {0, 1, 2, 3}


def test_importance_where_the_first_misses_cost_nothing():
    """k misses on end lower the gap by k^2 cm, and no gap so far counts that is above 5 m.

    The next k misses end at 9 m less k^2 cm. Between the last k above the threshold of 3 m, 24,
    and the first below it, 25, the robustness 0.24 m and -0.25 m is taken to be linear.
    """

    @dataclass(frozen=True)
    class Slipping(MissCounter):
        def initial(self, *, count):
            start = super().initial(count=count)
            return replace(
                start,
                signals={"gap": np.full(count, 9.0)},
                memory={"k": start.step + np.zeros(count)},
            )

        def step(self, states, detected):
            k = np.where(detected, 0.0, states.memory["k"] + 1.0)
            gap = states.signals["gap"] - np.where(detected, 0.0, (2.0 * k - 1.0) / 100.0)
            return replace(states, step=states.step + 1, signals={"gap": gap}, memory={"k": k})

    problem = replace(
        counted(0.3),
        simulator=Slipping(states=60),
        robustness=lambda signals: np.minimum(signals["gap"].min(axis=1), 5.0) - 3.0,
        violated=None,
    )
    rollouts = sampled(problem, count=5, generator=np.random.default_rng(1)).rollouts
    (found,) = importance(problem, rollouts, row=np.array([0]), step=np.array([0]))
    needed = 24.0 + 0.24 / (0.24 + 0.25)
    assert found == pytest.approx(-needed * np.log(0.3), rel=1e-9)


def test_importance_knows_what_is_out_of_reach_and_what_has_happened():
    problem = counted(0.5, states=6)
    particles = sampled(problem, count=200, generator=np.random.default_rng(7))
    misses = (~particles.rollouts.detected).sum(axis=1)
    robustness = problem.robustness(particles.rollouts.signals)
    np.testing.assert_array_equal(particles.lowest < 0.0, misses >= 4)
    np.testing.assert_array_equal(robustness[misses >= 4], particles.lowest[misses >= 4])
    assert {0, 4, 5} <= set(misses)
    late = importance(problem, particles.rollouts, row=np.arange(200), step=np.full(200, 4))
    np.testing.assert_array_equal(
        late >= OUT_OF_REACH, (~particles.rollouts.detected[:, :4]).sum(axis=1) < 3
    )


def test_either_outcome_may_be_the_bad_one():
    """With outcomes and their probabilities exchanged nothing else changes."""
    problem = counted(0.07)

    class Mirrored(MissCounter):
        def step(self, states, detected):
            return super().step(states, ~detected)

    mirrored = replace(problem, simulator=Mirrored(states=20), pem=ConstantPem(0.93))
    one, other = (
        split(p, count=50, generators=[np.random.default_rng(8)])[0] for p in (problem, mirrored)
    )
    assert one.levels == other.levels == 3  # one a miss
    truth = stats.binom.sf(3, 19, 0.07)
    for run in (one, other):
        assert abs(run.log_probability - np.log(truth)) < 1.5
    rollouts = sampled(problem, count=30, generator=np.random.default_rng(9)).rollouts
    row, step = np.arange(30), np.full(30, 5)
    turned = replace(rollouts, detected=~rollouts.detected, pem_logit=-rollouts.pem_logit)
    np.testing.assert_allclose(
        importance(problem, rollouts, row=row, step=step),
        importance(mirrored, turned, row=row, step=step),
        rtol=1e-12,
    )


def test_a_violation_out_of_reach_is_no_bare_zero():
    problem = toy_problem_of(ToySimulator(initial_gap=8, states=5), ToyPem())
    found, _ = carried_out(splitting_runs(stages=2, rollouts=20, seed=7), problem)
    assert found.probability == 0.0
    assert found.ci_high is None
    assert found.warnings


@pytest.mark.parametrize("kind", ["absorbing", "monitored"])
def test_states_that_cannot_be_kept_are_refused(kind):
    """An absorbing violation stands in the memory; what a monitor knows does not."""
    problem = toy_problem_of(ToySimulator(), ToyPem(at_zero=0.0))
    formula = parse("always[0,14] (gap > 0)", signals=["gap"])
    remembers = {
        "absorbing": Violated(toy_unsafe),
        "monitored": Monitored(FormulaMonitor(formula)),
    }
    problem = replace(problem, simulator=with_component(problem.simulator, remembers[kind]))
    if kind == "monitored":
        with pytest.raises(ConfigError, match="its states carry what a monitor knows beside"):
            split(problem, count=10, generators=[np.random.default_rng(0)])
    else:
        (run,) = split(problem, count=10, generators=[np.random.default_rng(0)])
        late = run.scored.rollouts.memory["violated"][:, -1]
        np.testing.assert_array_equal(late, run.scored.violated)


def test_what_is_no_number_is_told_with_its_step():
    @dataclass(frozen=True)
    class Broken(ToySimulator):
        def step(self, states, detected):
            after = super().step(states, detected)
            gap = np.where(int(after.step) == 7, np.nan, after.signals["gap"])
            return replace(after, signals={"gap": gap})

    with pytest.raises(SimulationError, match="gap is nan in rollout 0, step 7"):
        split(toy_problem_of(Broken(), ToyPem()), count=5, generators=[np.random.default_rng(0)])


def test_progress_follows_the_levels_down_and_never_exceeds_the_whole():
    """About twelve cuts at 2e-7: every one moves it, long before anything violates."""
    heard = []
    problem = replace(
        toy_problem_of(ToySimulator(initial_gap=6, states=14), ToyPem(at_zero=2.5)),
        progress=lambda done, total: heard.append((done, total)),
    )
    (found,) = split(problem, count=60, generators=[np.random.default_rng(8)])
    done = [part for part, _ in heard]
    assert all(total == 60 for _, total in heard)
    assert done == sorted(done)
    assert done[0] == 0
    assert done[-1] == 60
    assert len(set(done)) >= 4
    assert len(heard) == found.levels + 2
