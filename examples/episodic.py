"""A black box that can only be reset and stepped: how likely does a cart pass the end of its rail?

Its controller and its motion are its own; it is told whether the end switch was seen.
"""

from collections.abc import Mapping
from typing import Any

import pemviz
from pemviz import FloatArray, Signal


class CartOnRail:  # a pemviz.EpisodicSimulator; no base class is needed
    name = "cart-on-rail"
    states = 51
    dt_s = 0.1
    signals = (
        Signal(name="room", key="room_m", unit="m", low=-5.0, high=5.0),
        Signal(name="speed", key="speed_mps", unit="m/s", low=0.0, high=2.0),
    )
    steps = 0  # of all carts

    def reset(self) -> Mapping[str, float]:
        self._room_m, self._speed_mps, self._slow_for = 4.0, 1.2, 0
        return self._signals()

    def step(self, detected: bool) -> tuple[Mapping[str, float], bool]:
        CartOnRail.steps += 1
        self._slow_for = 4 if detected and self._room_m < 2.5 else max(self._slow_for - 1, 0)
        self._room_m -= self._speed_mps * self.dt_s
        change_mps = -0.08 if self._slow_for else 0.04
        self._speed_mps = min(max(self._speed_mps + change_mps, 0.0), 1.2)
        return self._signals(), self._room_m < -0.5  # then it has fallen off

    def _signals(self) -> Mapping[str, float]:
        return {"room": self._room_m, "speed": self._speed_mps}

    def salient(self, signals: Mapping[str, Any]) -> FloatArray:
        return signals["room"][..., None]


class SwitchCamera:
    def logit(self, salient: FloatArray) -> FloatArray:
        return 1.5 - 0.6 * salient[..., 0]  # the farther, the more it misses


if __name__ == "__main__":
    config = pemviz.ExperimentConfig(
        method="mixture", spec="always[0,50] (room >= 0.0)", rollouts=200, final_rollouts=200
    )
    carts = pemviz.side_by_side(CartOnRail, 20)  # 20 rollouts at a time
    experiment = pemviz.build_experiment(config, simulator=carts, pem=SwitchCamera())
    worst, before = pemviz.LeastRobust(), CartOnRail.steps
    result = pemviz.run(experiment, observers=[worst])
    print(pemviz.summary_text(result), worst, sep="\n")
    print(f"environment steps: {CartOnRail.steps - before}")  # at most 50 a rollout
