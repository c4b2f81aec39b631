"""An encounter's cars on a road of highway-env; this module imports highway-env, and pygame."""

from typing import Any

import numpy as np
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from pemviz.arrays import FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.braking.highway_env_scenario import EGO_RGB, LEAD_RGB, ScriptedCar


class CarsOnRoad:
    """The ego and the other cars of an encounter, the ego first; highway-env's y grows right."""

    def __init__(self, config: EncounterConfig, others: int) -> None:
        """Put them on three lanes, as long as an encounter can need."""
        self.dt_s, self.road = config.dt_s, _road(config)
        size = {"length_m": config.car_length_m, "width_m": config.car_width_m}
        colors = (EGO_RGB, *(LEAD_RGB for _ in range(others)))
        self.cars = [ScriptedCar(self.road, **size, color=color) for color in colors]
        self.road.vehicles = list[Vehicle](self.cars)

    def put(self, places: FloatArray) -> None:
        """Put all cars into places ``[C, 4]``; see :attr:`SceneStates.of_cars`."""
        for car, (x_m, y_m, heading_rad, speed_mps) in zip(self.cars, places.tolist(), strict=True):
            car.position = np.array([x_m, -y_m])
            car.heading, car.speed = -heading_rad, speed_mps

    def moved(self, places: FloatArray, does_mps2: FloatArray) -> list[tuple[float, float, float]]:
        """Places x and y [m] and speeds [m/s], a step after places ``[C, 4]``.

        All cars keep accelerations ``[C]``.
        """
        self.put(places)
        for car, acceleration_mps2 in zip(self.cars, does_mps2.tolist(), strict=True):
            car.accelerate(acceleration_mps2)
        self.road.step(self.dt_s)
        return [(car.position[0], -car.position[1], car.speed) for car in self.cars]


def _road(config: EncounterConfig) -> Road:
    """Three lanes, as long as an encounter can need."""
    length_m, network = 20_000.0, RoadNetwork()
    sides = (LineType.STRIPED, LineType.CONTINUOUS_LINE)
    for lane in (-1, 0, 1):
        left, right = sides[lane == -1], sides[lane == 1]
        y_m = lane * config.lane_width_m
        types: Any = (left, right)
        ends = [-length_m, y_m], [length_m, y_m]
        lane_of = StraightLane(*ends, width=config.lane_width_m, line_types=types)
        network.add_lane("start", "end", lane_of)
    return Road(network=network)
