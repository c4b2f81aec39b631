"""The braking scenario and logical scenarios, with their cars in SUMO."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.settings import SumoConfig
from pemviz.simulators.braking import scenario as braking
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.encounters.cars import LARGEST_SINE, lateral_places
from pemviz.simulators.encounters.encounter_signals import (
    COLLIDED,
    EGO_SPEED,
    EGO_X,
    SPEED,
    by_car,
    of_cars,
)
from pemviz.simulators.encounters.vectorized import KEPT_START, Left, Moved, VectorizedEncounters
from pemviz.simulators.sumo.engine import Group, Roads
from pemviz.types import StateBatch

WANTED = f"{KEPT_START}speed"
"""Memory: the speed that each car starts with, and wants."""


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
        lengths_m = braking.EGO_LENGTH_M, self.config.lead_length_m
        return Roads(self.config.dt_s, ("ego", "ego"), lengths_m)

    def _driven(
        self, states: StateBatch, ego_mps2: FloatArray, lead_mps2: FloatArray
    ) -> dict[str, FloatArray]:
        """The signals a step on."""
        after = super()._driven(states, ego_mps2, lead_mps2)
        length_m = self.config.lead_length_m
        gap_m = states.signals[braking.GAP]
        lead_m = gap_m - CAMERA_TO_BUMPER_M + length_m
        before_mps, after_mps = (
            np.stack([signals[braking.EGO_SPEED], signals[braking.LEAD_SPEED]])
            for signals in (states.signals, after)
        )
        front_m, speed_mps = self.roads.step(
            Group(
                front_m=np.stack([np.zeros_like(gap_m), lead_m]),
                lane=np.ones(before_mps.shape, dtype=np.int64),
                speed_mps=before_mps,
                set_mps=after_mps,
                wanted_mps=after_mps,
            )
        )
        return {
            braking.GAP: front_m[1] - front_m[0] - length_m + CAMERA_TO_BUMPER_M,
            braking.EGO_SPEED: speed_mps[0],
            braking.LEAD_SPEED: speed_mps[1],
        }


@dataclass(frozen=True)
class SumoEncounters(VectorizedEncounters):
    """Encounters with SUMO's own drivers in the other cars, as ``pemviz.simulators.sumo`` says.

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
        config, dt_s, signals = self.config, self.config.dt_s, left.states.signals
        cars, along_mps = left.cars, left.cars.along_mps
        ego_m, ego_mps = signals[EGO_X], signals[EGO_SPEED]
        lane = np.rint(cars.aside_m / config.lane_width_m).astype(np.int64).clip(-1, 1) + 1
        wanted_mps = of_cars(WANTED, self.cars, left.states.memory)
        braked_mps = (along_mps - left.others_mps2 * dt_s).clip(0.0)
        given_mps = np.where(left.others_mps2 > 0.0, braked_mps, np.nan)  # NaN: the model decides
        stands = (signals[COLLIDED] > 0.0) & (along_mps == 0.0)
        given_mps = np.where(stands | (wanted_mps == 0.0), 0.0, given_mps)
        ego_after_mps = (ego_mps + left.ego_mps2 * dt_s).clip(0.0)
        x_m = ego_m + cars.gap_m + config.car_length_m
        reached_m, reached_mps = self.roads.step(
            Group(
                front_m=np.concatenate([ego_m[None], x_m]) + config.car_length_m / 2,
                lane=np.concatenate([np.ones((1, ego_m.size), dtype=np.int64), lane]),
                speed_mps=np.concatenate([ego_mps[None], along_mps]),
                set_mps=np.concatenate([ego_after_mps[None], given_mps]),
                wanted_mps=np.concatenate([ego_mps[None], wanted_mps]),
            )
        )
        centres_m = reached_m - config.car_length_m / 2
        y_m = cars.aside_m + cars.speed_mps * np.sin(cars.heading_rad) * dt_s
        driven = replace(left, others_mps2=(along_mps - reached_mps[1:]) / dt_s)
        return driven, Moved(
            ego_x_m=centres_m[0],
            ego_mps=reached_mps[0],
            x_m=centres_m[1:],
            y_m=y_m,
            speed_mps=self._over_ground(left, y_m, reached_mps[1:]),
        )

    def _over_ground(self, left: Left, y_m: FloatArray, along_mps: FloatArray) -> FloatArray:
        """Speeds that along the road are SUMO's once the profile turns the cars, ``[K, N]``."""
        dt_s = self.config.dt_s
        time_s = (float(left.states.step) + 2.0) * dt_s
        aside_mps = (lateral_places(self.config, left.values, time_s=time_s) - y_m) / dt_s
        most_mps = along_mps * LARGEST_SINE / np.sqrt(1.0 - LARGEST_SINE**2)
        return np.hypot(along_mps, aside_mps.clip(-most_mps, most_mps))
