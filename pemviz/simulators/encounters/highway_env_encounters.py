"""Encounters as highway-env environments; this module imports highway-env, and pygame.

Importing it registers the environments with gymnasium::

    import pemviz.simulators.encounters.highway_env_encounters
    gymnasium.make("pemviz-cut-in-v0", render_mode="rgb_array")
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.simulators.braking.highway_env_scenario import (
    EGO_RGB,
    LEAD_RGB,
    ScriptedCar,
    ScriptedEnv,
)
from pemviz.simulators.encounters.highway import HighwayEncounters
from pemviz.types import StateBatch

ENCOUNTERS = {
    "pemviz-braking-encounter-v0": EncounterConfig(logical_scenario="braking"),
    "pemviz-cut-in-v0": EncounterConfig(logical_scenario="cut-in"),
    "pemviz-cut-out-v0": EncounterConfig(logical_scenario="cut-out"),
}
"""By the environment's id."""
LARGEST = 1e6


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


class SignalsObservation(ObservationType):
    """The logical scenario's signals in their order, float64."""

    env: "EncounterEnv"

    def space(self) -> spaces.Box:
        """Anything finite that is not absurd."""
        return spaces.Box(-LARGEST, LARGEST, (len(self.env.scenario.signals),), np.float64)

    def observe(self) -> FloatArray:
        """The current values."""
        signals = self.env.states.signals
        return np.concatenate([signals[signal.name] for signal in self.env.scenario.signals])


class PerceptionOutcomes(ActionType):
    """For each other car 0, missed, or 1, detected."""

    env: "EncounterEnv"

    def space(self) -> spaces.MultiBinary:
        """An outcome for each, and for the ghost."""
        return spaces.MultiBinary(len(self.env.scenario.slots))

    def act(self, action: Any) -> None:
        """Nothing: the environment tells the ego as it moves on."""


class EncounterEnv(ScriptedEnv):
    """An encounter as ``pemviz.simulators.encounters`` specifies it, stepped with outcomes."""

    def __init__(
        self,
        encounter: EncounterConfig,
        chosen: Sequence[StartChoice] = (),
        tracker: str = NO_TRACKER,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment, in an encounter with medians at the start.

        Args:
            encounter: Parameters, with a logical scenario.
            chosen: Start values with other distributions.
            tracker: As ``ScenarioConfig.tracker``.
            render_mode: ``rgb_array`` to render frames ``[160, 640, 3]`` without a display.
        """
        self.scenario = HighwayEncounters(encounter, tuple(chosen), tracker)
        self.start = np.zeros(self.scenario.latents.start)
        self.on_road = CarsOnRoad(encounter, len(self.scenario.cars))
        super().__init__(encounter, shown_m=encounter.farthest_m, render_mode=render_mode)

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        self.set_spaces(SignalsObservation(self), PerceptionOutcomes(self))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an encounter with start values sampled at random.

        Args:
            seed: Of the start values.
            options: ``start``: their standard normals ``[S]`` instead.
        """
        gymnasium.Env.reset(self, seed=seed)
        given = (options or {}).get("start")
        normals = self.np_random.standard_normal(len(self.start)) if given is None else given
        self.start = np.asarray(normals, dtype=np.float64)
        return super().reset()

    def _reset(self) -> None:
        self.road, self.controlled_vehicles = self.on_road.road, self.on_road.cars[:1]
        self.show(self.scenario.initial(count=1, start=self.start[None]))

    def show(self, states: StateBatch) -> None:
        """Be in the state of one rollout of a back end, ``[1]``."""
        self.states, self.steps = states, int(states.step)
        self.on_road.put(self.scenario.scene(states.signals).of_cars[0])

    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[K]``."""
        return self.scenario.present(self.states.signals)[0]

    def advance(self, detected: BoolArray) -> None:
        """Move one time step on for outcomes ``[K]``, without the costs of observing."""
        self.show(self.scenario.step(self.states, np.asarray(detected, dtype=np.bool_)[None]))

    def _simulate(self, action: Any = None) -> None:
        self.advance(action)

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:  # noqa: ARG002
        return {"present": self.present()}


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


for _name, _encounter in ENCOUNTERS.items():
    if _name not in gymnasium.registry:
        gymnasium.register(
            id=_name,
            entry_point=f"{__name__}:{EncounterEnv.__name__}",
            kwargs={"encounter": _encounter},
        )
