"""States that violate for certain: told of none that need not, and left to the error model."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from pemviz import stl
from pemviz.config import ScenarioConfig
from pemviz.pem import load_pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.reachable_states import explore
from pemviz.sampling.zero_variance.unsafe_states import certain_violation, unsafe_states
from pemviz.sampling.zero_variance.values import solve
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import StateBatch, outcome_log_likelihood
from tests.sampling.test_memory import with_memory

PEM = load_pem("ml-nn")
STEPS = 13
CONFIG = ScenarioConfig(initial_speed_kmh=50.0, initial_gap_m=5.0, dt_s=0.1, states=STEPS + 1)
TWIN = VectorizedSimulator(CONFIG)
CHAINS = np.array(list(itertools.product((False, True), repeat=STEPS)))
SIGNALS = ("gap", "ego_speed", "lead_speed")


def rule_of(spec):
    return unsafe_states(stl.parse(spec, signals=SIGNALS))


def state_of(signals, step):
    return StateBatch(np.array(step), {name: values[:, step] for name, values in signals.items()})


@pytest.mark.parametrize(
    ("spec", "some"),
    [
        ("always[0,13] (gap >= 4.0)", True),
        ("always[0,9] (gap >= 4.3)", True),
        ("always[0,4] (gap >= 4.9) and always[2,13] (gap >= 4.0)", True),
        ("always[11,13] (gap >= 4.0)", True),
        ("always[8,8] (gap >= 4.3)", True),
        ("always[0,13] (gap >= 4.0 and ego_speed <= 20.0)", True),
        ("always[0,13] (gap >= 4.0 or ego_speed >= 20.0)", False),
        ("always[0,13] (gap <= 4.0)", False),
        ("always[0,13] (gap - 0.1 * ego_speed >= 2.6)", False),
    ],
)
def test_every_sequence_of_outcomes_violates_from_there_on(spec, some):
    rule = rule_of(spec)
    certain = certain_violation(TWIN, rule)
    signals = replay(simulator=TWIN, detected=CHAINS)
    broken = np.stack([rule(state_of(signals, step)) for step in range(STEPS + 1)], axis=1)
    told = 0
    for step in range(STEPS + 1):
        later = broken[:, step + 1 :].any(axis=1)
        # chains that share their first outcomes stand beside each other
        every = later.reshape(2**step, -1).all(axis=1) if step < STEPS else np.zeros(1)
        alike = certain(state_of(signals, step))
        assert every.repeat(alike.size // every.size)[alike].all()
        told += int(alike.sum())
    assert (told > 0) is some


def test_the_value_is_the_sum_over_all_sequences_of_outcomes():
    rule = rule_of("always[0,13] (gap >= 4.1)")
    signals = replay(simulator=TWIN, detected=CHAINS)
    logit = PEM.logit(TWIN.salient(signals))[:, :-1]
    likelihood = np.exp(outcome_log_likelihood(logit, CHAINS).sum(axis=1))
    expected = np.log(likelihood[(signals["gap"] < 4.1).any(axis=1)].sum())
    graph = explore(twin=TWIN, pem=PEM, unsafe=rule)
    assert graph.certain is not None
    assert solve(graph).log_probability == pytest.approx(expected, abs=1e-10)


def test_a_start_from_which_all_violates_has_the_value_one():
    weak = {"emergency_deceleration_mps2": 1.0, "maximum_deceleration_mps2": 1.0}
    graph = explore(
        twin=VectorizedSimulator(replace(CONFIG, **weak)),
        pem=PEM,
        unsafe=rule_of("always[0,13] (gap >= 4.5)"),
    )
    assert graph.layers == ()
    assert solve(graph).log_probability == 0.0


@pytest.mark.parametrize("memory", [Memory(), Memory(0.2), Memory(0.2, 0.8)])
def test_they_are_left_to_the_error_model(memory):
    rule = rule_of("always[0,13] (gap >= 4.1)")
    features = SignalFeatures(TWIN.signals)
    back_end, pem = with_memory(BackEnd(TWIN, features, TWIN, 4096), PEM, memory=memory)
    problem = Problem(
        simulator=back_end.simulator,
        pem=pem,
        robustness=lambda signals: np.min(signals["gap"], axis=1) - 4.1,
        violated=lambda signals: np.min(signals["gap"], axis=1) < 4.1,
        unsafe=rule,
    )
    method = ZeroVarianceSampling(twin=back_end.twin, rollouts=400, seed=3)
    _, stage = method.step(problem, method.init(problem, repetition=0))
    rollouts, certain = stage.scored.rollouts, certain_violation(TWIN, rule)
    doomed = np.stack([certain(state_of(rollouts.signals, step)) for step in range(STEPS)], axis=1)
    doomed &= np.minimum.accumulate(rollouts.signals["gap"][:, :-1], axis=1) >= 4.1
    assert doomed.sum() > 500
    np.testing.assert_array_equal(rollouts.proposal_logit[doomed], rollouts.pem_logit[doomed])
    led = ~doomed & (rollouts.signals["gap"][:, :-1] >= 4.1)
    assert (rollouts.proposal_logit[led] < rollouts.pem_logit[led]).mean() > 0.9
    assert stage.scored.violated.mean() > 0.8
