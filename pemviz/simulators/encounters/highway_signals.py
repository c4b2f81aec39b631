"""What is measured of one encounter, for the highway-env back end: from the specification alone."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.highway_sight import Sight, sights
from pemviz.simulators.encounters.highway_start import Course, Place

MARKING_M, LEAST_SEEN_S, REGULATION_MPS2, REGULATION_S = 0.3, 0.72, 6.0, 0.35
"""UN R157, 5.2.5.2."""
FARTHEST_S = 10.0
ROUNDING = 1e-9


class Touch(NamedTuple):
    """The first contact of a step.

    Attributes:
        car: Which of the other cars.
        share: Of the step.
        impact_mps: At which speed.
    """

    car: int
    share: float
    impact_mps: float

    def at(self, before: Place, after: Place) -> Place:
        """Where a car of the contact stays."""
        return Place(
            before.x_m + self.share * (after.x_m - before.x_m),
            before.y_m + self.share * (after.y_m - before.y_m),
            0.0,
            before.heading_rad,
        )


def first_touch(
    config: EncounterConfig, before: Sequence[Place], after: Sequence[Place]
) -> Touch | None:
    """The ego's first contact over a step, places straight between old and new ones; or none.

    Args:
        config: Gives the cars' size.
        before: The ego and the other cars.
        after: Likewise.
    """
    found: Touch | None = None
    for car in range(1, len(before)):
        x_m, y_m = before[car].x_m - before[0].x_m, before[car].y_m - before[0].y_m
        along_m = after[car].x_m - after[0].x_m - x_m
        across_m = after[car].y_m - after[0].y_m - y_m
        inside = (
            _within(x_m, along_m, config.car_length_m),
            _within(y_m, across_m, config.car_width_m),
        )
        begin, end = max(one[0] for one in inside), min(one[1] for one in inside)
        if begin <= end and (found is None or begin < found.share):
            found = Touch(car - 1, begin, math.hypot(along_m, across_m) / config.dt_s)
    return found


def _within(value_m: float, change_m: float, limit_m: float) -> tuple[float, float]:
    """From which share of a step to which a distance is at most a limit, if from 0 to 1."""
    if change_m == 0.0:
        return (0.0, 1.0) if abs(value_m) <= limit_m else (1.0, 0.0)
    ends = sorted((side * limit_m - value_m) / change_m for side in (-1.0, 1.0))
    return max(ends[0], 0.0), min(ends[1], 1.0)


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

    def sights(self) -> list[Sight]:
        """What the camera sees of each other car."""
        return sights(self.config, self.offsets, [car.heading_rad for car in self.others])

    @property
    def reported_offsets(self) -> list[tuple[float, float]]:
        """Gap and offset of all that perception may report: the cars, and a ghost last."""
        ghost_m = self.ghost_m
        return self.offsets if ghost_m is None else [*self.offsets, (ghost_m, 0.0)]

    @property
    def ghost_m(self) -> float | None:
        """From the ego's bumper to where a ghost may appear; ``None`` where none may."""
        place_m = self.start.get("ghost_gap")
        return None if place_m is None else place_m - self.ego.x_m

    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[K]``."""
        found, ghost_m = [sight.present for sight in self.sights()], self.ghost_m
        if ghost_m is not None:
            config = self.config
            z_m = ghost_m + config.camera_to_bumper_m + config.car_length_m / 2
            hidden = any(self.offsets[car][0] < ghost_m for car in self._ahead())
            found.append(0.5 < z_m <= config.farthest_m and not hidden)
        return np.array(found, dtype=np.bool_)

    @property
    def names(self) -> list[str]:
        """Of the signals, in their order."""
        return list(self.values())

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
        if (ghost_m := self.ghost_m) is not None:
            found["gap_ghost"] = ghost_m
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
