"""SUMO in this process, and a step of many small groups of cars in it, each on its own road.

There is one SUMO in a process, and whoever needs it loads what is theirs. libsumo is imported when
it is first needed: it is an extra, and takes most of a second. Traffic of a user's own runs in a
process of its own (:mod:`pemviz.simulators.sumo.traffic`).
"""

import os
from collections.abc import Generator, Hashable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from threading import RLock
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import ConfigError, RunError
from pemviz.files.shipped import asset_path

QUIET = "LIBSUMO_AS_TRACI"
"""Environment variable: with the value ``quiet`` libsumo prints nothing when it is imported."""
QUIET_OPTIONS = ("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true")
OUR_SPEED, SUMOS_SPEED = 32, 31
"""Speed modes: exactly what is set; or as SUMO's drivers do."""
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
SLOWEST_MPS = 0.001
"""A desired speed: models divide by it."""


def is_installed() -> bool:
    """Whether libsumo is there."""
    return find_spec("libsumo") is not None


def check_installed() -> None:
    """Refuse SUMO where libsumo is not there.

    Raises:
        ConfigError: Says how to install it.
    """
    if not is_installed():
        install = "pip install 'pemviz[sumo]'"
        message = f"simulator = 'sumo': needs libsumo; install it with {install}"
        raise ConfigError(message)


class Engine:
    """The process's simulation."""

    def __init__(self) -> None:
        self.lock = RLock()
        self.owner: Hashable = None
        self.library: Any = None

    @contextmanager
    def use(self, owner: Hashable, options: Sequence[str]) -> Generator[tuple[Any, bool]]:
        """Have the simulation to oneself: libsumo, and whether it was loaded anew, by ``options``.

        An owner that still has it finds it as left.

        Raises:
            ConfigError: libsumo is not installed.
            RunError: SUMO does not start, or refuses something meanwhile; it is then closed.
        """
        with self.lock:
            library = self._imported()
            try:
                anew = self.owner != owner
                if anew:
                    self.close()
                    library.start(["sumo", *QUIET_OPTIONS, *options])
                    self.owner = owner
                yield library, anew
            except (library.TraCIException, library.FatalTraCIError) as error:
                self.close()
                words = " ".join(str(error).split()) or type(error).__name__
                message = f"SUMO: {words}"
                raise RunError(message) from error

    def close(self) -> None:
        """End the simulation, if there is one."""
        if self.owner is not None:
            self.owner = None
            self.library.close()

    def _imported(self) -> Any:
        if self.library is None:
            check_installed()
            before = os.environ.get(QUIET)
            os.environ[QUIET] = "quiet"
            try:
                import libsumo  # noqa: PLC0415  an extra
            finally:
                if before is None:
                    del os.environ[QUIET]
                else:
                    os.environ[QUIET] = before
            self.library = libsumo
        return self.library


ENGINE = Engine()


@dataclass(frozen=True)
class Group:
    """C cars in each of N groups before a step, arrays ``[C, N]``.

    Attributes:
        front_m: Front bumpers along the road [m].
        lane: 0 is the rightmost of three.
        speed_mps: Along the road.
        set_mps: The speed after the step that SUMO is given; NaN where its model decides.
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
        network, cars = asset_path("sumo", "roads.net.xml"), asset_path("sumo", "cars.add.xml")
        options = (
            *("--net-file", str(network), "--additional-files", str(cars)),
            *("--step-length", f"{self.dt_s:.3f}", "--step-method.ballistic", "true"),
            *("--collision.action", "none", "--time-to-teleport", "-1"),
        )
        with ENGINE.use(self, options) as (library, anew):
            if anew:
                self._put_cars(library)
            for begin in range(0, group.front_m.shape[1], ROADS):
                rows = slice(begin, begin + ROADS)
                at_m = MIDDLE_M + from_first_m[:, rows]
                reached_m, speed_mps[:, rows] = self._step_roads(library, group, at_m, rows)
                moved_m[:, rows] = reached_m - at_m
        return group.front_m + moved_m, speed_mps

    def _put_cars(self, library: Any) -> None:
        """All cars on all roads, standing."""
        vehicle = library.vehicle
        for road in range(ROADS):
            library.route.add(f"road{road}", [f"road{road}"])
            for car in range(len(self.models)):
                name = f"{road}.{car}"
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
            for car in range(len(self.models)):
                vehicle.moveTo(f"{road}.{car}", f"road{road}_{ASIDE}", MIDDLE_M)
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
                given = set_mps == set_mps  # noqa: PLR0124  NaN: the model decides
                vehicle.setSpeedMode(name, OUR_SPEED if given else SUMOS_SPEED)
                vehicle.setSpeed(name, set_mps if given else -1.0)
                if not given:
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
