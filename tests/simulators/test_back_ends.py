"""Both back ends give the trajectories that ``pemviz.simulators.braking`` tells, from any state."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.arrays import BoolArray, read_only
from pemviz.config import ScenarioConfig
from pemviz.config.toml_files import load_preset
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Simulator, StateBatch
from tests.simulators.reference import reference_rollout
from tests.simulators.strategies import Case, cases

TOLERANCE = 1e-9

back_ends = pytest.mark.parametrize("back_end", [VectorizedSimulator, HighwaySimulator])


def roll(simulator: Simulator, states: StateBatch, detected: BoolArray) -> list[StateBatch]:
    """The given state and those that follow it."""
    passed = [states]
    for outcomes in detected.T:
        passed.append(simulator.step(passed[-1], outcomes))
    return passed


def values(states: StateBatch) -> dict[str, np.ndarray]:
    return {**states.signals, **states.memory}


def assert_same(left: list[StateBatch], right: list[StateBatch]) -> None:
    assert len(left) == len(right)
    for one, other in zip(left, right, strict=True):
        assert int(one.step) == int(other.step)
        for name, array in values(one).items():
            np.testing.assert_array_equal(array, values(other)[name])


@back_ends
@settings(derandomize=True, deadline=None, max_examples=100)
@given(case=cases())
def test_trajectories_are_the_design_s(back_end, case: Case) -> None:
    simulator = back_end(case.config)
    passed = roll(simulator, simulator.initial(count=len(case.detected)), case.detected)
    assert [int(states.step) for states in passed] == list(range(case.config.states))
    for name, key in {
        GAP: "gap",
        EGO_SPEED: "ego_speed",
        LEAD_SPEED: "lead_speed",
        SPEED_ERROR_INTEGRAL: "integral",
    }.items():
        got = np.stack([values(states)[name] for states in passed], axis=1)
        np.testing.assert_allclose(got, case.expected[key], rtol=0, atol=TOLERANCE)
        if name in {EGO_SPEED, LEAD_SPEED}:
            assert got.min() >= 0.0


@settings(derandomize=True, deadline=None, max_examples=50)
@given(case=cases())
def test_back_ends_agree_with_each_other(case: Case) -> None:
    one = replay(simulator=VectorizedSimulator(case.config), detected=case.detected)
    other = replay(simulator=HighwaySimulator(case.config), detected=case.detected)
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_allclose(array, other[name], rtol=0, atol=TOLERANCE)


@back_ends
@settings(derandomize=True, deadline=None, max_examples=40)
@given(case=cases(), data=st.data())
def test_a_kept_state_can_be_continued_from_again(back_end, case: Case, data) -> None:
    simulator = back_end(case.config)
    detected = case.detected
    passed = roll(simulator, simulator.initial(count=len(detected)), detected)
    kept = data.draw(st.integers(0, len(passed) - 1))
    assert_same(roll(simulator, passed[kept], detected[:, kept:]), passed[kept:])
    branched = np.concatenate([detected[:, :kept], ~detected[:, kept:]], axis=1)
    assert_same(
        roll(simulator, passed[kept], branched[:, kept:]),
        roll(simulator, simulator.initial(count=len(detected)), branched)[kept:],
    )


@back_ends
@settings(derandomize=True, deadline=None, max_examples=20)
@given(case=cases())
def test_rollouts_of_a_batch_do_not_touch_each_other(back_end, case: Case) -> None:
    simulator = back_end(case.config)
    together = replay(simulator=simulator, detected=case.detected)
    for index in range(len(case.detected)):
        alone = replay(simulator=simulator, detected=case.detected[index : index + 1])
        for name, array in alone.items():
            np.testing.assert_array_equal(array[0], together[name][index])


@back_ends
def test_a_step_writes_to_no_state_it_is_given(back_end) -> None:
    simulator = back_end(ScenarioConfig())
    states = simulator.initial(count=3)
    frozen = StateBatch(
        step=read_only(states.step),
        signals={name: read_only(array) for name, array in states.signals.items()},
        memory={name: read_only(array) for name, array in states.memory.items()},
    )
    simulator.step(frozen, read_only(np.array([True, False, True])))


@back_ends
def test_states_of_a_batch_may_be_at_different_steps(back_end) -> None:
    config = ScenarioConfig(lead_brake_time_s=0.3)
    simulator = back_end(config)
    start = simulator.initial(count=3)
    mixed = StateBatch(step=np.array([0, 5, 6]), signals=start.signals, memory=start.memory)
    after = simulator.step(mixed, np.zeros(3, dtype=np.bool_))
    v0_mps = config.initial_speed_mps
    braked_mps = v0_mps - config.lead_deceleration_mps2 * config.dt_s
    np.testing.assert_array_equal(after.step, [1, 6, 7])
    np.testing.assert_allclose(after.signals[LEAD_SPEED], [v0_mps, v0_mps, braked_mps], rtol=1e-15)


@back_ends
def test_an_ego_that_never_detects_keeps_its_speed(back_end) -> None:
    config = ScenarioConfig()
    signals = replay(simulator=back_end(config), detected=np.zeros((1, 99), dtype=np.bool_))
    # Closed form while the lead moves, which at 0.3 g it does for all 5 s.
    steps = np.arange(100)
    lost_m = config.lead_deceleration_mps2 * config.dt_s**2 * steps * (steps - 1) / 2
    np.testing.assert_allclose(signals[GAP][0], 15.0 - lost_m, rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(signals[EGO_SPEED][0], np.full(100, 70 / 3.6))


@back_ends
@pytest.mark.parametrize("preset", ["paper", "town01"])
def test_presets_give_the_design_s_trajectories(back_end, preset: str) -> None:
    config = load_preset(preset).scenario
    detected = np.random.default_rng(1).random((5, config.states - 1)) < 0.5
    signals = replay(simulator=back_end(config), detected=detected)
    for index, row in enumerate(detected.tolist()):
        expected = reference_rollout(config, row)
        for name in signals:
            np.testing.assert_allclose(signals[name][index], expected[name], rtol=0, atol=TOLERANCE)


@back_ends
def test_overshoot_is_limited_by_the_controller_alone(back_end) -> None:
    # After an emergency the integral drives the ego beyond its target, here beyond the 40 m/s
    # at which highway-env would step in, and the controller's own lower limit acts.
    config = ScenarioConfig(
        initial_speed_kmh=144.0,
        speed_integral_gain_per_s2=0.3,
        maximum_deceleration_mps2=0.1,
        states=600,
    )
    detected = np.arange(599) < 60
    expected = reference_rollout(config, detected.tolist())
    assert max(expected["ego_speed"]) > 41.0
    limit_mps = config.maximum_deceleration_mps2 * config.dt_s
    assert np.sum(np.isclose(np.diff(expected["ego_speed"]), -limit_mps)) > 50
    signals = replay(simulator=back_end(config), detected=detected[None, :])
    for name in signals:
        np.testing.assert_allclose(signals[name][0], expected[name], rtol=0, atol=TOLERANCE)


@back_ends
def test_back_ends_keep_the_protocol(back_end) -> None:
    config = ScenarioConfig(states=7, dt_s=0.1)
    simulator = back_end(config)
    assert isinstance(simulator, Simulator)
    assert (simulator.states, simulator.dt_s) == (7, 0.1)
    assert [signal.name for signal in simulator.signals] == [GAP, EGO_SPEED, LEAD_SPEED]
    assert simulator == back_end(config)
    assert simulator.step(simulator.initial(count=0), np.zeros(0, dtype=np.bool_)).signals[
        GAP
    ].shape == (0,)


def test_threads_may_share_a_highway_simulator() -> None:
    simulator = HighwaySimulator(ScenarioConfig())
    detected = np.random.default_rng(2).random((4, 2, 99)) < 0.5
    alone = [replay(simulator=simulator, detected=part)[GAP] for part in detected]
    shared: dict[int, np.ndarray] = {}

    def work(index: int) -> None:
        shared[index] = replay(simulator=simulator, detected=detected[index])[GAP]

    threads = [threading.Thread(target=work, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index, gap_m in enumerate(alone):
        np.testing.assert_array_equal(shared[index], gap_m)
