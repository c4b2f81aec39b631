"""One episode after the other in the SUMO of this process; runs where :mod:`host` starts it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pemviz.simulators.sumo.traffic.facts import (
    NOBODY_M,
    OF_EGO,
    OTHERS,
    RECOVERY_S,
    SLOTS,
    TrafficSettings,
)
from pemviz.simulators.sumo.traffic.places import (
    Body,
    Car,
    leader_of,
    perceived,
    pictured,
    safety_margin_m,
    seen_from,
)

LATEST_S = 3600.0
"""Of SUMO's time: by then the ego has to have entered."""
AROUND_M = 130.0
COLLIDED = OF_EGO.index("collided")
ROUNDING_S = 1e-6
OUR_SPEED, SUMOS_SPEED = 32, 31
"""Speed modes: exactly what is set; or as SUMO's drivers do."""
HELD = ("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true",
        "--collision.action", "none")  # fmt: skip


@dataclass(frozen=True)
class Before:
    """What a step is compared with.

    Attributes:
        ego_mps: The ego's speed.
        leader: The car ahead in the path.
        leader_mps: Its speed.
        margin_m: The gap to it less its safe distance.
        led_s: For how long it has been there.
    """

    ego_mps: float
    leader: str | None
    leader_mps: float
    margin_m: float
    led_s: float


class Episode:
    """SUMO with the ego in it."""

    def __init__(self, library: Any, settings: TrafficSettings) -> None:
        """Nothing is loaded yet.

        Args:
            library: libsumo.
            settings: What is loaded.
        """
        self._sumo, self._settings = library, settings
        self._started = False
        self._sizes: dict[str, tuple[float, float]] = {}
        self._slots: list[str | None] = [None] * len(SLOTS)
        self._others: list[str | None] = [None] * len(OTHERS)
        self._begun_m = 0.0
        self._before: Before | None = None
        self._values: list[float] = []

    def reset(self, seed: int) -> list[float]:
        """Begin with SUMO's seed; the signals, in order.

        Raises:
            LookupError: The ego does not enter, or leaves before the rollout begins.
            Exception: libsumo's own.
        """
        self._load(seed)
        sumo, ego = self._sumo, self._settings.ego
        while ego not in sumo.vehicle.getIDList():
            over = sumo.simulation.getTime() > LATEST_S
            if over or sumo.simulation.getMinExpectedNumber() <= 0:
                raise LookupError(f"no vehicle {ego!r} enters; which one is the ego? (sumo.ego)")
            sumo.simulationStep()
        sumo.vehicle.setLaneChangeMode(ego, 0)
        for _ in range(round(self._settings.warm_up_s / self._settings.step_s)):
            sumo.simulationStep()
        if ego not in sumo.vehicle.getIDList():
            raise LookupError(f"the ego {ego!r} leaves before its rollout begins (sumo.warm_up_s)")
        constants = sumo.constants
        of_each = [constants.VAR_POSITION, constants.VAR_ANGLE, constants.VAR_SPEED]
        about = constants.CMD_GET_VEHICLE_VARIABLE
        sumo.vehicle.subscribeContext(ego, about, AROUND_M, of_each)
        sumo.vehicle.setSpeedMode(ego, OUR_SPEED)
        self._begun_m, self._before = sumo.vehicle.getDistance(ego), None
        self._slots, self._others = [None] * len(SLOTS), [None] * len(OTHERS)
        self._values = self._told()
        return self._values

    def step(self, acceleration_mps2: float) -> tuple[list[float], bool]:
        """The signals after a step with the ego's acceleration, and whether the episode has ended.

        Raises:
            Exception: libsumo's own.
        """
        sumo, ego = self._sumo, self._settings.ego
        speed_mps = sumo.vehicle.getSpeed(ego) + acceleration_mps2 * self._settings.step_s
        sumo.vehicle.setSpeed(ego, max(speed_mps, 0.0))
        sumo.simulationStep()
        if ego not in sumo.vehicle.getIDList():  # its route is over
            return self._values, True
        self._values = self._told()
        return self._values, self._values[COLLIDED] > 0.0

    def _load(self, seed: int) -> None:
        settings = self._settings
        options = ["-c", settings.config, "--seed", str(seed), *HELD]
        options += ["--step-length", f"{settings.step_s:.3f}"]
        if self._started:
            self._sumo.load(options)
        else:
            self._sumo.start(["sumo", *options])
            self._started = True
        self._sizes.clear()

    def _told(self) -> list[float]:
        """Signals now, in the order of :func:`signal_names`."""
        ego, cars = self._bodies()
        around = {name: seen_from(ego, body) for name, body in cars.items()}
        self._slots = perceived(around, self._slots)
        self._others = pictured(around, self._slots, self._others)
        clearance_m = min([c.apart_m for c in around.values() if c.ahead], default=NOBODY_M)
        leader = leader_of(around)
        margin_m = safety_margin_m(ego.speed_mps, around.get(leader or ""))
        acceleration_mps2, needless_mps2 = self._braking(ego.speed_mps, around)
        before, led_s = self._before, 0.0
        if before is not None and before.leader == leader:
            led_s = before.led_s + self._settings.step_s
        lead_mps = around[leader].speed_mps if leader else 0.0
        self._before = Before(ego.speed_mps, leader, lead_mps, margin_m, led_s)
        vehicle, own = self._sumo.vehicle, self._settings.ego
        return [
            vehicle.getDistance(own) - self._begun_m,
            ego.speed_mps,
            acceleration_mps2,
            vehicle.getAllowedSpeed(own),
            clearance_m,
            margin_m if led_s >= RECOVERY_S - ROUNDING_S else NOBODY_M,
            needless_mps2,
            float(clearance_m <= 0.0),
            *_in_places(around, self._slots, with_heading=True),
            *_in_places(around, self._others, with_heading=False),
        ]

    def _braking(self, ego_mps: float, around: dict[str, Car]) -> tuple[float, float]:
        """The ego's acceleration in the step, and how much it braked beyond need [m/s^2]."""
        before, step_s = self._before, self._settings.step_s
        if before is None:
            return 0.0, 0.0
        acceleration_mps2 = (ego_mps - before.ego_mps) / step_s
        if before.margin_m < 0.0:
            return acceleration_mps2, 0.0
        lead_mps2 = 0.0
        if before.leader is not None and before.leader in around:
            lead_mps2 = (around[before.leader].speed_mps - before.leader_mps) / step_s
        return acceleration_mps2, max(min(lead_mps2, 0.0) - acceleration_mps2, 0.0)

    def _bodies(self) -> tuple[Body, dict[str, Body]]:
        """The ego and the cars around it."""
        vehicle, own = self._sumo.vehicle, self._settings.ego
        found = vehicle.getContextSubscriptionResults(own)
        constants = self._sumo.constants
        bodies: dict[str, Body] = {}
        for name, of_car in found.items():
            if name not in self._sizes:
                self._sizes[name] = vehicle.getLength(name), vehicle.getWidth(name)
            bodies[name] = Body(
                of_car[constants.VAR_POSITION],
                of_car[constants.VAR_ANGLE],
                of_car[constants.VAR_SPEED],
                *self._sizes[name],
            )
        return bodies.pop(own), bodies


def _in_places(
    cars: dict[str, Car], places: Sequence[str | None], *, with_heading: bool
) -> list[float]:
    values: list[float] = []
    for name in places:
        car = None if name is None else cars[name]
        if car is None:
            values += [NOBODY_M, 0.0, 0.0, 0.0][: 3 + with_heading]
        else:
            own = [car.gap_m, car.aside_m, car.speed_mps, car.heading_rad]
            values += own[: 3 + with_heading]
    return values
