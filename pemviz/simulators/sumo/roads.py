"""A step of many small groups of cars, each on a road of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import ConfigError, RunError
from pemviz.files.shipped import asset_path
from pemviz.simulators.sumo.engine import ENGINE

ROADS = 128
"""In ``assets/sumo/roads.net.xml``."""
ASIDE = 3
"""The lane for taking cars aside: SUMO sorts a lane's cars as they come in, and only then."""
MIDDLE_M = 10_000.0
"""Where on its road a group's first car is; the road is twice as long."""
FARTHEST_M = 9_000.0
"""From there."""
HAVE_MEMORY = ("acc",)
"""Models with variables of their own, which begin anew when a car's type is set."""
OUR_SPEED, SUMOS_SPEED = 32, 31
"""Speed modes: exactly what is set; or as SUMO's drivers do."""
SLOWEST_MPS = 0.001
"""A desired speed: models divide by it."""


@dataclass(frozen=True)
class Group:
    """C cars in each of N groups before a step, arrays ``[C, N]``.

    Attributes:
        front_m: Front bumpers along the road [m].
        lane: 0 is the rightmost of three.
        speed_mps: Along the road.
        set_mps: What SUMO is told as the speed after the step; NaN where its model decides.
        wanted_mps: The speed that a model wants.
    """

    front_m: FloatArray
    lane: IntArray
    speed_mps: FloatArray
    set_mps: FloatArray
    wanted_mps: FloatArray


@dataclass(frozen=True)
class Roads:
    """SUMO's roads for groups of a kind.

    Attributes:
        dt_s: Time step [s].
        models: Of each car, a type in ``assets/sumo/cars.add.xml``.
        lengths_m: Likewise.
    """

    dt_s: float
    models: tuple[str, ...]
    lengths_m: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check that SUMO has such steps.

        Raises:
            ConfigError: It counts milliseconds.
        """
        if abs(round(self.dt_s * 1000) / 1000 - self.dt_s) > 1e-12:
            message = f"dt_s = {self.dt_s:g}: must be whole milliseconds with simulator sumo"
            raise ConfigError(message)

    def step(self, group: Group) -> tuple[FloatArray, FloatArray]:
        """Front bumpers [m] and speeds [m/s] after a step, ``[C, N]`` each.

        Raises:
            ConfigError: libsumo is not installed.
            RunError: SUMO fails, or a car is too far from its group's first.
        """
        from_first_m = group.front_m - group.front_m[0]
        if from_first_m.size and np.abs(from_first_m).max() > FARTHEST_M:
            message = f"SUMO: a car is more than {FARTHEST_M:g} m from the ego, beyond the road"
            raise RunError(message)
        moved_m, speed_mps = np.empty_like(from_first_m), np.empty_like(from_first_m)
        with ENGINE.use(self, self._options()) as (library, anew):
            if anew:
                self._put_cars(library)
            for begin in range(0, group.front_m.shape[1], ROADS):
                rows = slice(begin, begin + ROADS)
                at_m = MIDDLE_M + from_first_m[:, rows]
                reached_m, speed_mps[:, rows] = self._step_roads(library, group, at_m, rows)
                moved_m[:, rows] = reached_m - at_m
        return group.front_m + moved_m, speed_mps

    def _options(self) -> Sequence[str]:
        files = asset_path("sumo", "roads.net.xml"), asset_path("sumo", "cars.add.xml")
        return (
            *("--net-file", str(files[0]), "--additional-files", str(files[1])),
            *("--step-length", f"{self.dt_s:.3f}", "--step-method.ballistic", "true"),
            *("--collision.action", "none", "--time-to-teleport", "-1"),
        )

    def _names(self, road: int) -> list[str]:
        return [f"{road}.{car}" for car in range(len(self.models))]

    def _put_cars(self, library: Any) -> None:
        """All cars on all roads, standing."""
        vehicle = library.vehicle
        for road in range(ROADS):
            library.route.add(f"road{road}", [f"road{road}"])
            for car, name in enumerate(self._names(road)):
                vehicle.add(name, f"road{road}", self.models[car])
                vehicle.moveTo(name, f"road{road}_{ASIDE}", MIDDLE_M)
                vehicle.setLength(name, self.lengths_m[car])
                vehicle.setLaneChangeMode(name, 0)

    def _step_roads(
        self, library: Any, group: Group, at_m: FloatArray, rows: slice
    ) -> tuple[FloatArray, FloatArray]:
        """A step of at most as many groups as there are roads; cars of the others stand."""
        vehicle, used = library.vehicle, at_m.shape[1]
        for road in range(used):
            for name in self._names(road):
                vehicle.moveTo(name, f"road{road}_{ASIDE}", MIDDLE_M)
        for car in range(len(self.models)):
            columns = (group.lane, group.speed_mps, group.set_mps, group.wanted_mps)
            values = zip(at_m[car].tolist(), *(c[car, rows].tolist() for c in columns), strict=True)
            for road, (place_m, lane, speed_mps, set_mps, wanted_mps) in enumerate(values):
                name = f"{road}.{car}"
                vehicle.moveTo(name, f"road{road}_{lane}", place_m)
                if self.models[car] in HAVE_MEMORY:
                    vehicle.setType(name, self.models[car])
                    vehicle.setLength(name, self.lengths_m[car])
                vehicle.setPreviousSpeed(name, speed_mps, 0.0)
                told = set_mps == set_mps  # noqa: PLR0124  NaN: the model decides
                vehicle.setSpeedMode(name, OUR_SPEED if told else SUMOS_SPEED)
                vehicle.setSpeed(name, set_mps if told else -1.0)
                if not told:
                    vehicle.setMaxSpeed(name, max(wanted_mps, SLOWEST_MPS))
            for road in range(used, ROADS):
                name = f"{road}.{car}"
                vehicle.setSpeedMode(name, OUR_SPEED)
                vehicle.setSpeed(name, 0.0)
        library.simulationStep()
        names = [[f"{road}.{car}" for road in range(used)] for car in range(len(self.models))]
        places = [[vehicle.getLanePosition(name) for name in of_car] for of_car in names]
        speeds = [[vehicle.getSpeed(name) for name in of_car] for of_car in names]
        return np.array(places), np.array(speeds)
