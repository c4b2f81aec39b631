"""A car comes upon a standing one that is in view from a random gap on; does it hit it?

It brakes on frames in which it sees the car and measures less than it needs to stop.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import pemviz
from pemviz import BoolArray, FloatArray, LatentCounts, Signal, StateBatch, quantiles


@dataclass(frozen=True)
class StandingCar:
    name: str = "standing-car"
    states: int = 51
    dt_s: float = 0.1
    signals: tuple[Signal, ...] = (
        Signal(name="gap", key="gap_m", unit="m", low=-50.0, high=250.0),
        Signal(name="speed", key="speed_mps", unit="m/s", low=0.0, high=20.0),
    )
    latents = LatentCounts(start=2, noise=1)  # standard normals, for quantiles to map
    starts: tuple[Signal, ...] = (  # what they mean at the start: which starts are dangerous?
        Signal(name="gap", key="gap_m", unit="m", low=40.0, high=90.0),
        Signal(name="speed", key="speed_mps", unit="m/s", low=10.0, high=18.0),
    )
    start_plane: tuple[str, str] = ("gap", "speed")

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:  # start [N, 2]
        gap_m = quantiles.log_normal(start[:, 0], median=60.0, spread=0.1)
        return {"gap": gap_m, "speed": quantiles.normal(start[:, 1], mean=14.0, sd=1.0)}

    def initial(self, *, count: int, start: FloatArray) -> StateBatch:
        signals = self.start_values(start)  # [count] each
        return StateBatch(step=np.zeros((), dtype=np.int64), signals=signals)

    def step(self, states: StateBatch, detected: BoolArray, noise: FloatArray) -> StateBatch:
        gap_m, speed_mps = states.signals["gap"], states.signals["speed"]
        spread_m = 0.5 + 0.05 * np.abs(gap_m)  # of the measured gap: the farther, the worse
        measured_m = quantiles.normal(noise[:, 0], mean=gap_m, sd=spread_m)
        brakes = detected & (measured_m < 6.0 + speed_mps**2 / 6.0)
        signals = {
            "gap": gap_m - speed_mps * self.dt_s,
            "speed": np.maximum(speed_mps - np.where(brakes, 6.0, 0.0) * self.dt_s, 0.0),
        }
        return StateBatch(step=states.step + 1, signals=signals)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        return signals["gap"][..., None]


class Camera:
    def logit(self, salient: FloatArray) -> FloatArray:
        return 1.5 - 0.03 * salient[..., 0]  # the farther, the more it misses


if __name__ == "__main__":
    for method in ("mixture", "splitting"):  # the second checks the first independently
        spec = "always[0,50] (gap >= 0.0)"
        config = pemviz.ExperimentConfig(method=method, spec=spec, rollouts=200, seed=1)
        experiment = pemviz.build_experiment(config, simulator=StandingCar(), pem=Camera())
        worst = pemviz.LeastRobust()
        result = pemviz.run(experiment, observers=[worst])
        print(pemviz.summary_text(result), worst, sep="\n")
