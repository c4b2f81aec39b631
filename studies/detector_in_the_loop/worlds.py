"""pemviz's own scenarios as worlds that a camera can look at: where cars are, and what failed.

The scenario, its ego and its numbers are those that ``pemviz record`` takes: each world also gives
the options under which it answers for the same system.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig, ScenarioConfig, StartChoice
from pemviz.simulators.braking import scenario as braking
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.types import StateBatch
from studies.detector_in_the_loop.camera import CAMERA_HEIGHT_M, HALF_ANGLE_DEG
from studies.detector_in_the_loop.drives import DT_S


class World(Protocol):
    """A scenario of pemviz's that can be looked at.

    Attributes:
        cars: How many other cars K perception answers for.
        starts: Standard normals that a rollout begins with.
    """

    @property
    def cars(self) -> int: ...  # noqa: D102
    @property
    def starts(self) -> int: ...  # noqa: D102
    @property
    def simulator(self) -> Any:
        """What ``pemviz record`` steps too."""
        ...

    @property
    def options(self) -> tuple[str, ...]:
        """Of ``pemviz record``, for the same system and the same failure."""
        ...

    def begin(self, normals: FloatArray) -> StateBatch:
        """States in which N rollouts start, for standard normals ``[N, S]``."""
        ...

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The next states, for outcomes ``[N, K]``."""
        ...

    def poses(self, states: StateBatch) -> FloatArray:
        """x, near, heading and whether it brakes, of each car ``[N, K, 4]``."""
        ...

    def ego_mps(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The ego's speed ``[N]`` [m/s]."""
        ...

    def failed(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the rule is broken ``[N]``."""
        ...


@dataclass(frozen=True)
class BrakingWorld:
    """The braking scenario: the ego brakes where a lead car is detected nearer than some gap."""

    initial_gap_m: float = 70.0
    emergency_gap_m: float = 60.0
    speed_kmh: float = 108.0
    lead_deceleration_mps2: float = 6.0
    states: int = 51

    cars = 1
    starts = 0

    @cached_property
    def simulator(self) -> VectorizedSimulator:
        """The back end."""
        return VectorizedSimulator(
            ScenarioConfig(
                initial_gap_m=self.initial_gap_m,
                emergency_gap_m=self.emergency_gap_m,
                initial_speed_kmh=self.speed_kmh,
                lead_deceleration_mps2=self.lead_deceleration_mps2,
                lead_length_m=4.5,
                camera_height_m=CAMERA_HEIGHT_M,
                dt_s=DT_S,
                states=self.states,
            )
        )

    @property
    def options(self) -> tuple[str, ...]:
        """As :class:`World` says."""
        config = self.simulator.config
        names = (
            *("initial_gap_m", "emergency_gap_m", "initial_speed_kmh"),
            *("lead_deceleration_mps2", "lead_length_m", "camera_height_m", "dt_s", "states"),
        )
        given: list[str] = []
        for name in names:
            given += [f"--scenario.{name.replace('_', '-')}", f"{getattr(config, name):g}"]
        return (*given, "--spec", f"always[0,{self.states - 1}] (gap >= 0)")

    def begin(self, normals: FloatArray) -> StateBatch:
        """As :class:`World` says."""
        return self.simulator.initial(count=len(normals))

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """As :class:`World` says."""
        return self.simulator.step(states, detected[:, 0])

    def poses(self, states: StateBatch) -> FloatArray:
        """As :class:`World` says."""
        gap_m = states.signals[braking.GAP]
        found = np.zeros((gap_m.size, 1, 4))
        found[:, 0, 1] = gap_m
        found[:, 0, 3] = self.simulator.config.lead_deceleration_mps2 > 0.0
        return found

    def ego_mps(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """As :class:`World` says."""
        return signals[braking.EGO_SPEED]

    def failed(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """As :class:`World` says."""
        return signals[braking.GAP] < 0.0


@dataclass(frozen=True)
class CutInWorld:
    """The logical scenario cut-in: a car comes between the ego and its lead car."""

    gap: str = "lognormal(16, 0.3) in [12, 40]"
    closing_speed: str = "normal(8, 2) in [3, 11]"
    ego_speed: str = "normal(26, 2) in [20, 32]"
    duration: str = "lognormal(3, 0.2) in [2, 4.5]"
    cut_in_time: str = "uniform(0.3, 1)"
    lead_gap: str = "lognormal(45, 0.2) in [25, 90]"
    states: int = 61

    cars = 2

    @property
    def choices(self) -> tuple[StartChoice, ...]:
        """Start values with distributions of this study's."""
        names = ("gap", "closing_speed", "ego_speed", "duration", "cut_in_time", "lead_gap")
        return tuple(StartChoice(name, getattr(self, name)) for name in names)

    @cached_property
    def simulator(self) -> VectorizedEncounters:
        """The back end."""
        config = EncounterConfig(
            logical_scenario="cut-in",
            side="right",
            dt_s=DT_S,
            states=self.states,
            camera_height_m=CAMERA_HEIGHT_M,
            camera_half_angle_deg=HALF_ANGLE_DEG,
        )
        return VectorizedEncounters(config, self.choices)

    @property
    def starts(self) -> int:
        """Standard normals that a rollout begins with."""
        return self.simulator.latents.start

    @property
    def options(self) -> tuple[str, ...]:
        """As :class:`World` says."""
        config = self.simulator.config
        given = ["--encounter.logical-scenario", "cut-in", "--encounter.side", "right"]
        for name in ("dt_s", "states", "camera_height_m", "camera_half_angle_deg"):
            given += [f"--encounter.{name.replace('_', '-')}", f"{getattr(config, name):g}"]
        for choice in self.choices:
            given += ["--start", f"{choice.name}={choice.distribution}"]
        return (*given, "--spec", f"always[0,{self.states - 1}] (collided <= 0)")

    def begin(self, normals: FloatArray) -> StateBatch:
        """As :class:`World` says."""
        return self.simulator.initial(count=len(normals), start=normals)

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """As :class:`World` says."""
        return self.simulator.step(states, detected)

    def poses(self, states: StateBatch) -> FloatArray:
        """As :class:`World` says; the middle of a turned car is where the encounter has it."""
        signals, config = states.signals, self.simulator.config
        names = self.simulator.cars
        found = np.zeros((states.shape[0], len(names), 4))
        for place, name in enumerate(names):
            heading_rad = signals[f"heading_{name}"]
            half_m = config.car_length_m / 2
            found[:, place, 0] = half_m * np.tan(heading_rad) - signals[f"aside_{name}"]
            found[:, place, 1] = signals[f"gap_{name}"] + config.camera_to_bumper_m
            found[:, place, 2] = heading_rad
        return found

    def ego_mps(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """As :class:`World` says."""
        return signals["ego_speed"]

    def failed(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """As :class:`World` says."""
        return signals["collided"] > 0.0
