"""The braking scenario with both cars in SUMO."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import EGO_LENGTH_M, EGO_SPEED, GAP, LEAD_SPEED
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.sumo.roads import Group, Roads
from pemviz.types import StateBatch

BOTH_SCRIPTED = ("ego", "ego")


@dataclass(frozen=True)
class SumoBraking(VectorizedSimulator):
    """Speeds as the vectorized back end has them, places by SUMO's ballistic steps."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "sumo"

    @cached_property
    def roads(self) -> Roads:
        """Where SUMO steps."""
        return Roads(self.config.dt_s, BOTH_SCRIPTED, (EGO_LENGTH_M, self.config.lead_length_m))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states one time step on, for outcomes ``[N]`` and, with errors, noise ``[N, 1]``."""
        after = super().step(states, detected, noise)
        gap_m = states.signals[GAP]
        fronts_m = (np.zeros_like(gap_m), gap_m - CAMERA_TO_BUMPER_M + self.config.lead_length_m)
        speeds = [np.stack([s.signals[EGO_SPEED], s.signals[LEAD_SPEED]]) for s in (states, after)]
        front_m, speed_mps = self.roads.step(
            Group(
                front_m=np.stack(fronts_m),
                lane=np.ones(speeds[0].shape, dtype=np.int64),
                speed_mps=speeds[0],
                set_mps=speeds[1],
                wanted_mps=speeds[1],
            )
        )
        gap_m = front_m[1] - front_m[0] - self.config.lead_length_m + CAMERA_TO_BUMPER_M
        signals = {GAP: gap_m, EGO_SPEED: speed_mps[0], LEAD_SPEED: speed_mps[1]}
        return StateBatch(step=after.step, signals=signals, memory=after.memory)
