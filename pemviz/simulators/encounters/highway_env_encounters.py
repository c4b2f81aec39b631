"""Encounters as highway-env environments; this module imports highway-env, and pygame.

Importing it registers the environments with gymnasium::

    import pemviz.simulators.encounters.highway_env_encounters
    gymnasium.make("pemviz-cut-in-v0", render_mode="rgb_array")

How an encounter begins and what is measured is in ``single_encounter.py``: one encounter, no batch.
"""

import math
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
from pemviz.simulators.encounters import ego
from pemviz.simulators.encounters.single_encounter import (
    Place,
    Signals,
    courses,
)
from pemviz.simulators.encounters.vectorized import VectorizedEncounters, first_touch

ENCOUNTERS = {
    "pemviz-braking-encounter-v0": EncounterConfig(logical_scenario="braking"),
    "pemviz-cut-in-v0": EncounterConfig(logical_scenario="cut-in"),
    "pemviz-cut-out-v0": EncounterConfig(logical_scenario="cut-out"),
}
"""By the environment's id."""
SINE_LIMIT = 0.3
LARGEST = 1e6


class EncounterCar(ScriptedCar):
    """A car that can be put into a place."""

    @property
    def place(self) -> Place:
        """Where it is; highway-env's y grows to the right."""
        x_m, y_m = self.position.tolist()
        return Place(x_m, -y_m, float(self.speed), -float(self.heading))

    @place.setter
    def place(self, place: Place) -> None:
        self.position = np.array([place.x_m, -place.y_m])
        self.speed, self.heading = place.speed_mps, -place.heading_rad


class SignalsObservation(ObservationType):
    """The logical scenario's signals in their order, float64."""

    env: "EncounterEnv"

    def space(self) -> spaces.Box:
        """Anything finite that is not absurd."""
        return spaces.Box(-LARGEST, LARGEST, (len(self.env.scenario.signals),), np.float64)

    def observe(self) -> FloatArray:
        """The current values."""
        return np.array(list(self.env.signals.values().values()))


class PerceptionOutcomes(ActionType):
    """For each other car 0, missed, or 1, detected."""

    env: "EncounterEnv"

    def space(self) -> spaces.MultiBinary:
        """An outcome for each, and for the ghost."""
        return spaces.MultiBinary(len(self.env.closing_mps))

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
        self.encounter = encounter
        self.scenario = VectorizedEncounters(encounter, tuple(chosen), tracker)
        self.tracker, self.start = self.scenario.tracker, np.zeros(self.scenario.latents.start)
        self.empty_road = _road(encounter)
        super().__init__(encounter, shown_m=encounter.farthest_m, render_mode=render_mode)

    def define_spaces(self) -> None:
        """Set our own observation and action types."""
        if not hasattr(self, "courses"):
            self.begin(self.start)
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
        self.begin(self.start)

    def begin(self, start: FloatArray) -> None:
        """Put all cars at the start for standard normals ``[S]``."""
        values = self.scenario.start_values(start[None])
        self.values = {name: float(of_one[0]) for name, of_one in values.items()}
        self.courses = courses(self.encounter, self.values)
        self.set_speed_mps = max(self.values["ego_speed"], 0.0)
        self.road = self.empty_road
        size = {"length_m": self.encounter.car_length_m, "width_m": self.encounter.car_width_m}
        self.ego = EncounterCar(self.road, **size, color=EGO_RGB)
        self.others = [EncounterCar(self.road, **size, color=LEAD_RGB) for _ in self.courses]
        self.cars = (self.ego, *self.others)
        self.road.vehicles = list[Vehicle](self.cars)
        self.controlled_vehicles = [self.ego]
        self.steps = 0
        self.ego.place = Place(0.0, 0.0, self.set_speed_mps, 0.0)
        for car, course in zip(self.others, self.courses, strict=True):
            car.place = course.start
        self._head()
        self.signals = Signals(self.encounter, self.courses, self.values)
        self.signals.begin(self.ego.place, self.places)
        self.closing_mps = [0.0] * len(self.signals.reported_offsets)
        if self.tracker is not None:
            self.tracks = self.tracker.start(1, slots=len(self.closing_mps))

    @property
    def places(self) -> list[Place]:
        """Where the other cars are."""
        return [car.place for car in self.others]

    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[K]``."""
        signals = {name: np.array([value]) for name, value in self.signals.values().items()}
        return self.scenario.present(signals)[0]

    def numbers(self) -> list[float]:
        """All that the future depends on beside tracks and outcomes; see :meth:`load`."""
        places = [number for car in self.cars for number in car.place]
        values = list(self.values.values())
        return [float(self.steps), *values, *places, *self.closing_mps, *self.signals.numbers()]

    def load(self, numbers: Sequence[float]) -> None:
        """Put the scene into a state that :meth:`numbers` gave; its tracks stay."""
        rest = iter(numbers)
        self.steps = int(next(rest))
        self.values = {name: next(rest) for name in self.values}
        self.courses = courses(self.encounter, self.values)
        self.set_speed_mps = max(self.values["ego_speed"], 0.0)
        for car in self.cars:
            car.place = Place(*(next(rest) for _ in Place._fields))
        self.closing_mps = [next(rest) for _ in self.closing_mps]
        self.signals.load(list(rest), self.courses, self.values)
        self.signals.look(self.ego.place, self.places)

    def advance(self, detected: BoolArray) -> None:
        """Move one time step on for outcomes ``[K]``, without the costs of observing."""
        hits = np.asarray(detected, dtype=np.bool_) & self.present()
        if self.tracker is None:
            self.move(hits)
            return
        measured = [self.signals.reported_offsets]
        self.tracks = self.tracker.update(self.tracks, hits[None], np.array(measured))
        speeds_mps = self.tracks.speed_mps[0] if self.tracker.has_speeds else None
        self.move(hits, self.tracks.confirmed[0], self.tracks.position_m[0], speeds_mps)

    def move(
        self,
        hits: BoolArray,
        tracked: BoolArray | None = None,
        position_m: FloatArray | None = None,
        speed_mps: FloatArray | None = None,
    ) -> None:
        """Move one time step on, with the ego told of hits, or of tracks.

        Args:
            hits: Slots that are present and reported ``[K]``.
            tracked: Of which the ego is told ``[K]``; ``None``: of the hits.
            position_m: Gaps and offsets of the tracks, or as measured, ``[K, 2]``; ``None``: as
                they are.
            speed_mps: How they change, where a filter knows it, ``[K, 2]``.
        """
        config, ego_mps = self.encounter, self.ego.place.speed_mps
        places_m = np.array(self.signals.reported_offsets) if position_m is None else position_m
        along_mps = [place.along_mps for place in self.places]
        along_mps += [0.0] * (len(places_m) - len(along_mps))
        self.closing_mps = [
            ego_mps - along if hit else held
            for hit, along, held in zip(hits, along_mps, self.closing_mps, strict=True)
        ]
        closing_mps = np.array(self.closing_mps) if speed_mps is None else -speed_mps[:, 0]
        there = hits if tracked is None else tracked
        gap_m, aside_m = places_m[:, :1], places_m[:, 1:]
        wanted_mps2 = ego.acceleration(
            config,
            ego.Reported(there[:, None], gap_m, aside_m, closing_mps[:, None]),
            ego_mps=np.array([ego_mps]),
            set_mps=np.array([self.set_speed_mps]),
        )
        self._step(0.0 if self.signals.collided else float(wanted_mps2[0]))

    def _step(self, ego_mps2: float) -> None:
        dt_s, before = self.encounter.dt_s, [car.place for car in self.cars]
        others = [course.acceleration(self.steps * dt_s) for course in self.courses]
        for car, one in zip(self.cars, (ego_mps2, *others), strict=True):
            car.accelerate(one)
        self.signals.leave(ego_mps2, [-one for one in others])
        self.road.step(dt_s)
        if self.signals.touched is None:
            self._touch(before)
        else:  # they stand
            for number in (0, self.signals.touched + 1):
                self.cars[number].place = before[number]
        self.steps += 1
        self._head()
        self.signals.arrive(self.ego.place, self.places, self.steps)

    def _touch(self, before: Sequence[Place]) -> None:
        """Stop the ego and the car that it touches first over the step, if any."""
        after = [car.place for car in self.cars]
        first_m, last_m = (
            np.array([(car.x_m - places[0].x_m, car.y_m - places[0].y_m) for car in places[1:]]).T
            for places in (before, after)
        )
        reach_m = (self.encounter.car_length_m, self.encounter.car_width_m)
        shares = first_touch((first_m[0], first_m[1]), (last_m[0], last_m[1]), reach_m=reach_m)
        car, share = int(shares.argmin()), float(shares.min())
        if share > 1.0:
            return
        moved_m = (last_m - first_m)[:, car].tolist()
        self.signals.touch(car, math.hypot(*moved_m) / self.encounter.dt_s)
        for number in (0, car + 1):
            begin, end = before[number], after[number]
            x_m = begin.x_m + share * (end.x_m - begin.x_m)
            y_m = begin.y_m + share * (end.y_m - begin.y_m)
            self.cars[number].place = Place(x_m, y_m, 0.0, begin.heading_rad)

    def _head(self) -> None:
        """Turn the cars to where their profiles have them at the next state."""
        dt_s = self.encounter.dt_s
        for car, course in zip(self.others, self.courses, strict=True):
            place = car.place
            if place.speed_mps > 0.0:
                aside_m = course.profile((self.steps + 1) * dt_s) - place.y_m
                sine = min(max(aside_m / (place.speed_mps * dt_s), -SINE_LIMIT), SINE_LIMIT)
                car.place = place._replace(heading_rad=math.asin(sine))

    def _simulate(self, action: Any = None) -> None:
        self.advance(np.asarray(action, dtype=np.bool_))

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
