"""The braking scenario's episodes on a CARLA server."""

import weakref
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.config.settings import read_address
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    lead_car_salient,
    scenario_signals,
)
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.carla.motion import CarPlace, Pedals, gap_m, pedals
from pemviz.types import Signal, StateBatch


class TwoCars(Protocol):
    """What an episode is played on; ``pemviz.simulators.carla.stage`` has that of a server."""

    def begin(self) -> tuple[CarPlace, CarPlace]:
        """Ego and lead car at the start."""
        ...

    def step(self, pressed: Pedals, lead_mps: float) -> tuple[CarPlace, CarPlace]:
        """Both one time step on."""
        ...

    def close(self) -> None:
        """Leave nothing behind."""
        ...


def braking_on_carla(config: ScenarioConfig, address: str) -> "CarlaBraking":
    """Episodes on a server.

    Args:
        config: The scenario.
        address: ``HOST:PORT``.

    Raises:
        ConfigError: There is no server of the client's version, or somebody else drives it.
        RunError: It does not answer any more, or refuses.
    """
    from pemviz.simulators.carla.server import connected  # noqa: PLC0415  these need the client
    from pemviz.simulators.carla.stage import Stage  # noqa: PLC0415

    where = f"carla = {address!r}"
    return CarlaBraking(config, Stage(connected(*read_address(address)), config, where=where))


class CarlaBraking:
    """A :class:`pemviz.EpisodicSimulator`; ``pemviz.simulators.carla`` tells exactly."""

    name = "carla"

    def __init__(self, config: ScenarioConfig, cars: TwoCars) -> None:
        """Episodes with two cars, which are given back when nobody needs them any more."""
        self.config, self.cars = config, cars
        self.controller = VectorizedSimulator(config)
        self.now = self.controller.initial(count=1)
        weakref.finalize(self, cars.close)

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.config.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.config.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Gap [m], ego speed and lead speed [m/s]."""
        return scenario_signals(self.config)

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
        self.now = self._state(self.controller.initial(count=1), ego, lead)
        return _told(ego, lead)

    def step(self, detected: bool) -> tuple[Mapping[str, float], bool]:
        """The signals after an outcome of perception, and whether the cars touch.

        Raises:
            RunError: The server does not answer.
        """
        now = self.now
        wanted = self.controller.step(now, np.array([detected]))
        change_mps = float(wanted.signals[EGO_SPEED][0] - now.signals[EGO_SPEED][0])
        pressed = pedals(change_mps / self.config.dt_s, self.config)
        try:
            ego, lead = self.cars.step(pressed, float(wanted.signals[LEAD_SPEED][0]))
        except BaseException:
            self.cars.close()
            raise
        self.now = self._state(wanted, ego, lead)
        return _told(ego, lead), gap_m(ego, lead) <= CAMERA_TO_BUMPER_M

    @staticmethod
    def _state(wanted: StateBatch, ego: CarPlace, lead: CarPlace) -> StateBatch:
        """What the controller goes on from; the lead car's speed is that of the script."""
        signals = {
            GAP: np.array([gap_m(ego, lead)]),
            EGO_SPEED: np.array([ego.speed_mps]),
            LEAD_SPEED: wanted.signals[LEAD_SPEED],
        }
        return StateBatch(step=wanted.step, signals=signals, memory=wanted.memory)


def _told(ego: CarPlace, lead: CarPlace) -> Mapping[str, float]:
    return {GAP: gap_m(ego, lead), EGO_SPEED: ego.speed_mps, LEAD_SPEED: lead.speed_mps}
