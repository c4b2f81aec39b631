"""The braking scenario with its cars in highway-env.

highway-env itself is imported when the first road is built, not with this module.
"""

from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import (
    CAR_WIDTH_M,
    EGO_LENGTH_M,
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
)
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import StateBatch

if TYPE_CHECKING:
    from pemviz.simulators.highway_env_cars import CarsOnRoad

ROADS_KEPT = 8


@dataclass(frozen=True)
class HighwaySimulator(VectorizedSimulator):
    """The cars of each rollout in turn are put on a road of highway-env, which moves them."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "highway-env"

    def places(self, states: StateBatch) -> list[list[list[float]]]:
        """Where both cars of N rollouts are: x, y [m], heading [rad] and speed [m/s].

        The lead car's x is the gap, which is thereby read back to the last digit.
        """
        gap_m, ego_mps, lead_mps = (states.signals[n] for n in (GAP, EGO_SPEED, LEAD_SPEED))
        none, ego_m = np.zeros_like(gap_m), np.full_like(gap_m, -self._between_m)
        ego, lead = ([x_m, none, none, v] for x_m, v in ((ego_m, ego_mps), (gap_m, lead_mps)))
        return np.moveaxis(np.array([ego, lead]), -1, 0).tolist()

    @property
    def _between_m(self) -> float:
        """Between the cars' centres where the gap is 0 [m]."""
        return EGO_LENGTH_M / 2 - CAMERA_TO_BUMPER_M + self.config.lead_length_m / 2

    def _driven(
        self, states: StateBatch, ego_mps2: FloatArray, lead_mps2: FloatArray
    ) -> dict[str, FloatArray]:
        """The signals a step on."""
        road = _road(self.config, get_ident())
        does_mps2 = np.stack(np.broadcast_arrays(ego_mps2, lead_mps2), axis=-1).tolist()
        after = [road.moved(*one) for one in zip(self.places(states), does_mps2, strict=True)]
        x_m, _, speed_mps = np.array(after).reshape(len(after), 2, 3).T
        gap_m = x_m[1] - (x_m[0] + self._between_m)
        return {GAP: gap_m, EGO_SPEED: speed_mps[0], LEAD_SPEED: speed_mps[1]}


def cars_on_road(config: ScenarioConfig) -> "CarsOnRoad":
    """Both cars on an empty lane."""
    from pemviz.simulators.highway_env_cars import CarsOnRoad, straight_road  # noqa: PLC0415  pygame

    lengths_m = EGO_LENGTH_M, config.lead_length_m
    road = straight_road(config)
    return CarsOnRoad(road, lengths_m=lengths_m, width_m=CAR_WIDTH_M, dt_s=config.dt_s)


@lru_cache(maxsize=ROADS_KEPT)
def _road(config: ScenarioConfig, thread: int) -> "CarsOnRoad":  # noqa: ARG001
    """A road to work on. Its content outlives no call, so sharing is safe within a thread."""
    return cars_on_road(config)
