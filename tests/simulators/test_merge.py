"""highway-env's merge-v0: what it does is its own, what the ego is told is what was detected."""

import numpy as np
import pytest
from highway_env.envs.merge_env import MergeEnv
from highway_env.vehicle.behavior import IDMVehicle
from scipy.stats import norm

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.config.toml_files import load_preset, with_own_rules
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.check import check_simulator
from pemviz.simulators.check_declared import Complaint, check_starts
from pemviz.simulators.merge import CARS, LANES
from pemviz.simulators.merge.highway_env_merge import CONFIG
from pemviz.simulators.merge.scenario import (
    FASTER,
    IDLE,
    SLOWER,
    MergeSimulator,
    ego_action,
)

SIMULATOR = MergeSimulator(ScenarioConfig())
STEPS = 20


def test_the_environment_does_with_the_ego_s_actions_what_it_does_alone() -> None:
    start = np.random.default_rng(4).standard_normal((1, 6))
    detected = np.ones((1, STEPS, 4), dtype=np.bool_)
    detected[:, 5:8] = False
    states = SIMULATOR.initial(count=1, start=start)
    bare = MergeEnv(config={**CONFIG, "observation": {"type": "Kinematics"}})
    bare.reset(seed=0)
    means, shares_of = ((90.0, 29.0), (70.0, 31.0), (5.0, 31.5)), norm.cdf(start).reshape(3, 2)
    kept = zip(means, LANES, shares_of, strict=True)
    for place, ((along_m, speed_mps), lane, shares) in enumerate(kept, start=1):
        at_m = [along_m - 5.0 + 10.0 * shares[0], 4.0 * lane]
        car = IDMVehicle(bare.road, at_m, speed=speed_mps - 1.0 + 2.0 * shares[1])
        bare.road.vehicles[place] = car
    for step in range(STEPS):
        ego, *others = bare.road.vehicles
        away = np.array([car.position - ego.position for car in others])
        for name, column in (("gap", away[:, 0] - 5.0), ("aside", -away[:, 1])):
            got = [states.signals[f"{name}_{car}"][0] for car in CARS]
            np.testing.assert_allclose(got, column, rtol=0.0, atol=1e-9)
        speeds = [states.signals[f"speed_{car}"][0] for car in CARS]
        np.testing.assert_allclose(speeds, [car.speed for car in others], rtol=0.0, atol=1e-9)
        seen = SIMULATOR.present(states.signals) & detected[:, step]
        position_m = np.stack([away[None, :, 0] - 5.0, -away[None, :, 1]], axis=-1)
        action = ego_action(seen, position_m, np.zeros((1, 4, 2)), np.array([ego.speed]))
        bare.step(int(action[0]))
        states = SIMULATOR.step(states, detected[:, step])


def test_start_values_are_where_and_how_fast_the_environment_s_cars_begin() -> None:
    start = np.random.default_rng(7).standard_normal((3, 6))
    values, states = SIMULATOR.start_values(start), SIMULATOR.initial(count=3, start=start)
    for car in CARS[:3]:
        for what in ("gap", "speed"):
            got = states.signals[f"{what}_{car}"]
            np.testing.assert_allclose(values[f"{car}_{what}"], got, rtol=0.0, atol=1e-9)
    check_starts(SIMULATOR, Complaint("merge"))


def test_a_car_missed_all_along_is_driven_into_and_one_detected_is_not() -> None:
    detected = np.zeros((2, SIMULATOR.states - 1, 4), dtype=np.bool_)
    detected[1] = True
    signals = replay(simulator=SIMULATOR, detected=detected, start=np.zeros((2, 6)))
    assert signals["collided"][:, -1].tolist() == [1.0, 0.0]
    assert signals["clearance"][0, -1] < 0.0 < signals["clearance"][1].min()
    drawn = SIMULATOR.scene(signals)
    np.testing.assert_allclose(
        drawn.x_m[..., 1:] - drawn.x_m[..., :1] - 5.0,
        np.stack([signals[f"gap_{car}"] for car in CARS], axis=-1),
        rtol=0.0, atol=1e-9,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gap_m", "aside_m", "sideways_mps", "action"),
    [
        (33.0, 0.0, 0.0, SLOWER),  # 10 m and 1.2 s at 20 m/s are 34 m
        (35.0, 0.0, 0.0, IDLE),  # and with 1.6 s 42 m
        (43.0, 0.0, 0.0, FASTER),
        (33.0, -5.9, 0.0, SLOWER),
        (33.0, 6.1, 0.0, FASTER),
        (33.0, 7.0, -1.1, SLOWER),
    ],
)
def test_the_ego_acts_on_whom_it_tracks(gap_m, aside_m, sideways_mps, action) -> None:
    position, speed = np.array([[[gap_m, aside_m]]]), np.array([[[0.0, sideways_mps]]])
    ego_mps = np.array([20.0])
    assert ego_action(np.array([[True]]), position, speed, ego_mps).tolist() == [action]
    assert ego_action(np.array([[False]]), position, speed, ego_mps).tolist() == [FASTER]


def test_its_episodes_and_tracks_pass_the_check() -> None:
    check_simulator(MergeSimulator(ScenarioConfig(tracker="2/3,filter=kalman")))


def test_it_brings_rules_unless_others_are_asked() -> None:
    rules = load_preset("merge").rules
    asked = parse(["--simulator", "merge", "--fail-above", "no-collision=0.1"])
    assert asked.experiment.rules == rules
    assert with_own_rules(ExperimentConfig(simulator="merge")).rules == rules
    own = ExperimentConfig(simulator="merge", spec="always[0,60] (clearance >= 1)")
    assert with_own_rules(own) == own
    assert with_own_rules(ExperimentConfig()) == ExperimentConfig()


def test_the_road_that_is_drawn_is_the_environment_s() -> None:
    """Edges of its lanes, by its own geometry: y grows to the right there."""
    environment = MergeEnv(config=CONFIG)
    environment.reset(seed=0)
    network, road = environment.road.network, SIMULATOR.road
    (ramp,) = road.ramps
    for start, end in (("j", "k"), ("k", "b"), ("b", "c")):
        number = 2 if start == "b" else 0
        lane = network.get_lane((start, end, number))
        for along_m in np.linspace(0.0, lane.length, 9):
            for edge_m, aside_m in ((ramp.right_m, 2.0), (ramp.left_m, -2.0)):
                x_m, y_m = lane.position(along_m, aside_m)
                # highway-env measures across the bend, along the normal
                assert np.interp(x_m, ramp.x_m, edge_m) == pytest.approx(-y_m, abs=0.03)
    right, left = network.get_lane(("a", "b", 1)), network.get_lane(("a", "b", 0))
    edges_m = [-right.position(0.0, 2.0)[1], -right.position(0.0, -2.0)[1]]
    assert road.lane_edges_m == (*edges_m, -left.position(0.0, -2.0)[1])
