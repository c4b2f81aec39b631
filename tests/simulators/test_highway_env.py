"""The environment keeps gymnasium's rules, equals the simulator, and can be filmed."""

import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.envs.common.abstract import AbstractEnv

from benchmarks.simulators import plain_road
from pemviz.config import ScenarioConfig
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking import highway_env_scenario
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.highway_env_scenario import ENVIRONMENT_ID, BrakingEnv, frames
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED
from pemviz.simulators.highway_env_cars import EGO_RGB, LEAD_RGB

ROAD_RGB = (100, 100, 100)
LINE_RGB = (255, 255, 255)


def columns(frame: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
    """Columns of a frame in which a colour occurs."""
    return np.flatnonzero(np.any(np.all(frame == rgb, axis=2), axis=0))


@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_gymnasium_s_checker_finds_nothing(render_mode) -> None:
    # gymnasium's warnings are errors here, as all warnings are.
    environment = gymnasium.make(ENVIRONMENT_ID, render_mode=render_mode).unwrapped
    assert isinstance(environment, AbstractEnv)
    check_env(environment)
    environment.close()


def test_gymnasium_can_import_the_module_by_itself() -> None:
    code = (
        "import gymnasium, sys, pemviz\n"
        "assert 'highway_env' not in sys.modules\n"
        f"gymnasium.make('{highway_env_scenario.__name__}:{ENVIRONMENT_ID}').reset()\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)


def test_simulator_s_module_leaves_highway_env_alone() -> None:
    code = (
        "import sys, pemviz.simulators.braking.highway\n"
        "assert not {'highway_env', 'pygame', 'gymnasium'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "scenario",
    [
        ScenarioConfig(),
        ScenarioConfig(dt_s=0.03, states=41, lead_brake_time_s=0.3),
        # Faster than highway-env's own limit of 40 m/s, and through the lead car.
        ScenarioConfig(initial_speed_kmh=144.0, lead_deceleration_mps2=20.0),
    ],
)
def test_episode_equals_a_rollout(scenario: ScenarioConfig) -> None:
    environment = gymnasium.make(ENVIRONMENT_ID, scenario=scenario)
    detected = np.random.default_rng(4).random((1, scenario.states - 1)) < 0.3
    expected = replay(simulator=HighwaySimulator(scenario), detected=detected)
    observations = [environment.reset(seed=0)[0]]
    for step, outcome in enumerate(detected[0].tolist()):
        observation, reward, terminated, truncated, _ = environment.step(int(outcome))
        observations.append(observation)
        assert (reward, terminated) == (0.0, False)
        assert truncated == (step == scenario.states - 2)
    assert all(observation in environment.observation_space for observation in observations)
    for column, name in enumerate((GAP, EGO_SPEED, LEAD_SPEED)):
        got = [observation[column] for observation in observations]
        np.testing.assert_allclose(got, expected[name][0], rtol=0, atol=1e-9)


def test_where_cars_stand_is_read_back_to_the_last_digit() -> None:
    simulator, rng = HighwaySimulator(ScenarioConfig()), np.random.default_rng(5)
    states = simulator.initial(count=50)
    gap_m, stands_mps = rng.normal(0, 20, 50), np.zeros(50)
    signals = {GAP: gap_m, EGO_SPEED: stands_mps, LEAD_SPEED: stands_mps}
    after = simulator.step(replace(states, signals=signals), rng.random(50) < 0.5)
    np.testing.assert_array_equal(after.signals[GAP], gap_m)
    np.testing.assert_array_equal(after.signals[LEAD_SPEED], stands_mps)


def test_frames_show_the_road_and_both_cars() -> None:
    config = ScenarioConfig()
    film = list(frames(config, detected=np.zeros(99, dtype=np.bool_)))
    assert len(film) == config.states
    assert {(frame.shape, frame.dtype) for frame in film} == {((160, 640, 3), np.dtype("uint8"))}
    first, later = film[0], film[55]
    assert np.mean(np.all(first == ROAD_RGB, axis=2)) > 0.5
    assert columns(first, LINE_RGB).size > 300
    for frame in (first, later):
        ego, lead = columns(frame, EGO_RGB), columns(frame, LEAD_RGB)
        assert ego.size > 40
        assert ego.max() < lead.min()
    # The lead car comes closer by what the gap loses, at the frame's scale.
    scale = BrakingEnv(config).config["scaling"]
    closer_px = columns(first, LEAD_RGB).min() - columns(later, LEAD_RGB).min()
    gap_m = replay(simulator=HighwaySimulator(config), detected=np.zeros((1, 99), dtype=bool))[GAP]
    assert closer_px == pytest.approx((gap_m[0, 0] - gap_m[0, 55]) * scale, abs=2)


def test_frames_do_not_depend_on_the_display_driver(monkeypatch) -> None:
    config = ScenarioConfig(states=2)
    detected = np.ones(1, dtype=np.bool_)
    expected = list(frames(config, detected=detected))
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    for one, other in zip(frames(config, detected=detected), expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_frames_refuse_outcomes_of_another_length() -> None:
    with pytest.raises(ValueError, match=r"expected \(99,\)"):
        frames(ScenarioConfig(), detected=np.zeros(98, dtype=np.bool_))


def test_yardstick_is_two_plain_vehicles_at_the_scenario_s_start() -> None:
    config = ScenarioConfig()
    road = plain_road(config)
    rear, front = road.vehicles
    assert type(rear).__module__ == "highway_env.vehicle.kinematics"
    assert front.position[0] - rear.position[0] - rear.LENGTH == config.initial_gap_m
    assert rear.speed == front.speed == config.initial_speed_mps
