"""Gymnasium environments behind the simulator protocol, states kept by numbers or by copies."""

import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import pemviz
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.gymnasium_adapter import TRIED, KeptSteps
from tests.lattice_walk import (
    ToyPem,
    ToySimulator,
    toy_probability_by_recursion,
)

TOY = ToySimulator(initial_gap=4, largest_gap=6, states=11)
PEM = ToyPem(at_zero=2.0)
SPEC = "always[0,10] (gap >= 0.5)"


class Walk(gym.Env):
    """The toy's lattice walk as an environment; hitting 0 ends the episode."""

    action_space = gym.spaces.Discrete(2)
    observation_space = gym.spaces.Box(-10.0, 10.0, (1,), np.float64)

    def __init__(self, *, ends=False):
        self.ends = ends
        self.gap = 0.0
        self.over = True

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.gap, self.over = float(TOY.initial_gap), False
        return np.array([self.gap]), {}

    def step(self, action):
        assert self.action_space.contains(action)
        assert not self.over, "stepped after the end"
        self.gap = min(self.gap + (1.0 if action else -1.0), float(TOY.largest_gap))
        self.over = self.ends and self.gap <= 0.0
        return np.array([self.gap]), 0.0, self.over, False, {}


def set_gap(walk, numbers):
    walk.gap = float(numbers[0])


def adapter(environment, *, pair=True, **changes):
    settings = {
        "environment": environment,
        "signals": TOY.signals,
        "observe": lambda observation: {"gap": observation[0]},
        "states": TOY.states,
        "dt_s": 1.0,
        "name": "walk",
    }
    if pair:
        settings |= {"get_state": lambda walk: np.array([walk.gap]), "set_state": set_gap}
    return pemviz.GymnasiumSimulator(**(settings | changes))


@pytest.mark.parametrize("pair", [True, False])
def test_same_trajectories_as_the_vectorized_toy(pair):
    detected = np.random.default_rng(5).random((40, TOY.states - 1)) < 0.5
    expected = replay(simulator=TOY, detected=detected)["gap"]
    found = replay(simulator=adapter(Walk(), pair=pair), detected=detected)["gap"]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("pair", [True, False])
@pytest.mark.parametrize("method", ["mixture", "splitting", "subset", "monte-carlo"])
def test_same_answer_as_the_toy_and_near_the_truth(method, pair):
    """The same seed gives the very same rollouts, so the answers are equal."""
    config = pemviz.ExperimentConfig(
        method=method, spec=SPEC, stages=4, rollouts=40, final_rollouts=60, seed=2
    )
    if method in ("splitting", "subset"):
        config = replace(config, stages=2, rollouts=10)

    def run(simulator):
        return pemviz.run(pemviz.build_experiment(config, simulator=simulator, pem=PEM)).estimate

    found = run(adapter(Walk(), pair=pair))
    assert found == run(TOY)
    if method == "mixture":
        truth = toy_probability_by_recursion(TOY, PEM)
        assert found.ci_low < truth < found.ci_high


@pytest.mark.parametrize("pair", [True, False])
def test_signals_stay_once_the_episode_has_ended(pair):
    detected = np.zeros((3, TOY.states - 1), dtype=np.bool_)
    detected[1] = True
    gaps = replay(simulator=adapter(Walk(ends=True), pair=pair), detected=detected)["gap"]
    np.testing.assert_array_equal(gaps[0], [4, 3, 2, 1, 0, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(gaps[1], [4, 5, 6, 6, 6, 6, 6, 6, 6, 6, 6])


def test_action_and_salient_variables_are_the_users_to_choose():
    class Named(Walk):
        action_space = gym.spaces.Dict({"seen": gym.spaces.Discrete(2)})

        def step(self, action):
            return Walk.step(Walk_like(self), action["seen"])

    def Walk_like(walk):  # noqa: N802
        walk.action_space = gym.spaces.Discrete(2)
        return walk

    simulator = adapter(
        Named(),
        action_of=lambda seen: {"seen": int(seen)},
        salient_of=lambda signals: np.stack([signals["gap"], signals["gap"] ** 2], axis=-1),
    )
    states = simulator.step(simulator.initial(count=2), np.array([True, False]))
    np.testing.assert_array_equal(states.signals["gap"], [5.0, 3.0])
    np.testing.assert_array_equal(simulator.salient(states.signals), [[5.0, 25.0], [3.0, 9.0]])


def test_an_incomplete_state_is_told_before_the_run():
    """``heat`` decides how the walk goes on, but get_state leaves it out."""

    class Hidden(Walk):
        heat = 0.0

        def step(self, action):
            self.heat += 1.0
            _, *rest = super().step(action)
            return np.array([self.gap - 0.01 * self.heat]), *rest

    with pytest.raises(pemviz.ConfigError, match="the same again"):
        pemviz.build_experiment(
            pemviz.ExperimentConfig(method="mixture", spec=SPEC),
            simulator=adapter(Hidden()),
            pem=PEM,
        )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"set_state": lambda walk, numbers: None},
            r"\(gap .*must be in signals and memory",
        ),
        ({"set_state": None}, "has get_state but no set_state"),
        ({"get_state": None}, "has set_state but no get_state"),
        (
            {"observe": lambda observation: {"gapp": observation[0]}},
            r"observe gives \['gapp'\], signals declare \['gap'\]",
        ),
    ],
)
def test_an_adapter_that_is_put_together_wrongly_is_refused_in_one_line(changes, words):
    with pytest.raises(pemviz.ConfigError, match=words) as caught:
        pemviz.build_experiment(
            pemviz.ExperimentConfig(method="mixture", spec=SPEC),
            simulator=adapter(Walk(), **changes),
            pem=PEM,
        )
    assert "\n" not in str(caught.value)


def test_adapters_are_simulators_that_can_be_changed_in_part():
    simulator = adapter(Walk(), pair=False)
    assert isinstance(simulator, pemviz.Simulator)
    assert replace(simulator, states=5).states == 5


class Counting(Walk):
    """Counts its steps; from the step ``drifts_from`` on it does not do the same again."""

    def __init__(self, *, drifts_from=10**9):
        super().__init__()
        self.steps, self.drifts_from = 0, drifts_from

    def step(self, action):
        self.steps += 1
        observation, *rest = super().step(action)
        return observation + 0.01 * max(self.steps - self.drifts_from, 0), *rest


def stepped_again(kept_steps, *, drifts_from=10**9, times=200):
    """The environment's steps, and the gaps last seen: from seven states, six of them alike."""
    environment = Counting(drifts_from=drifts_from)
    simulator = adapter(environment, kept_steps=kept_steps)
    states = simulator.initial(count=7)
    states = simulator.step(states, np.array([True] + [False] * 6))
    for _ in range(times):
        reached = simulator.step(states, np.zeros(7, dtype=np.bool_))
    return environment.steps, reached.signals["gap"]


def test_a_step_that_is_known_is_not_made_again():
    every, expected = stepped_again(0)
    few, found = stepped_again(100)
    np.testing.assert_array_equal(found, expected)
    assert every == 7 * 201
    assert few == 2 + TRIED + 2  # two states by the first step, two more by those after it
    assert stepped_again(1)[0] > few


def test_an_environment_that_drifts_is_not_remembered():
    steps, gaps = stepped_again(100, drifts_from=50)
    assert steps == 7 * 201
    assert np.unique(gaps).size == 7


def test_what_is_sent_to_another_process_forgets():
    known = KeptSteps(5)
    known.reached(np.zeros(1), True, lambda: np.ones(1))
    again = copy.copy(known)  # by the same means as pickle
    assert again.reached(np.zeros(1), True, lambda: np.full(1, 2.0)) == [2.0]
