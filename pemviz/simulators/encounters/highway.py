"""Encounters of a logical scenario with their cars in highway-env.

highway-env itself is imported when the first road is built, not with this module.
"""

from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np

from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.cars import car_names
from pemviz.simulators.encounters.vectorized import Left, Moved, VectorizedEncounters

if TYPE_CHECKING:
    from pemviz.simulators.highway_env_cars import CarsOnRoad

ROADS_KEPT = 8


@dataclass(frozen=True)
class HighwayEncounters(VectorizedEncounters):
    """The cars of each rollout in turn are put on a road of highway-env, which moves them."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "highway-env"

    def _driven(self, left: Left) -> tuple[Left, Moved]:
        """What is done in the step, and where all cars then are if none touches another."""
        road, places = _road(self.config, get_ident()), self.scene(left.states.signals).of_cars
        does_mps2 = np.concatenate([left.ego_mps2[None], -left.others_mps2]).T.tolist()
        after = [road.moved(*one) for one in zip(places.tolist(), does_mps2, strict=True)]
        x_m, y_m, speed_mps = np.array(after).reshape(len(after), len(self.cars) + 1, 3).T
        return left, Moved(x_m[0], speed_mps[0], x_m[1:], y_m[1:], speed_mps[1:])


def cars_on_road(config: EncounterConfig) -> "CarsOnRoad":
    """The ego and the other cars on an empty road."""
    from pemviz.simulators.highway_env_cars import CarsOnRoad, three_lanes  # noqa: PLC0415  pygame

    lengths_m = [config.car_length_m] * (1 + len(car_names(config)))
    road = three_lanes(config)
    return CarsOnRoad(road, lengths_m=lengths_m, width_m=config.car_width_m, dt_s=config.dt_s)


@lru_cache(maxsize=ROADS_KEPT)
def _road(config: EncounterConfig, thread: int) -> "CarsOnRoad":  # noqa: ARG001
    """A road to work on. Its content outlives no call, so sharing is safe within a thread."""
    return cars_on_road(config)
