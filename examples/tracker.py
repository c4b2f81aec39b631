"""A cart brakes for a person that its tracker follows; how likely does it hit the person?

Confirmed by 2 detections of 3, a track coasts for 0.3 s and tells distance and approach.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

import pemviz
from pemviz import BoolArray, FloatArray, Kalman, Signal, StateBatch, Tracker

TRACKER = Tracker(
    dt_s=0.1, hits=2, window=3, coast_s=0.3, axes=1, filter=Kalman(position_sd_m=0.2)
)  # fmt: skip


@dataclass(frozen=True)
class CartAndPerson:
    name: str = "cart-and-person"
    states: int = 41
    dt_s: float = 0.1
    tracker: Tracker = TRACKER  # that it holds one is all that proposals need to look at tracks
    signals: tuple[Signal, ...] = (
        Signal(name="distance", key="distance_m", unit="m", low=-12.0, high=12.0),
        Signal(name="speed", key="speed_mps", unit="m/s", low=0.0, high=4.0),
    )

    def initial(self, *, count: int) -> StateBatch:
        start = {"distance": np.full(count, 9.0), "speed": np.full(count, 3.0)}
        tracks = self.tracker.memory(self.tracker.start(count))  # lie in the states' memory
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=start, memory=tracks)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        distance_m, speed_mps = states.signals["distance"], states.signals["speed"]
        before = self.tracker.state(states.memory)
        track = self.tracker.update(before, detected, distance_m)
        ahead_m, approach_mps = track.position_m[:, 0], -track.speed_mps[:, 0]
        near = track.confirmed & (ahead_m < 1.0 + approach_mps**2 / 3.0)  # stops with 1.5 m/s^2
        after_mps = speed_mps + np.where(near, -1.5, 0.5) * self.dt_s
        later = {
            "distance": distance_m - speed_mps * self.dt_s,
            "speed": np.clip(after_mps, 0.0, 3.0),
        }
        return replace(
            states, step=states.step + 1, signals=later, memory=self.tracker.memory(track)
        )

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return signals["distance"][..., None]


class PersonCamera:
    def logit(self, salient: FloatArray) -> FloatArray:
        return 3.5 - 0.25 * salient[..., 0]  # the farther, the more it misses


if __name__ == "__main__":
    for method in ("mixture", "splitting"):  # the second checks the first independently
        spec = "always[0,40] (distance >= 0.0)"
        config = pemviz.ExperimentConfig(method=method, spec=spec, rollouts=300, seed=2)
        experiment = pemviz.build_experiment(config, simulator=CartAndPerson(), pem=PersonCamera())
        worst = pemviz.LeastRobust()
        print(pemviz.summary_text(pemviz.run(experiment, observers=[worst])), worst, sep="\n")
