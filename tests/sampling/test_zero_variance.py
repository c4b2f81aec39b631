"""The value function and its proposal against exactly known probabilities."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pemviz import stl
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import InputError
from pemviz.proposals.defensive import defended
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.proposal import build_zero_variance_proposal
from pemviz.sampling.zero_variance.reachable_states import explore
from pemviz.sampling.zero_variance.unsafe_states import UnsafeStates, unsafe_states
from pemviz.sampling.zero_variance.values import solve
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import StateBatch, outcome_log_likelihood
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
    toy_problem_of,
    toy_unsafe,
)
from tests.toy import FunctionPem


def value_of(simulator, pem, *, largest_layer=1000):
    graph = explore(twin=simulator, pem=pem, unsafe=toy_unsafe, largest_layer=largest_layer)
    return graph, solve(graph)


def run(method, problem, *, repetition=0):
    state = method.init(problem, repetition=repetition)
    state, stage = method.step(problem, state)
    assert method.is_done(state)
    return method.estimate(state), stage


@given(
    initial=st.integers(1, 6),
    more=st.integers(0, 4),
    states=st.integers(2, 40),
    at_zero=st.floats(-3.0, 30.0),
    slope=st.floats(-0.5, 0.5),
)
def test_value_is_exact_on_the_toy(initial, more, states, at_zero, slope):
    simulator = ToySimulator(initial_gap=initial, largest_gap=initial + more, states=states)
    pem = ToyPem(at_zero=at_zero, slope=slope)
    graph, values = value_of(simulator, pem)
    expected = toy_probability_by_recursion(simulator, pem)
    assert np.exp(values.log_probability) == pytest.approx(expected, rel=1e-9, abs=0.0)
    assert graph.exact


@given(initial=st.integers(1, 5), states=st.integers(6, 20), at_zero=st.floats(0.0, 6.0))
def test_without_defence_every_violation_weighs_the_same(initial, states, at_zero):
    simulator, pem = ToySimulator(initial_gap=initial, states=states), ToyPem(at_zero=at_zero)
    method = ZeroVarianceSampling(twin=simulator, rollouts=50, seed=1, defensive_steps=1e-11)
    found, stage = run(method, toy_problem_of(simulator, pem))
    expected = toy_probability_by_recursion(simulator, pem)
    assert stage.scored.violated.all()
    np.testing.assert_allclose(stage.scored.rollouts.log_weight, np.log(expected), rtol=1e-8)
    assert found.probability == pytest.approx(expected, rel=1e-8)


BRAKING = replace(ScenarioConfig(), states=50)


def braking_problem(config, *, at_least_m=6.5):
    """A short braking scenario with an error model that misses one time in fifty or so."""

    def unsafe(states):
        return states.signals["gap"] < at_least_m

    simulator = VectorizedSimulator(config)
    return Problem(
        simulator=simulator,
        pem=FunctionPem(lambda salient: 5.0 - 0.1 * salient[..., 9]),
        robustness=lambda signals: np.min(signals["gap"], axis=1) - at_least_m,
        violated=lambda signals: np.min(signals["gap"], axis=1) < at_least_m,
        unsafe=unsafe,
    )


def exact_value(problem):
    graph = explore(twin=problem.simulator, pem=problem.pem, unsafe=problem.unsafe)
    assert graph.exact
    return np.exp(solve(graph).log_probability)


def test_the_recursion_agrees_with_all_chains_of_outcomes():
    """The last 11 steps decide; all 2^11 chains of them are replayed and summed."""
    problem = braking_problem(BRAKING, at_least_m=6.8)
    chains = np.array(list(itertools.product((False, True), repeat=11)))
    first = np.ones((chains.shape[0], 38), dtype=bool)  # above 10 m a detection changes nothing
    detected = np.concatenate([first, chains], axis=1)
    signals = replay(simulator=problem.simulator, detected=detected)
    assert (signals["gap"][:, 37] > 10.0).all()
    logit = problem.pem.logit(problem.simulator.salient(signals))[:, 38:49]
    likelihood = np.exp(outcome_log_likelihood(logit, chains).sum(axis=1))
    expected = likelihood[problem.violated(signals)].sum()
    assert 0.0 < expected < 0.1
    assert exact_value(problem) == pytest.approx(expected, rel=1e-9)


def test_unbiased_where_states_are_merged():
    """z-test at 4 standard errors: false alarm 6e-5; the seed is fixed."""
    problem = braking_problem(BRAKING)
    method = ZeroVarianceSampling(
        twin=problem.simulator, rollouts=20_000, seed=2, largest_layer=600
    )
    found, _ = run(method, problem)
    truth = exact_value(problem)
    assert found.std_error is not None
    assert abs(found.probability - truth) < 4 * found.std_error
    assert 1e-6 * truth < found.std_error < 0.1 * truth


def test_unbiased_with_a_wrong_twin():
    """The twin brakes 5 % harder than the simulator. z-test at 4 standard errors."""
    problem = braking_problem(replace(BRAKING, emergency_deceleration_mps2=7.6))
    method = ZeroVarianceSampling(twin=VectorizedSimulator(BRAKING), rollouts=20_000, seed=4)
    found, _ = run(method, problem)
    truth = exact_value(problem)
    assert truth > 1.1 * exact_value(braking_problem(BRAKING))
    assert found.std_error is not None
    assert abs(found.probability - truth) < 4 * found.std_error
    assert found.std_error < 0.1 * truth


def test_coverage_on_the_toy():
    """200 runs; covering 90 % or more at a true 95 %: false alarm below 0.2 % (binomial)."""
    simulator, pem = ToySimulator(initial_gap=6, states=25), ToyPem(at_zero=3.0)
    problem = toy_problem_of(simulator, pem)
    truth = toy_probability_by_recursion(simulator, pem)
    method = ZeroVarianceSampling(twin=simulator, rollouts=300, seed=5, defensive_steps=2.4)
    found = [run(method, problem, repetition=index)[0] for index in range(200)]
    assert sum(e.ci_low < truth < e.ci_high for e in found) >= 180


def test_a_thousand_steps_and_ten_thousand_nats():
    """All of 1,000 steps must miss at 10 nats each: p = exp(-10000), no double holds it."""
    simulator = ToySimulator(initial_gap=999, largest_gap=999, states=1000)
    pem = ToyPem(at_zero=10.0, slope=0.0)
    method = ZeroVarianceSampling(twin=simulator, rollouts=200, seed=6)
    found, stage = run(method, toy_problem_of(simulator, pem))
    expected = -999 * np.log1p(np.exp(10.0)) / np.log(10.0)
    assert found.probability == 0.0
    assert found.log10_probability == pytest.approx(expected, rel=1e-4)
    assert np.isfinite(stage.scored.rollouts.log_weight).all()
    assert any("log10" in warning for warning in found.warnings)


def test_paper_with_the_authors_model(authors_checkpoint):
    """6.69e-15 (+-0.2 %) is known independently; 1,200 rollouts stay within 1 %."""
    config = ExperimentConfig(
        method="zero-variance", final_rollouts=1200, pem=str(authors_checkpoint)
    )
    experiment = build_experiment(config)
    found, stage = run(experiment.method, experiment.problem)
    assert np.exp(stage.sampled_from.log_probability) == pytest.approx(6.69e-15, rel=0.002)
    assert found.probability == pytest.approx(6.69e-15, rel=0.01)
    assert found.failures > 1100


def test_states_that_violated_already_are_left_to_the_error_model():
    simulator, pem = ToySimulator(initial_gap=2, states=12), ToyPem()
    method = ZeroVarianceSampling(twin=simulator, rollouts=200, seed=7)
    _, stage = run(method, toy_problem_of(simulator, pem))
    rollouts = stage.scored.rollouts
    gone = np.minimum.accumulate(rollouts.signals["gap"][:, :-1], axis=1) <= 0
    assert gone.any()
    np.testing.assert_array_equal(rollouts.proposal_logit[gone], rollouts.pem_logit[gone])


def test_states_unknown_to_the_tables_take_the_error_model():
    simulator, pem = ToySimulator(), ToyPem()
    proposal = build_zero_variance_proposal(twin=simulator, pem=pem, unsafe=toy_unsafe)
    logit = np.array([1.5, -2.0])
    far = StateBatch(step=np.array(3), signals={"gap": np.array([1e6, -40.0])})
    np.testing.assert_array_equal(proposal.logit(far, logit), logit)
    late = StateBatch(step=np.array(99), signals={"gap": np.array([3.0, 2.0])})
    np.testing.assert_array_equal(proposal.logit(late, logit), logit)


@given(
    logit=st.floats(-800.0, 800.0),
    pem_logit=st.floats(-800.0, 800.0),
    share=st.floats(1e-6, 0.5),
)
def test_defence_bounds_every_outcome(logit, pem_logit, share):
    result = defended(np.array([logit]), np.array([pem_logit]), share=share)
    for sign in (1.0, -1.0):
        under_pem = -np.logaddexp(0.0, -sign * pem_logit)
        assert -np.logaddexp(0.0, -sign * result[0]) >= np.log(share) + under_pem - 1e-9


def test_which_specifications_single_states_decide():
    def rules(text):
        return unsafe_states(stl.parse(text, signals=["gap", "ego_speed"]))

    nested = rules("always[2,5] (always[1,3] (gap >= 2.0))")
    assert isinstance(nested, UnsafeStates)
    assert [(rule.first, rule.last) for rule in nested.rules] == [(3, 8)]
    both = rules("always[0,9] (gap >= 2.0) and always[3,4] (gap >= 5 or ego_speed <= 1)")
    assert both is not None
    assert len(both.rules) == 2
    assert rules("eventually[0,9] (gap >= 2.0)") is None
    assert rules("always[0,9] (eventually[0,3] (gap >= 2.0))") is None


@given(st.lists(st.floats(0.0, 6.0), min_size=6, max_size=6))
def test_unsafe_states_decide_as_the_formula_does(gaps):
    formula = stl.parse("always[1,4] (gap >= 2.0 or gap <= 1.0)", signals=["gap"])
    unsafe = unsafe_states(formula)
    assert unsafe is not None
    signals = {"gap": np.array([gaps])}
    seen = [
        unsafe(StateBatch(step=np.array(step), signals={"gap": np.array([gap])}))[0]
        for step, gap in enumerate(gaps)
    ]
    assert any(seen) == stl.violated(formula, signals)[0]


def test_a_specification_out_of_reach_is_refused():
    config = ExperimentConfig(method="zero-variance", spec="eventually[0,9] (gap >= 20.0)")
    with pytest.raises(InputError, match="single states"):
        build_experiment(config)


def test_dynamics_of_the_twin_are_those_of_the_simulator():
    """Every tabulated child is the state that the simulator steps to."""
    config = replace(ScenarioConfig(), states=46)
    simulator = VectorizedSimulator(config)

    def unsafe(states):
        return states.signals["gap"] < 8.0

    graph = explore(twin=simulator, pem=FunctionPem(lambda s: np.ones(s.shape[:-1])), unsafe=unsafe)
    for layer, after in itertools.pairwise(graph.layers):
        for hit, node in ((False, layer.after_miss), (True, layer.after_hit)):
            child = simulator.step(layer.states, np.full(layer.count, hit))
            kept = node >= 0
            for name, values in child.signals.items():
                np.testing.assert_allclose(
                    values[kept], after.states.signals[name][node[kept]], atol=3e-6
                )


def test_averages_are_made_when_looked_up_and_once():
    simulator, pem = ToySimulator(initial_gap=3, states=12), ToyPem(at_zero=1.0)
    proposal = build_zero_variance_proposal(twin=simulator, pem=pem, unsafe=toy_unsafe)
    coarse = proposal.tables[2].coarse
    assert len(coarse) == 0 < 1 < len(proposal.coarse_cells)
    assert coarse[1] is coarse[1]
    assert len(coarse) == 1
    with pytest.raises(IndexError):
        coarse[len(proposal.coarse_cells)]
