"""Encounters of a logical scenario with SUMO's own drivers in the other cars."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.config.settings import SumoConfig
from pemviz.simulators.encounters.arrival import Left, Moved
from pemviz.simulators.encounters.cars import LARGEST_SINE, lateral_places
from pemviz.simulators.encounters.names import (
    COLLIDED,
    EGO_SPEED,
    EGO_X,
    SPEED,
    by_car,
    of_cars,
)
from pemviz.simulators.encounters.vectorized import KEPT_START, VectorizedEncounters
from pemviz.simulators.sumo.roads import Group, Roads
from pemviz.types import StateBatch

WANTED = f"{KEPT_START}speed"
"""Memory: the speed that each car starts with, and wants."""


@dataclass(frozen=True)
class SumoEncounters(VectorizedEncounters):
    """As ``pemviz.simulators.sumo`` says; the rest is the vectorized back end's.

    Attributes:
        sumo: By which model other cars drive.
    """

    sumo: SumoConfig = field(default_factory=SumoConfig)

    @property
    def name(self) -> str:
        """Back end's name."""
        return "sumo"

    @cached_property
    def roads(self) -> Roads:
        """Where SUMO steps."""
        models = ("ego", *(self.sumo.model for _ in self.cars))
        return Roads(self.config.dt_s, models, (self.config.car_length_m,) * len(models))

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The states s_0, arrays ``[count]``, for standard normals ``[count, S]`` or medians."""
        states = super().initial(count=count, start=start)
        wanted = by_car(WANTED, self.cars, of_cars(SPEED, self.cars, states.signals))
        return replace(states, memory={**states.memory, **wanted})

    def _driven(self, left: Left) -> tuple[Left, Moved]:
        """What is done in the step, and where all cars then are if none touches another."""
        dt_s, signals = self.config.dt_s, left.states.signals
        gap_m, aside_m, speed_mps, heading_rad = left.each
        ego_m, ego_mps = signals[EGO_X], signals[EGO_SPEED]
        x_m = ego_m + gap_m + self.config.car_length_m
        along_mps = left.along_mps
        reached_m, reached_mps = self.roads.step(
            Group(
                front_m=np.concatenate([ego_m[None], x_m]) + self.config.car_length_m / 2,
                lane=np.concatenate([np.ones((1, ego_m.size), dtype=np.int64), self._lanes(left)]),
                speed_mps=np.concatenate([ego_mps[None], along_mps]),
                set_mps=np.concatenate(
                    [(ego_mps + left.ego_mps2 * dt_s).clip(0.0)[None], self._told(left, along_mps)]
                ),
                wanted_mps=np.concatenate([ego_mps[None], self._wanted(left)]),
            )
        )
        y_m = aside_m + speed_mps * np.sin(heading_rad) * dt_s
        driven = replace(left, others_mps2=(along_mps - reached_mps[1:]) / dt_s)
        centres_m = reached_m - self.config.car_length_m / 2
        return driven, Moved(
            ego_x_m=centres_m[0],
            ego_mps=reached_mps[0],
            x_m=centres_m[1:],
            y_m=y_m,
            speed_mps=self._over_ground(left, y_m, reached_mps[1:]),
        )

    def _lanes(self, left: Left) -> IntArray:
        """In which lane of SUMO's each car has its centre, ``[K, N]``."""
        lane = np.rint(left.each.aside_m / self.config.lane_width_m).astype(np.int64)
        return lane.clip(-1, 1) + 1

    def _wanted(self, left: Left) -> FloatArray:
        """The speeds that drivers want, ``[K, N]``."""
        return of_cars(WANTED, self.cars, left.states.memory)

    def _told(self, left: Left, along_mps: FloatArray) -> FloatArray:
        """Speeds after the step that SUMO is told, ``[K, N]``; NaN where its model decides."""
        braked = np.where(
            left.others_mps2 > 0.0,
            (along_mps - left.others_mps2 * self.config.dt_s).clip(0.0),
            np.nan,
        )
        stands = (left.states.signals[COLLIDED] > 0.0) & (along_mps == 0.0)
        return np.where(stands | (self._wanted(left) == 0.0), 0.0, braked)

    def _over_ground(self, left: Left, y_m: FloatArray, along_mps: FloatArray) -> FloatArray:
        """Speeds that along the road are SUMO's once the profile turns the cars, ``[K, N]``."""
        dt_s = self.config.dt_s
        time_s = (float(left.states.step) + 2.0) * dt_s
        aside_mps = (lateral_places(self.config, left.values, time_s=time_s) - y_m) / dt_s
        most_mps = along_mps * LARGEST_SINE / np.sqrt(1.0 - LARGEST_SINE**2)
        return np.hypot(along_mps, aside_mps.clip(-most_mps, most_mps))
