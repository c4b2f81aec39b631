"""A gymnasium environment under test: how fast does a robot arm meet the person beside it?

It slows down on frames in which its camera finds the person, and speeds up on the others.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

import pemviz
from pemviz import FloatArray, GymnasiumSimulator, Signal


class ArmBesidePerson(gym.Env[FloatArray, Any]):
    action_space = gym.spaces.Discrete(2)  # 1: the camera found the person; 0: it missed
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    state: FloatArray

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed, options=options)
        self.state = np.array([1.2, 0.8])  # distance [m], speed of the arm [m/s]
        return self.state, {}

    def step(self, action: int) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        distance_m, speed_mps = self.state
        later_mps = np.clip(speed_mps + (-3.0 if action else 1.0) * 0.02, 0.0, 0.8)
        self.state = np.array([distance_m - (speed_mps + 0.8) * 0.02, later_mps])
        return self.state, 0.0, bool(self.state[0] < 0.1), False, {}


class PersonCamera:  # the nearer the person, the more the arm hides
    def logit(self, salient: FloatArray) -> FloatArray:
        return 1.5 * salient[..., 0]


def observe(observation: FloatArray) -> Mapping[str, float]:
    return {"distance": observation[0], "speed": observation[1]}


def set_state(arm: ArmBesidePerson, numbers: FloatArray) -> None:
    arm.state = numbers


if __name__ == "__main__":
    simulator = GymnasiumSimulator(
        environment=ArmBesidePerson(), observe=observe, states=71, dt_s=0.02, name="arm",
        signals=(
            Signal(name="distance", key="distance_m", unit="m", low=-3.0, high=3.0),
            Signal(name="speed", key="speed_mps", unit="m/s", low=-1.0, high=1.0),
        ),
        get_state=lambda arm: arm.state, set_state=set_state,
    )  # fmt: skip
    spec = "always[0,70] (distance >= 0.1 or speed <= 0.25)"
    config = pemviz.ExperimentConfig(method="mixture", spec=spec, rollouts=200, seed=1)
    worst = pemviz.LeastRobust()
    experiment = pemviz.build_experiment(config, simulator=simulator, pem=PersonCamera())
    print(pemviz.summary_text(pemviz.run(experiment, observers=[worst])), worst, sep="\n")
