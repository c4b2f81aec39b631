"""One encounter in plain numbers, for the highway-env back end.

How it begins, what its other cars do and what rules ask for: written from the specification in
``pemviz/simulators/encounters/__init__.py`` alone, so that the vectorized back end can be held to
it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from scipy.optimize import brentq

from pemviz.config import EncounterConfig

EXACT = 1e-15
MARKING_M, LEAST_SEEN_S, REGULATION_MPS2, REGULATION_S = 0.3, 0.72, 6.0, 0.35
"""UN R157, 5.2.5.2."""
FARTHEST_S = 10.0
ROUNDING = 1e-9


class Place(NamedTuple):
    """A car's centre along the road and to the left, its speed, and where it heads."""

    x_m: float
    y_m: float
    speed_mps: float
    heading_rad: float

    @property
    def along_mps(self) -> float:
        """Speed along the road [m/s]."""
        return self.speed_mps * math.cos(self.heading_rad)


@dataclass(frozen=True)
class Course:
    """What one of the other cars does: begins, changes lane within some time (0: never), brakes."""

    name: str
    start: Place
    to_m: float = 0.0
    begin_s: float = 0.0
    within_s: float = 0.0
    deceleration_mps2: float = 0.0
    brake_time_s: float = 0.0

    def profile(self, time_s: float) -> float:
        """Where it is to be to the side at a time [m]."""
        if self.within_s == 0.0:
            return self.start.y_m
        share = minimum_jerk((time_s - self.begin_s) / self.within_s)
        return self.start.y_m + (self.to_m - self.start.y_m) * share

    def acceleration(self, time_s: float) -> float:
        """Over the step that begins at a time [m/s^2]."""
        return -self.deceleration_mps2 if time_s >= self.brake_time_s else 0.0


def minimum_jerk(u: float) -> float:
    """S(u) = 10 u^3 - 15 u^4 + 6 u^5 between 0 and 1 (Flash & Hogan 1985)."""
    u = min(max(u, 0.0), 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


@lru_cache
def time_share(covered: float) -> float:
    """The u with S(u) = ``covered``, from 0 to 1."""
    if covered <= 0.0 or covered >= 1.0:
        return float(covered >= 1.0)

    def lacking(u: float) -> float:
        return minimum_jerk(u) - covered

    root: Any = brentq(lacking, 0.0, 1.0, xtol=EXACT)
    return root


def courses(config: EncounterConfig, values: Mapping[str, float]) -> list[Course]:
    """The other cars of an encounter with these start values, in their order."""
    side_m = config.lane_width_m * (1.0 if config.side == "left" else -1.0)
    if config.logical_scenario == "braking":
        speed_mps = values["ego_speed"] - values["closing_speed"]
        braking_mps2, begin_s = values["deceleration"], values["brake_time"]
        place = _place(config, values["gap"], 0.0, speed_mps)
        found = [Course("lead", place, deceleration_mps2=braking_mps2, brake_time_s=begin_s)]
    else:
        changing = _cut_in if config.logical_scenario == "cut-in" else _cut_out
        found = changing(config, values, side_m)
    if config.neighbour:
        place = _place(config, values["neighbour_gap"], -side_m, values["ego_speed"])
        found.append(Course("neighbour", place))
    return found


def _place(config: EncounterConfig, gap_m: float, y_m: float, speed_mps: float) -> Place:
    return Place(gap_m + config.car_length_m, y_m, max(speed_mps, 0.0), 0.0)


def _cut_in(config: EncounterConfig, values: Mapping[str, float], side_m: float) -> list[Course]:
    width_m, speed_mps = config.lane_width_m, values["ego_speed"]
    u = time_share(max(width_m - config.car_width_m, 0.0) / (2.0 * width_m))
    until_s = values["cut_in_time"] + u * values["duration"]
    gap_m = values["gap"] + min(values["closing_speed"], max(speed_mps, 0.0)) * until_s
    lead_m = gap_m + config.car_length_m + values["lead_gap"]
    start = _place(config, gap_m, side_m, speed_mps - values["closing_speed"])
    return [
        Course("cutting_in", start, 0.0, values["cut_in_time"], values["duration"]),
        Course("lead", _place(config, lead_m, 0.0, speed_mps)),
    ]


def _cut_out(config: EncounterConfig, values: Mapping[str, float], side_m: float) -> list[Course]:
    lead = _place(config, values["gap"], 0.0, values["ego_speed"] - values["closing_speed"])
    u = time_share(min(config.car_width_m / config.lane_width_m, 1.0))
    until_s = values["cut_out_time"] + u * values["duration"] + values["margin"]
    closing_mps = max(lead.speed_mps - values["revealed_speed"], 0.0)
    gap_m = values["gap"] + config.car_length_m + closing_mps * until_s
    return [
        Course("lead", lead, side_m, values["cut_out_time"], values["duration"]),
        Course("revealed", _place(config, gap_m, 0.0, values["revealed_speed"])),
    ]


def measured_place(
    config: EncounterConfig, gap_m: float, aside_m: float, along_m: float, across_m: float
) -> tuple[float, float]:
    """Gap and offset to the left [m] of a car whose centre is measured off.

    Errors are along the line of sight from the camera, and across it to the right.
    """
    ahead_m = gap_m + config.camera_to_bumper_m + config.car_length_m / 2
    bearing_rad = math.atan2(-aside_m, ahead_m)
    farther_m = along_m * math.cos(bearing_rad) - across_m * math.sin(bearing_rad)
    to_the_right_m = along_m * math.sin(bearing_rad) + across_m * math.cos(bearing_rad)
    return gap_m + farther_m, aside_m - to_the_right_m


class Signals:
    """The signals of one encounter, as it goes on."""

    def __init__(
        self, config: EncounterConfig, courses: Sequence[Course], values: Mapping[str, float]
    ) -> None:
        self.config, self.courses, self.start = config, courses, values
        self.touched: int | None = None
        self.impact_mps = 0.0
        self.ego_mps2 = 0.0
        self.needless_mps2 = 0.0
        self.avoidable_s = -FARTHEST_S
        self.safe_m = config.gap_bound_m
        self.nearest: int | None = None
        self.nearest_states = 0
        self.was_short = False

    @property
    def collided(self) -> bool:
        """Whether the ego has touched another car."""
        return self.touched is not None

    def numbers(self) -> list[float]:
        """What :meth:`load` puts back."""
        return [
            -1.0 if self.touched is None else float(self.touched),
            self.impact_mps,
            self.ego_mps2,
            self.needless_mps2,
            self.avoidable_s,
            self.safe_m,
            -1.0 if self.nearest is None else float(self.nearest),
            float(self.nearest_states),
            float(self.was_short),
        ]

    def load(
        self, numbers: Sequence[float], courses: Sequence[Course], values: Mapping[str, float]
    ) -> None:
        """Go on from what :meth:`numbers` gave; :meth:`look` tells the places."""
        self.courses, self.start = courses, values
        touched, self.impact_mps, self.ego_mps2, self.needless_mps2 = numbers[:4]
        self.avoidable_s, self.safe_m, nearest, states, short = numbers[4:]
        self.touched = None if touched < 0.0 else int(touched)
        self.nearest = None if nearest < 0.0 else int(nearest)
        self.nearest_states, self.was_short = int(states), bool(short)

    def look(self, ego: Place, others: Sequence[Place]) -> None:
        """Take in where the cars are."""
        self.ego, self.others = ego, list(others)
        length_m = self.config.car_length_m
        self.offsets = [(car.x_m - ego.x_m - length_m, car.y_m - ego.y_m) for car in others]

    def begin(self, ego: Place, others: Sequence[Place]) -> None:
        """The state s_0."""
        self.look(ego, others)
        self.was_short = self._is_short()
        self._follow()

    def leave(self, ego_mps2: float, braking_mps2: Sequence[float]) -> None:
        """The step from here, with the ego's acceleration and the others' decelerations."""
        self.ego_mps2 = ego_mps2
        ahead = self._ahead()
        if any(self.offsets[car][0] < self._safe_distance_m(car) for car in ahead):
            self.next_needless = 0.0
            return
        nearest = min(ahead, key=lambda car: self.offsets[car][0], default=None)
        self.next_needless = max(-ego_mps2, 0.0)
        if nearest is not None:  # one that stands brakes no more
            to_standstill_mps2 = self.others[nearest].speed_mps / self.config.dt_s
            braked_mps2 = min(braking_mps2[nearest], to_standstill_mps2)
            self.next_needless = max(-ego_mps2 - braked_mps2, 0.0)

    def touch(self, car: int, impact_mps: float) -> None:
        """A contact within the step."""
        self.touched, self.impact_mps = car, impact_mps

    def arrive(self, ego: Place, others: Sequence[Place], step: int) -> None:
        """The state that the step leads to."""
        self.look(ego, others)
        if self.collided:
            return
        self.needless_mps2 = self.next_needless
        self._follow()
        if self.was_short and not self._is_short():
            self.avoidable_s = self._avoidable_by(step * self.config.dt_s)
        self.was_short = self._is_short()

    def _ahead(self) -> list[int]:
        """The cars ahead in lane."""
        config = self.config
        return [
            car
            for car, (gap_m, aside_m) in enumerate(self.offsets)
            if abs(aside_m) < (config.lane_width_m + config.car_width_m) / 2
            and gap_m + config.car_length_m > 0.0
        ]

    def _safe_distance_m(self, car: int) -> float:
        ego_mps, lead_mps = self.ego.speed_mps, self.others[car].along_mps
        braking_m = (ego_mps**2 - lead_mps**2) / (2.0 * self.config.hard_deceleration_mps2)
        return max(0.0, braking_m + self.config.reaction_time_s * ego_mps)

    def _follow(self) -> None:
        """The safe distance, once the nearest car ahead in lane has been it for long enough."""
        config = self.config
        nearest = min(self._ahead(), key=lambda car: self.offsets[car][0], default=None)
        self.nearest_states = self.nearest_states + 1 if nearest == self.nearest else 1
        self.nearest = nearest
        before = math.floor(config.recovery_time_s / config.dt_s + ROUNDING)
        self.safe_m = config.gap_bound_m
        if nearest is not None and self.nearest_states > before:
            margin_m = self.offsets[nearest][0] - self._safe_distance_m(nearest)
            self.safe_m = min(max(margin_m, -config.gap_bound_m), config.gap_bound_m)

    def _is_short(self) -> bool:
        """Whether the car that cuts in is short of the regulation's line."""
        if self.config.logical_scenario != "cut-in":
            return False
        near_side_m = abs(self.offsets[0][1]) - self.config.car_width_m / 2
        return near_side_m > self.config.lane_width_m / 2 - MARKING_M

    def _avoidable_by(self, time_s: float) -> float:
        """By how much its time to collision exceeds the regulation's [s]."""
        if time_s < self.start["cut_in_time"] + LEAST_SEEN_S:
            return -FARTHEST_S
        closing_mps = self.ego.speed_mps - self.others[0].along_mps
        if closing_mps <= 0.0:
            return FARTHEST_S
        least_s = closing_mps / (2.0 * REGULATION_MPS2) + REGULATION_S
        return min(max(self.offsets[0][0] / closing_mps - least_s, -FARTHEST_S), FARTHEST_S)

    @property
    def reported_offsets(self) -> list[tuple[float, float]]:
        """Gap and offset of all that perception may report: the cars, and a ghost last."""
        place_m = self.false_positive_m
        return self.offsets if place_m is None else [*self.offsets, (place_m, 0.0)]

    @property
    def false_positive_m(self) -> float | None:
        """From the ego's bumper to where a ghost may appear; ``None`` where none may."""
        place_m = self.start.get("ghost_gap")
        return None if place_m is None else place_m - self.ego.x_m

    def values(self) -> dict[str, float]:
        """The signals by name."""
        config = self.config
        found = {
            "ego_x": self.ego.x_m,
            "ego_speed": self.ego.speed_mps,
            "ego_acceleration": self.ego_mps2,
        }
        for course, car, (gap_m, aside_m) in zip(
            self.courses, self.others, self.offsets, strict=True
        ):
            found[f"gap_{course.name}"], found[f"aside_{course.name}"] = gap_m, aside_m
            found[f"speed_{course.name}"] = car.speed_mps
            found[f"heading_{course.name}"] = car.heading_rad
        if (place_m := self.false_positive_m) is not None:
            found["gap_ghost"] = place_m
            found |= {"aside_ghost": 0.0, "speed_ghost": 0.0, "heading_ghost": 0.0}
        found["clearance"] = min(
            max(abs(gap_m + config.car_length_m) - config.car_length_m, abs(y) - config.car_width_m)
            for gap_m, y in self.offsets
        )
        found["safe_distance"] = self.safe_m
        found["needless_deceleration"] = self.needless_mps2
        if config.logical_scenario == "cut-in":
            found["avoidable_by"] = self.avoidable_s
        found["collided"], found["impact_speed"] = float(self.collided), self.impact_mps
        return found
