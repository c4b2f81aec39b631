"""A drone hovers 2 m from a wall in wind; how likely does it come within 0.3 m of it?

It holds its distance on frames in which its camera sees the wall, and drifts on the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import pemviz
from pemviz import BoolArray, FloatArray, Signal, StateBatch


@dataclass(frozen=True)
class DroneAtWall:  # a pemviz.Simulator; no base class is needed
    name: str = "drone-at-wall"
    states: int = 61
    dt_s: float = 0.1
    signals: tuple[Signal, ...] = (  # name in the specification, key in files, unit, bounds
        Signal(name="distance", key="distance_m", unit="m", low=-20.0, high=20.0),
        Signal(name="approach", key="approach_mps", unit="m/s", low=-20.0, high=20.0),
    )

    def initial(self, *, count: int) -> StateBatch:
        start = {"distance": np.full(count, 2.0), "approach": np.zeros(count)}
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=start)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        distance_m, approach_mps = states.signals["distance"], states.signals["approach"]
        wanted_mps2 = np.clip(2.0 * (distance_m - 2.0) - 2.5 * approach_mps, -3.0, 1.0)
        total_mps2 = np.where(detected, wanted_mps2, 0.0) + 0.8  # wind, towards the wall
        later = {
            "distance": distance_m - approach_mps * self.dt_s,
            "approach": approach_mps + total_mps2 * self.dt_s,
        }
        return StateBatch(step=states.step + 1, signals=later)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return signals["distance"][..., None]  # what the camera's answer depends on


@dataclass(frozen=True)
class WallCamera:  # a detector model: anything with logit, the log odds of 'detected'
    logit_at_wall: float = -0.5

    def logit(self, salient: FloatArray) -> FloatArray:
        return self.logit_at_wall + 1.5 * salient[..., 0]  # the nearer, the more it misses


if __name__ == "__main__":
    for method in ("mixture", "splitting"):  # the second checks the first independently
        spec = "always[0,60] (distance >= 0.3)"
        config = pemviz.ExperimentConfig(method=method, spec=spec, rollouts=200, seed=1)
        experiment = pemviz.build_experiment(config, simulator=DroneAtWall(), pem=WallCamera())
        worst = pemviz.LeastRobust()
        result = pemviz.run(experiment, observers=[worst])
        print(pemviz.summary_text(result), worst, sep="\n")
