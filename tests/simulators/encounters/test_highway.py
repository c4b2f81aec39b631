"""Cars that highway-env moves are where the vectorized ones are."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.envs.common.abstract import AbstractEnv

from pemviz.config import LOGICAL_SCENARIOS, EncounterConfig, StartChoice
from pemviz.pem import load_position_errors
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.encounters.highway import HighwayEncounters
from pemviz.simulators.encounters.highway_env_encounters import EncounterEnv, encounter_frames
from pemviz.simulators.encounters.vectorized import VectorizedEncounters

TOLERANCE = 1e-9
TRACKERS = ("none", "2/3,coast=0.3", "2/3,coast=0.5,filter=kalman")
SPREAD = 1.5
"""Starts are drawn so much wider than they are, for more contacts."""


def both(logical_scenario: str, *, draws: int, tracker: str, seed: int = 1, errors=None, **fields):
    """Both back ends with starts ``[draws, S]`` and outcomes ``[draws, T-1, K]``."""
    config = EncounterConfig(logical_scenario=logical_scenario, **fields)
    kinds = (VectorizedEncounters, HighwayEncounters)
    one, other = (kind(config, (), tracker, errors) for kind in kinds)
    generator = np.random.default_rng(seed)
    start = SPREAD * generator.standard_normal((draws, one.latents.start))
    shares = generator.random((draws, 1, 1))
    detected = generator.random((draws, one.states - 1, len(one.slots))) < shares
    return one, other, detected, start


def assert_equal(one, other, detected, start) -> float:
    """Signals of both; how many encounters ended in contact."""
    size = (*detected.shape[:2], one.latents.noise)
    noise = np.random.default_rng(2).standard_normal(size) if one.errors is not None else None
    expected = replay(simulator=one, detected=detected, start=start, noise=noise)
    got = replay(simulator=other, detected=detected, start=start, noise=noise)
    assert list(got) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(got[name], values, rtol=0.0, atol=TOLERANCE, err_msg=name)
    return expected["collided"][:, -1].sum()


@pytest.mark.parametrize(
    ("logical_scenario", "tracker"), list(zip(LOGICAL_SCENARIOS, TRACKERS, strict=True))
)
def test_back_ends_agree(logical_scenario, tracker) -> None:
    errors = None if tracker == TRACKERS[1] else load_position_errors("pointpillars")
    own = {"neighbour": True, "ghost_probability": 0.1, "errors": errors}
    assert_equal(*both(logical_scenario, draws=2, tracker=tracker, states=61, **own))


@pytest.mark.slow
@pytest.mark.parametrize("logical_scenario", LOGICAL_SCENARIOS)
@pytest.mark.parametrize("tracker", TRACKERS)
def test_back_ends_agree_over_200_draws(logical_scenario, tracker) -> None:
    side = "left" if tracker == "none" else "right"
    contacts = assert_equal(*both(logical_scenario, draws=200, tracker=tracker, side=side))
    assert contacts > 5
    own = {"neighbour": True, "car_length_m": 6.0, "ghost_probability": 0.1}
    own["errors"] = load_position_errors("pointpillars")
    assert_equal(*both(logical_scenario, draws=50, tracker=tracker, **own))


@pytest.mark.parametrize("tracker", TRACKERS[:2])
def test_the_environment_sees_moves_and_measures_as_the_back_end(tracker) -> None:
    one, _, detected, start = both("cut-out", draws=2, tracker=tracker, states=61)
    environment = EncounterEnv(one.config, (), tracker)
    states = one.initial(count=2, start=start)
    for row in range(2):
        environment.reset(options={"start": start[row]})
        states = one.initial(count=1, start=start[row : row + 1])
        for outcomes in detected[row]:
            expected = [states.signals[signal.name][0] for signal in one.signals]
            observed = environment.observation_type.observe()
            np.testing.assert_allclose(observed, expected, rtol=0.0, atol=TOLERANCE)
            present = one.present(states.signals)[0]
            np.testing.assert_array_equal(environment.present(), present)
            environment.advance(outcomes)
            states = one.step(states, outcomes[None])


def test_a_kept_state_is_gone_on_from_among_others() -> None:
    _, simulator, detected, start = both("cut-in", draws=2, tracker="2/3", states=21)
    states = simulator.initial(count=2, start=start)
    for step in range(10):
        states = simulator.step(states, detected[:, step])
    together = simulator.step(states, detected[:, 10])
    simulator.initial(count=1, start=start[:1])  # what the scene holds does not matter
    alone = simulator.step(states.take(np.array([1])), detected[1:, 10])
    for name, values in {**alone.signals, **alone.memory}.items():
        np.testing.assert_array_equal(values[0], {**together.signals, **together.memory}[name][1])


def test_gymnasium_s_checker_finds_nothing() -> None:
    # gymnasium's warnings are errors here, as all warnings are.
    environment = gymnasium.make("pemviz-cut-in-v0", render_mode="rgb_array").unwrapped
    assert isinstance(environment, AbstractEnv)
    check_env(environment)
    environment.close()


def test_a_start_value_can_be_fixed() -> None:
    chosen = (StartChoice("gap", "33"),)
    environment = EncounterEnv(EncounterConfig(logical_scenario="braking"), chosen)
    environment.reset(seed=3)
    assert environment.states.signals["gap_lead"][0] == pytest.approx(33.0)
    assert len(environment.start) == 4


def test_a_film_has_a_frame_for_each_state() -> None:
    _, simulator, detected, start = both("cut-in", draws=1, tracker="none", states=4)
    frames = list(encounter_frames(simulator, detected=detected[0], start=start[0]))
    assert [frame.shape for frame in frames] == [(160, 640, 3)] * 4
    assert all(frame.std() > 0 for frame in frames)  # not black
