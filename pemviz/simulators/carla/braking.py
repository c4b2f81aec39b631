"""The braking scenario's episodes on a CARLA server: places to signals, accelerations to pedals."""

import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    lead_car_salient,
    scenario_signals,
)
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Signal, StateBatch

if TYPE_CHECKING:
    import carla


@dataclass(frozen=True)
class CarPlace:
    """A car along the road that it heads along.

    Attributes:
        rear_m: Its bounding box's rear end along the road [m].
        front_m: Its front end.
        speed_mps: Along the road.
    """

    rear_m: float
    front_m: float
    speed_mps: float


@dataclass(frozen=True)
class Pedals:
    """What an ego car is asked for, each 0 to 1."""

    throttle: float
    brake: float


class TwoCars(Protocol):
    """What an episode is played on; ``pemviz.simulators.carla.server`` has that of a server."""

    def begin(self) -> tuple[CarPlace, CarPlace]:
        """Ego and lead car at the start."""
        ...

    def step(self, pressed: Pedals, lead_mps: float) -> tuple[CarPlace, CarPlace]:
        """Both one time step on."""
        ...

    def close(self) -> None:
        """Leave nothing behind."""
        ...


class CarlaBraking:
    """A :class:`pemviz.EpisodicSimulator`; ``pemviz.simulators.carla`` tells exactly."""

    name = "carla"

    def __init__(self, config: ScenarioConfig, cars: TwoCars) -> None:
        """Episodes with two cars, which are given back when nobody needs them any more."""
        self.config, self.cars = config, cars
        self.states, self.dt_s = config.states, config.dt_s
        self.signals: tuple[Signal, ...] = scenario_signals(config)
        self.controller = VectorizedSimulator(config)
        self.now = self.controller.initial(count=1)
        weakref.finalize(self, cars.close)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The lead car's salient variables ``[..., 11]``."""
        return lead_car_salient(self.config, signals)

    def reset(self) -> Mapping[str, float]:
        """Begin an episode; the signals' values.

        Raises:
            RunError: The server does not answer, or does not bring the cars there.
        """
        try:
            ego, lead = self.cars.begin()
        except BaseException:
            self.cars.close()
            raise
        return self._observed(self.controller.initial(count=1), ego, lead)

    def step(self, detected: bool) -> tuple[Mapping[str, float], bool]:
        """The signals after an outcome of perception, and whether the cars touch.

        Raises:
            RunError: The server does not answer.
        """
        wanted = self.controller.step(self.now, np.array([detected]))
        change_mps = float(wanted.signals[EGO_SPEED][0] - self.now.signals[EGO_SPEED][0])
        pressed = pedals(change_mps / self.config.dt_s, self.config)
        try:
            ego, lead = self.cars.step(pressed, float(wanted.signals[LEAD_SPEED][0]))
        except BaseException:
            self.cars.close()
            raise
        return self._observed(wanted, ego, lead), gap_m(ego, lead) <= CAMERA_TO_BUMPER_M

    def _observed(self, wanted: StateBatch, ego: CarPlace, lead: CarPlace) -> Mapping[str, float]:
        """The signals; the controller goes on from them with the lead car's scripted speed."""
        signals = {
            GAP: np.array([gap_m(ego, lead)]),
            EGO_SPEED: np.array([ego.speed_mps]),
            LEAD_SPEED: wanted.signals[LEAD_SPEED],
        }
        self.now = StateBatch(step=wanted.step, signals=signals, memory=wanted.memory)
        return {GAP: gap_m(ego, lead), EGO_SPEED: ego.speed_mps, LEAD_SPEED: lead.speed_mps}


def place_of(
    transform: "carla.Transform",
    velocity: "carla.Vector3D",
    box: "carla.BoundingBox",
    *,
    along: "carla.Vector3D",
) -> CarPlace:
    """Where an actor is along the road, whose direction ``along`` has length 1.

    The box's centre lies beside the actor's, and its ``extent`` is half its size.
    """
    ahead = transform.get_forward_vector()
    at = transform.location
    faces = ahead.x * along.x + ahead.y * along.y + ahead.z * along.z
    centre_m = at.x * along.x + at.y * along.y + at.z * along.z + faces * box.location.x
    half_m = abs(faces) * box.extent.x
    speed_mps = velocity.x * along.x + velocity.y * along.y + velocity.z * along.z
    return CarPlace(centre_m - half_m, centre_m + half_m, speed_mps)


def gap_m(ego: CarPlace, lead: CarPlace) -> float:
    """From the ego's windscreen camera to the rear of the lead car [m]."""
    return lead.rear_m - ego.front_m + CAMERA_TO_BUMPER_M


def pedals(acceleration_mps2: float, config: ScenarioConfig) -> Pedals:
    """Throttle or brake for the controller's acceleration, as a share of the scenario's limits.

    Full throttle is the controller's greatest acceleration, full brake emergency braking; what the
    car makes of them is its own.
    """
    if acceleration_mps2 < 0.0:
        share = -acceleration_mps2 / config.emergency_deceleration_mps2
        return Pedals(throttle=0.0, brake=min(share, 1.0))
    most_mps2 = config.maximum_acceleration_mps2
    share = acceleration_mps2 / most_mps2 if most_mps2 > 0.0 else 0.0
    return Pedals(throttle=min(share, 1.0), brake=0.0)
