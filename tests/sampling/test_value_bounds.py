"""States that cannot violate any more, or must, are followed no further; no others are left out."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz import stl
from pemviz.config import ScenarioConfig
from pemviz.pem import load_pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.state.composed import ComposedPem, with_last_outcome
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.zero_variance import reachable_states
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from pemviz.sampling.zero_variance.reachable_states import (
    SAFE_NODE,
    UNSAFE_NODE,
    Merger,
    TooManyStates,
    explore,
)
from pemviz.sampling.zero_variance.unsafe_states import certain_violation, unsafe_states
from pemviz.sampling.zero_variance.values import solve
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.latents import begun
from pemviz.simulators.signal_bounds import (
    signal_bounds,
    signals_reached,
    tells_bounds,
    tells_reached,
)
from pemviz.types import StateBatch, outcome_log_likelihood
from tests.sampling.test_memory import with_memory

PEM = load_pem("ml-nn")
SHORT = ScenarioConfig(initial_speed_kmh=40.0, initial_gap_m=6.0, states=24)
NEAR = "always[0,23] (gap >= 4.5)"
SIGNALS = ("gap", "ego_speed", "lead_speed")


@dataclass(frozen=True)
class Silent(VectorizedSimulator):
    """Inherits bounds, which says nothing of its own steps."""


def rule_of(spec):
    return unsafe_states(stl.parse(spec, signals=SIGNALS))


def graph_of(twin, spec=NEAR, pem=PEM, **asked):
    return explore(twin=twin, pem=pem, unsafe=rule_of(spec), **asked)


configs = st.builds(
    ScenarioConfig,
    initial_speed_kmh=st.floats(1.0, 144.0),
    initial_gap_m=st.floats(1.0, 40.0),
    lead_deceleration_mps2=st.sampled_from([0.0, 0.1, 2.943, 8.0, 20.0]),
    lead_brake_time_s=st.sampled_from([0.0, 0.1, 0.5, 1.0, 99.0]),
    emergency_deceleration_mps2=st.floats(0.1, 20.0),
    maximum_acceleration_mps2=st.floats(0.0, 20.0),
    maximum_deceleration_mps2=st.floats(0.0, 20.0),
    speed_gain_per_s=st.floats(0.0, 50.0),
    speed_integral_gain_per_s2=st.floats(0.0, 50.0),
    dt_s=st.sampled_from([0.001, 0.05, 0.3, 1.0]),
    states=st.just(40),
    tracker=st.sampled_from(["none", "2/3"]),
)


@given(config=configs, seed=st.integers(0, 2**32 - 1), miss=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=60)
def test_signals_stay_within_bounds_whatever_is_detected(config, seed, miss):
    rng = np.random.default_rng(seed)
    simulator = with_last_outcome(VectorizedSimulator(config), tau_s=0.2)
    states = [begun(simulator, count=30)]
    for _ in range(simulator.states - 1):
        states.append(simulator.step(states[-1], rng.random(30) >= miss))
    for first in (0, 1, int(rng.integers(2, 39))):
        steps = int(rng.integers(0, 40 - first))
        bounds = signal_bounds(simulator, states[first], steps=steps)
        assert set(bounds) == set(SIGNALS)
        for later in states[first : first + steps + 1]:
            for name, (low, high) in bounds.items():
                assert (later.signals[name] >= low).all()
                assert (later.signals[name] <= high).all()


@given(config=configs, seed=st.integers(0, 2**32 - 1), miss=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=60)
def test_signals_reach_what_is_told_whatever_is_detected(config, seed, miss):
    rng = np.random.default_rng(seed)
    simulator = with_last_outcome(VectorizedSimulator(config), tau_s=0.2)
    states = [begun(simulator, count=30)]
    for _ in range(simulator.states - 1):
        # half of the rollouts as chance has it, the others detect all from some step on
        late = np.arange(30) < min(len(states), 15)
        states.append(simulator.step(states[-1], late | (rng.random(30) >= miss)))
    for first in (0, 1, int(rng.integers(2, 39))):
        steps = int(rng.integers(1, 40 - first))
        later = states[first + 1 : first + steps + 1]
        reached = signals_reached(simulator, states[first], steps=steps)
        assert set(reached) == {"gap"}
        at_most, at_least = reached["gap"]
        assert (np.min([one.signals["gap"] for one in later], axis=0) <= at_most).all()
        assert (np.max([one.signals["gap"] for one in later], axis=0) >= at_least).all()
    assert signals_reached(simulator, states[-1], steps=0) == {}


@pytest.mark.parametrize("lead_brakes_s", [0.0, 0.3, 99.0])
@pytest.mark.parametrize("at", [0, 3, 10])
def test_an_ego_that_brakes_all_the_time_comes_no_nearer_than_told(lead_brakes_s, at):
    config = replace(SHORT, lead_brake_time_s=lead_brakes_s, lead_deceleration_mps2=5.0)
    simulator = VectorizedSimulator(config)
    states = simulator.initial(count=1)
    for _ in range(at):
        states = simulator.step(states, np.full(1, False))
    at_most, _ = signals_reached(simulator, states, steps=23 - at)["gap"]
    gaps = []
    for _ in range(23 - at):
        states = simulator.step(states, np.full(1, True))
        gaps.append(states.signals["gap"])
    assert min(gaps) == pytest.approx(at_most, abs=2e-3)


def test_the_gap_of_an_ego_that_never_brakes_reaches_its_bound():
    config = ScenarioConfig(speed_gain_per_s=1e6)  # full acceleration once below its target
    simulator = VectorizedSimulator(config)
    states = simulator.initial(count=1)
    for hit in [True] * 62 + [False] * 2:
        states = simulator.step(states, np.full(1, hit))
    low, _ = signal_bounds(simulator, states, steps=20)["gap"]
    for _ in range(20):
        states = simulator.step(states, np.full(1, False))
    assert states.signals["gap"] == pytest.approx(low, abs=2e-3)


@pytest.mark.parametrize(
    "spec",
    [
        NEAR,
        "always[0,9] (gap >= 3.0) and always[20,23] (gap >= 5.0)",
        "always[0,23] (gap >= 4.5 or ego_speed <= 3.0)",
        "always[0,23] (not (gap < 4.5))",
        "always[0,23] (gap - 0.1 * ego_speed >= 3.6)",
        "always[0,23] (gap >= 4.5 and ego_speed <= 11.3)",
        "always[0,23] (gap > 4.5)",
        "always[0,23] (gap >= 4.5 and ego_speed > 0)",
        "always[0,23] (gap >= 4.5 and lead_speed > 8)",
    ],
)
@pytest.mark.parametrize("tau_s", [0.0, 0.2])
def test_the_same_states_count_with_and_without_bounds(spec, tau_s):
    told, silent = VectorizedSimulator(SHORT), Silent(SHORT)
    pem = PEM
    if tau_s:
        told, silent = (with_last_outcome(one, tau_s=tau_s) for one in (told, silent))
        pem = ComposedPem(PEM, (LastOutcome(tau_s, SHORT.dt_s),))
    assert tells_bounds(told)
    assert tells_reached(told)
    assert not tells_bounds(silent)
    assert not tells_reached(silent)
    one, other = graph_of(told, spec, pem=pem), graph_of(silent, spec, pem=pem)
    assert one.exact
    assert other.exact
    assert len(one.layers) == len(other.layers) > 10
    doomed = doomed_states(other)
    same = np.zeros(1, dtype=int)  # which of theirs each of mine is
    for step, (mine, theirs) in enumerate(zip(one.layers, other.layers, strict=True)):
        np.testing.assert_allclose(mine.pem_logit, theirs.pem_logit[same], rtol=1e-12)
        assert np.unique(same).size == same.size == mine.count
        assert doomed[step][np.setdiff1d(np.arange(theirs.count), same)].all()
        following = np.full(one.layers[step + 1].count if step + 1 < len(one.layers) else 0, -1)
        after = np.concatenate([doomed[step + 1], [True, False]])
        for my_node, their_node in (
            (mine.after_miss, theirs.after_miss[same]),
            (mine.after_hit, theirs.after_hit[same]),
        ):
            np.testing.assert_array_equal(my_node == SAFE_NODE, their_node == SAFE_NODE)
            assert after[their_node[my_node == UNSAFE_NODE]].all()
            assert (their_node[my_node >= 0] >= 0).all()
            following[my_node[my_node >= 0]] = their_node[my_node >= 0]
        same = following
    expected = pytest.approx(solve(other).log_probability, abs=1e-12)
    assert solve(one).log_probability == expected


def doomed_states(graph):
    """By layer, and after the last, from which states ``[n]`` all sequences of outcomes violate."""
    doomed = [np.empty(0, dtype=bool)]
    for layer in reversed(graph.layers):
        after = np.concatenate([doomed[0], [True, False]])
        doomed.insert(0, after[layer.after_miss] & after[layer.after_hit])
    return doomed


def test_states_that_must_violate_are_hardly_looked_at():
    told, silent = graph_of(VectorizedSimulator(SHORT)), graph_of(Silent(SHORT))
    all_doomed, found = (sum(map(np.count_nonzero, doomed_states(g))) for g in (silent, told))
    assert all_doomed > 0.4 * sum(layer.count for layer in silent.layers)
    assert found < 0.01 * all_doomed


@pytest.mark.parametrize("simulator", [VectorizedSimulator, Silent])
def test_states_that_are_walked_to_once_more_are_those_that_were_kept(simulator, monkeypatch):
    kept = graph_of(simulator(SHORT))
    monkeypatch.setattr(reachable_states, "KEPT_STATES", 20)
    again = graph_of(simulator(SHORT))
    assert len(kept.layers) == len(again.layers) > 10
    for one, other in zip(kept.layers, again.layers, strict=True):
        np.testing.assert_array_equal(one.after_miss, other.after_miss)
        np.testing.assert_array_equal(one.after_hit, other.after_hit)
        for name in SIGNALS:
            np.testing.assert_allclose(
                one.states.signals[name], other.states.signals[name], rtol=1e-12
            )


def test_hardly_any_other_states_are_looked_at():
    live = sum(layer.count for layer in graph_of(Silent(SHORT)).layers)
    assert graph_of(VectorizedSimulator(SHORT), most_states=round(1.2 * live)).exact
    with pytest.raises(TooManyStates):
        graph_of(Silent(SHORT), most_states=100 * live)


def test_an_approximation_is_the_same_with_and_without_bounds(monkeypatch):
    exactly = []

    def merger(*args, **kwargs):
        exactly.append(kwargs["exactly"])
        return Merger(*args, **kwargs)

    monkeypatch.setattr(reachable_states, "Merger", merger)
    told = graph_of(VectorizedSimulator(SHORT)).layers
    exactly.clear()
    too_few = max(layer.count for layer in told) // 2
    one = graph_of(VectorizedSimulator(SHORT), largest_layer=too_few)
    other = graph_of(Silent(SHORT), largest_layer=too_few)
    assert exactly == [True, False, False]
    assert not one.exact
    for mine, theirs in zip(one.layers, other.layers, strict=True):
        np.testing.assert_array_equal(mine.pem_logit, theirs.pem_logit)
    assert solve(one).log_probability == solve(other).log_probability


@given(data=st.data())
@settings(deadline=None)
def test_a_rule_that_some_point_within_bounds_breaks_is_possible(data):
    spec = data.draw(
        st.sampled_from(
            [
                "gap >= 1.5",
                "gap <= 1.5 and ego_speed > 0.5",
                "gap < 0.5 or ego_speed >= 1.5",
                "not (gap >= 0.5) or (lead_speed <= 0.5 and gap > -0.5)",
                "gap + ego_speed >= 1.0 and gap >= -1.5",
                "gap > 1",
                "gap < 2 and ego_speed > -1",
                "gap < 0 or ego_speed > 1",
                "gap <= 1 or not (ego_speed >= 0)",
            ]
        )
    )
    rule = rule_of(f"always[0,5] ({spec})")
    sides = st.integers(-2, 2).map(float)
    bounds = {}
    for name in ("gap", "ego_speed"):  # of the lead car's speed nothing is known
        ends = sorted(data.draw(st.tuples(sides, sides)))
        bounds[name] = (np.array([ends[0]]), ends[1])
    ends = {n: (float(a[0]), b) for n, (a, b) in bounds.items()}
    within = {n: st.one_of(st.sampled_from(pair), st.floats(*pair)) for n, pair in ends.items()}
    point = {name: np.array([[data.draw(value)]]) for name, value in within.items()}
    point["lead_speed"] = np.array([[data.draw(st.floats(-2.0, 2.0))]])
    if stl.violated(stl.parse(spec, signals=SIGNALS), point)[0]:
        assert np.all(rule.possible(bounds, after=4))
    assert not np.any(rule.possible(bounds, after=5))


def test_bounds_rule_out_what_lies_beyond_them():
    far = {"gap": (np.array([2.0, 1.9]), np.array([9.0, 9.0]))}
    asked = {"gap >= 2.0": [False, True], "gap <= 9.0": [False, False], "gap < 8.0": [True, True]}
    for spec, expected in asked.items():
        found = rule_of(f"always[0,5] ({spec})").possible(far, after=0)
        np.testing.assert_array_equal(found, expected)


STEPS = 13
CONFIG = ScenarioConfig(initial_speed_kmh=50.0, initial_gap_m=5.0, dt_s=0.1, states=STEPS + 1)
TWIN = VectorizedSimulator(CONFIG)
CHAINS = np.array(list(itertools.product((False, True), repeat=STEPS)))


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
