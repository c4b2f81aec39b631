"""Films of systems of the user's own: their pictures of the least robust rollout, by state."""

import logging
from io import BytesIO

import gymnasium as gym
import numpy as np
import PIL.Image
import pytest

import pemviz
from pemviz.recording import paths
from tests.lattice_walk import ToyPem, ToySimulator
from tests.recording.conftest import record
from tests.recording.read_back import chunks, entities

TOY = ToySimulator(initial_gap=2, largest_gap=6, states=11)
CONFIG = pemviz.ExperimentConfig(
    method="naive", spec="always[0,10] (gap >= 0.5)", final_rollouts=40, plan=False
)
GREY_A_METRE = 40


class DrawnWalk(gym.Env):
    """The toy's walk; a picture is as bright as the gap is wide, and the episode ends at 0."""

    action_space = gym.spaces.Discrete(2)
    observation_space = gym.spaces.Box(-10.0, 10.0, (1,), np.float64)
    gap = 0.0

    def __init__(self, render_mode="rgb_array", picture=np.uint8):
        self.render_mode, self.picture = render_mode, picture

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.gap = float(TOY.initial_gap)
        return np.array([self.gap]), {}

    def step(self, action):
        self.gap = min(self.gap + (1.0 if action else -1.0), float(TOY.largest_gap))
        return np.array([self.gap]), 0.0, self.gap <= 0.0, False, {}

    def render(self):
        return np.full((24, 32, 3), GREY_A_METRE * self.gap, dtype=self.picture)


def episodes(environment):
    return pemviz.GymnasiumEpisodes(
        environment=environment,
        signals=TOY.signals,
        observe=lambda observation: {"gap": observation[0]},
        states=TOY.states,
        dt_s=1.0,
        name="walk",
    )


def recorded(tmp_path, simulator):
    experiment = pemviz.build_experiment(CONFIG, simulator=simulator, pem=ToyPem(at_zero=0.0))
    return record(experiment, tmp_path, frames=True)


def brightness(path):
    pictures = [one for one in chunks(path) if one.entity_path == paths.FRAMES]
    rows = [one.to_record_batch()["EncodedImage:blob"] for one in pictures if not one.is_static]
    return [
        np.asarray(PIL.Image.open(BytesIO(bytes(one[0]))).convert("L")).mean()
        for row in rows
        for one in row.to_pylist()
    ]


def test_a_gymnasium_environment_draws_the_least_robust_rollout(tmp_path):
    simulator = pemviz.side_by_side(lambda: episodes(DrawnWalk()))
    run = recorded(tmp_path, simulator)
    ranked, (stage,) = run.result.least_robust[0], run.stages
    gaps = stage.scored.rollouts.signals["gap"][ranked.rollout]
    ended = np.flatnonzero(gaps <= 0.0)[0] + 1
    assert ended < TOY.states
    np.testing.assert_allclose(brightness(run.path), GREY_A_METRE * gaps[:ended], atol=3.0)


@pytest.mark.parametrize("fault", ["other mode", "behind a tracker"])
def test_what_cannot_be_drawn_has_no_film(tmp_path, fault):
    if fault == "other mode":
        simulator = pemviz.side_by_side(lambda: episodes(DrawnWalk(render_mode=None)))
    else:
        tracker = pemviz.Tracker(dt_s=1.0, hits=1, window=1)
        simulator = pemviz.tracked(pemviz.side_by_side(lambda: episodes(DrawnWalk())), tracker)
    run = recorded(tmp_path, simulator)
    assert paths.FRAMES not in entities(run.path)


def test_pictures_that_are_none_cost_the_film_alone(tmp_path, caplog):
    simulator = pemviz.side_by_side(lambda: episodes(DrawnWalk(picture=np.float64)))
    with caplog.at_level(logging.WARNING):
        run = recorded(tmp_path, simulator)
    assert run.result.status == "done"
    assert paths.FRAMES not in entities(run.path)
    assert "no film: pictures of walk fail" in caplog.text
    assert "float64" in caplog.text
