"""Both back ends give the trajectories that ``pemviz.simulators.braking`` tells, from any state.

So do estimates on them; contact is that of motion worked out by hand.
"""

import threading
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pemviz import AlphaBeta, Kalman, Tracker
from pemviz.arrays import read_only
from pemviz.config import ScenarioConfig
from pemviz.config.toml_files import load_preset
from pemviz.pem import load_pem
from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.sampling.direct.method import DirectSampling
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M, FollowedCar, first_contact
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, SPEED_ERROR_INTEGRAL
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Simulator, StateBatch
from tests.simulators.reference import reference_rollout

TOLERANCE = 1e-9
NAMES = {
    GAP: "gap", EGO_SPEED: "ego_speed", LEAD_SPEED: "lead_speed", SPEED_ERROR_INTEGRAL: "integral"
}  # fmt: skip
back_ends = pytest.mark.parametrize("back_end", [VectorizedSimulator, HighwaySimulator])


CLOSE_TO_THRESHOLD_M = 1e-9


@dataclass(frozen=True)
class Case:
    config: ScenarioConfig
    detected: np.ndarray  # [N, T-1]
    expected: dict[str, np.ndarray]  # [N, T]


# Gains stay where the speed loop is stable (gain * dt well below 2): an unstable loop would
# multiply rounding step by step, and no two orders of summation could agree to 1e-9.
scenarios = st.builds(
    ScenarioConfig,
    initial_speed_kmh=st.floats(0.5, 144.0),
    initial_gap_m=st.floats(0.1, 60.0),
    lead_deceleration_mps2=st.floats(0.0, 20.0),
    lead_brake_time_s=st.sampled_from([0.0, 0.0, 0.05, 0.3, 1.7]),
    emergency_gap_m=st.floats(0.5, 70.0),
    emergency_deceleration_mps2=st.floats(0.1, 20.0),
    speed_gain_per_s=st.floats(0.0, 4.0),
    speed_integral_gain_per_s2=st.floats(0.0, 0.5),
    maximum_acceleration_mps2=st.floats(0.0, 5.0),
    maximum_deceleration_mps2=st.floats(0.0, 10.0),
    dt_s=st.floats(0.005, 0.2),
    states=st.integers(2, 60),
    lead_length_m=st.floats(0.5, 20.0),
    gap_bound_m=st.just(100.0),
)
TRACKERS = {
    "none": None,
    "2/3": {"hits": 2, "window": 3},
    "1/2,coast=0.2": {"hits": 1, "window": 2, "coast_s": 0.2},
    "2/4,coast=0.31,filter=alpha-beta,alpha=0.5,beta=0.3": {
        "hits": 2, "window": 4, "coast_s": 0.31, "filter": AlphaBeta(alpha=0.5, beta=0.3)
    },
    "1/1,coast=0.5,filter=kalman,position-sd=0.2,speed-sd=4": {
        "hits": 1, "window": 1, "coast_s": 0.5,
        "filter": Kalman(position_sd_m=0.2, first_speed_sd_mps=4.0),
    },
}  # fmt: skip
"""As they are written, and what that says."""


@st.composite
def cases(draw: st.DrawFn) -> Case:
    config = replace(draw(scenarios), tracker=draw(st.sampled_from(list(TRACKERS))))
    options = TRACKERS[config.tracker]
    tracker = None if options is None else Tracker(dt_s=config.dt_s, axes=1, **options)
    count = draw(st.integers(1, 3))
    shape = (count, config.states - 1)
    # Long chains of the same outcome reach more of the state space than independent ones.
    share = draw(st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]))
    seed = draw(st.integers(0, 2**32 - 1))
    detected = np.random.default_rng(seed).random(shape) < share
    tracks = [reference_rollout(config, row, tracker) for row in detected.tolist()]
    expected = {name: np.array([track[name] for track in tracks]) for name in tracks[0]}
    # "gap < emergency gap" is a jump: where the two are equal but for rounding, back ends that
    # add in another order may rightly decide differently, and part ways from there.
    distance_m = np.abs(expected["reported"] - config.emergency_gap_m)
    assume(float(distance_m.min()) > CLOSE_TO_THRESHOLD_M)
    return Case(config=config, detected=detected, expected=expected)


def roll(simulator, states, detected):
    """The given state and those that follow it."""
    passed = [states]
    for outcomes in detected.T:
        passed.append(simulator.step(passed[-1], outcomes))
    return passed


def values(states):
    return {**states.signals, **states.memory}


def assert_same(left, right):
    for one, other in zip(left, right, strict=True):
        assert int(one.step) == int(other.step)
        for name, array in values(one).items():
            np.testing.assert_array_equal(array, values(other)[name])


@back_ends
@settings(derandomize=True, deadline=None, max_examples=100)
@given(case=cases())
def test_trajectories_are_the_design_s(back_end, case):
    simulator = back_end(case.config)
    passed = roll(simulator, simulator.initial(count=len(case.detected)), case.detected)
    assert [int(states.step) for states in passed] == list(range(case.config.states))
    for name, key in NAMES.items():
        got = np.stack([values(states)[name] for states in passed], axis=1)
        np.testing.assert_allclose(got, case.expected[key], rtol=0, atol=TOLERANCE)
        if name in {EGO_SPEED, LEAD_SPEED}:
            assert got.min() >= 0.0


@settings(derandomize=True, deadline=None, max_examples=50)
@given(case=cases())
def test_back_ends_agree_with_each_other(case):
    one = replay(simulator=VectorizedSimulator(case.config), detected=case.detected)
    other = replay(simulator=HighwaySimulator(case.config), detected=case.detected)
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_allclose(array, other[name], rtol=0, atol=TOLERANCE)


@back_ends
@settings(derandomize=True, deadline=None, max_examples=40)
@given(case=cases(), data=st.data())
def test_a_kept_state_can_be_continued_from_again(back_end, case, data):
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
def test_rollouts_of_a_batch_do_not_touch_each_other(back_end, case):
    simulator = back_end(case.config)
    together = replay(simulator=simulator, detected=case.detected)
    for index in range(len(case.detected)):
        alone = replay(simulator=simulator, detected=case.detected[index : index + 1])
        for name, array in alone.items():
            np.testing.assert_array_equal(array[0], together[name][index])


@back_ends
def test_a_step_writes_to_no_state_it_is_given(back_end):
    simulator = back_end(ScenarioConfig())
    states = simulator.initial(count=3)
    frozen = StateBatch(
        step=read_only(states.step),
        signals={name: read_only(array) for name, array in states.signals.items()},
        memory={name: read_only(array) for name, array in states.memory.items()},
    )
    simulator.step(frozen, read_only(np.array([True, False, True])))


@back_ends
def test_states_of_a_batch_may_be_at_different_steps(back_end):
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
def test_an_ego_that_never_detects_keeps_its_speed(back_end):
    config = ScenarioConfig()
    signals = replay(simulator=back_end(config), detected=np.zeros((1, 99), dtype=np.bool_))
    # Closed form while the lead moves, which at 0.3 g it does for all 5 s.
    steps = np.arange(100)
    lost_m = config.lead_deceleration_mps2 * config.dt_s**2 * steps * (steps - 1) / 2
    np.testing.assert_allclose(signals[GAP][0], 15.0 - lost_m, rtol=0, atol=TOLERANCE)
    np.testing.assert_array_equal(signals[EGO_SPEED][0], np.full(100, 70 / 3.6))


@back_ends
@pytest.mark.parametrize("preset", ["paper", "town01"])
def test_presets_give_the_design_s_trajectories(back_end, preset):
    config = load_preset(preset).scenario
    detected = np.random.default_rng(1).random((5, config.states - 1)) < 0.5
    signals = replay(simulator=back_end(config), detected=detected)
    for index, row in enumerate(detected.tolist()):
        expected = reference_rollout(config, row)
        for name in signals:
            np.testing.assert_allclose(signals[name][index], expected[name], rtol=0, atol=TOLERANCE)


@back_ends
def test_overshoot_is_limited_by_the_controller_alone(back_end):
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
def test_back_ends_keep_the_protocol(back_end):
    config = ScenarioConfig(states=7, dt_s=0.1)
    simulator = back_end(config)
    assert isinstance(simulator, Simulator)
    assert (simulator.states, simulator.dt_s) == (7, 0.1)
    assert [signal.name for signal in simulator.signals] == [GAP, EGO_SPEED, LEAD_SPEED]
    assert simulator == back_end(config)
    assert simulator.step(simulator.initial(count=0), np.zeros(0, dtype=np.bool_)).signals[
        GAP
    ].shape == (0,)


def test_threads_may_share_a_highway_simulator():
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


@pytest.mark.parametrize(
    ("method", "proposal", "limit_m"),
    [("naive", ConstantProposal(detection_probability=0.5), 2.0),
     ("monte-carlo", PemProposal(), 9.8)],
)  # fmt: skip
def test_estimates_agree_across_back_ends(method, proposal, limit_m):
    """The emergency gap of 10 m is crossed in every rollout; under the PEM the smallest gaps lie
    around 9.8 m, so a limit there makes plain Monte Carlo see failures too."""

    def robustness(signals):
        return np.min(signals[GAP], axis=1) - limit_m

    def estimate(simulator):
        problem = Problem(
            simulator=simulator,
            pem=load_pem("ml-nn"),
            robustness=robustness,
            violated=lambda signals: robustness(signals) < 0,
            batch_rollouts=25,
        )
        sampling = DirectSampling(name=method, proposal=proposal, rollouts=60, seed=3)
        state, _ = sampling.step(problem, sampling.init(problem, repetition=0))
        return sampling.estimate(state)

    one, other = (estimate(k(ScenarioConfig())) for k in (VectorizedSimulator, HighwaySimulator))
    assert one.failures > 0
    assert one.failures == other.failures
    assert one.probability > 0
    assert other.probability == pytest.approx(one.probability, rel=1e-9, abs=0)
    assert other.std_error == pytest.approx(one.std_error, rel=1e-9, abs=0)
    assert other.log10_probability == pytest.approx(one.log10_probability, rel=1e-9)


DT_S = 0.1
# closing at 5 m/s from 3.2 m: 3.2, 2.7, 2.2, 1.7, ... m
CLOSING_M = 3.2 - 0.5 * np.arange(8.0)


def test_the_first_state_whose_bumpers_touch_and_the_speed_that_closed_the_gap():
    contact = first_contact(CLOSING_M, dt_s=DT_S)
    assert contact is not None
    assert contact.step == 3
    assert contact.time_s == pytest.approx(0.3)
    assert contact.impact_speed_mps == pytest.approx(5.0)


def test_touching_exactly_is_contact_and_a_hair_more_is_not():
    gap_m = np.array([4.0, CAMERA_TO_BUMPER_M, 3.0])
    assert first_contact(gap_m, dt_s=DT_S).step == 1
    assert first_contact(np.nextafter(gap_m, np.inf), dt_s=DT_S) is None


def test_from_contact_on_nothing_that_is_drawn_moves():
    signals = {"gap": CLOSING_M, "ego_speed": np.full(8, 10.0), "lead_speed": np.full(8, 5.0)}
    scene = FollowedCar(DT_S, lead_length_m=4.0).scene(signals)
    ego_m, lead_m = scene.x_m.T
    np.testing.assert_allclose(ego_m, [0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0])
    between_m = (lead_m - 2.0) - (ego_m + 2.5)
    np.testing.assert_allclose(between_m, [1.2, 0.7, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert scene.collided.tolist() == [False] * 3 + [True] * 5
    assert scene.impact_speed_mps[3] == pytest.approx(5.0)


def test_who_never_touches_is_drawn_where_it_is():
    signals = {name: np.full(4, 10.0) for name in ("gap", "ego_speed", "lead_speed")}
    scene = FollowedCar(DT_S).scene(signals)
    assert not scene.collided.any()
    np.testing.assert_allclose(np.diff(scene.x_m, axis=1)[:, 0], 5.0 + 10.0 - CAMERA_TO_BUMPER_M)
    np.testing.assert_allclose(scene.x_m[:, 0], [0.0, 1.0, 2.0, 3.0])


def test_a_rollout_that_begins_in_contact_has_no_impact():
    contact = first_contact(np.array([1.0, 0.5]), dt_s=DT_S)
    assert (contact.step, contact.impact_speed_mps) == (0, 0.0)
