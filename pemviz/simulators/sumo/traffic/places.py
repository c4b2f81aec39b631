"""Which of the cars around the ego has which slot, and how near they come: plain numbers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pemviz.simulators.sumo.traffic.messages import NOBODY_M

SIGHT_M = 100.0
VIEW_SLOPE = 1.7320508075688772
"""Tangent of 60 degrees."""
PATH_HALF_WIDTH_M = 1.45
"""As :class:`pemviz.config.EncounterConfig` has it."""
REACTION_S, BRAKING_MPS2, RECOVERY_S = 0.5, 8.0, 3.0
"""Of the safe distance, likewise."""
STAYS_BY_M = 5.0
"""So much nearer counts who has a slot already."""


@dataclass(frozen=True)
class Car:
    """A car in the ego's frame.

    Attributes:
        gap_m: From the ego's front to its rear along x; below 0 beside or behind [m].
        aside_m: Of its front's centre, to the left [m].
        speed_mps: Along x.
        heading_rad: Counterclockwise from x.
        apart_m: Of the two outlines, along x or y, whichever is more; below 0 in contact [m].
        ahead: Whether its centre is in front of the ego's.
        width_m: Side to side.
    """

    gap_m: float
    aside_m: float
    speed_mps: float
    heading_rad: float
    apart_m: float
    ahead: bool
    width_m: float

    @property
    def in_path(self) -> bool:
        """Whether it is ahead where the ego drives."""
        return self.ahead and abs(self.aside_m) < PATH_HALF_WIDTH_M + self.width_m / 2

    @property
    def in_view(self) -> bool:
        """Whether the camera sees it."""
        return 0.0 < self.gap_m < SIGHT_M and abs(self.aside_m) < VIEW_SLOPE * (
            self.gap_m + self.width_m
        )


@dataclass(frozen=True)
class Body:
    """Where SUMO has a car.

    Attributes:
        front_m: Centre of its front bumper, x and y in the world [m].
        angle_deg: Clockwise from north.
        speed_mps: Its speed.
        length_m: Bumper to bumper.
        width_m: Side to side.
    """

    front_m: tuple[float, float]
    angle_deg: float
    speed_mps: float
    length_m: float
    width_m: float


def seen_from(ego: Body, other: Body) -> Car:
    """The other car in the ego's frame; outlines are boxes along it."""
    along = math.radians(90.0 - ego.angle_deg)
    right = math.radians(ego.angle_deg - other.angle_deg)
    heading_rad = math.remainder(right, 2.0 * math.pi)
    east_m, north_m = (other.front_m[axis] - ego.front_m[axis] for axis in (0, 1))
    ahead_m = east_m * math.cos(along) + north_m * math.sin(along)
    aside_m = north_m * math.cos(along) - east_m * math.sin(along)
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    reach_m = abs(cosine) * other.length_m + abs(sine) * other.width_m
    spread_m = abs(sine) * other.length_m + abs(cosine) * other.width_m
    centre_m = ahead_m - cosine * other.length_m / 2 + ego.length_m / 2
    centre_aside_m = aside_m - sine * other.length_m / 2
    return Car(
        gap_m=centre_m - (reach_m + ego.length_m) / 2,
        aside_m=centre_aside_m,
        speed_mps=other.speed_mps * cosine,
        heading_rad=heading_rad,
        apart_m=max(
            abs(centre_m) - (reach_m + ego.length_m) / 2,
            abs(centre_aside_m) - (spread_m + ego.width_m) / 2,
        ),
        ahead=centre_m > 0.0,
        width_m=other.width_m,
    )


def leader_of(cars: Mapping[str, Car]) -> str | None:
    """The nearest car ahead in the ego's path."""
    ahead = [name for name, car in cars.items() if car.in_path]
    return min(ahead, key=lambda name: (cars[name].gap_m, name), default=None)


def perceived(cars: Mapping[str, Car], before: Sequence[str | None]) -> list[str | None]:
    """Who has each slot, given who had it a step ago."""
    leader = leader_of(cars)
    seen = {name: car for name, car in cars.items() if car.in_view}

    def rank(name: str) -> tuple[bool, float, str]:
        return name != leader, seen[name].gap_m - STAYS_BY_M * (name in before), name

    return kept_places(sorted(seen, key=rank)[: len(before)], before)


def pictured(
    cars: Mapping[str, Car], slots: Sequence[str | None], before: Sequence[str | None]
) -> list[str | None]:
    """Who of the others has each place in pictures."""
    rest = {name: car for name, car in cars.items() if name not in slots}

    def rank(name: str) -> tuple[float, str]:
        return abs(rest[name].gap_m) - STAYS_BY_M * (name in before), name

    return kept_places(sorted(rest, key=rank)[: len(before)], before)


def kept_places(wanted: Sequence[str], before: Sequence[str | None]) -> list[str | None]:
    """Places of those wanted: who has one keeps it, others take what was empty."""
    places = [name if name in wanted else None for name in before]
    empty = [index for index, name in enumerate(before) if name is None]
    new = [name for name in wanted if name not in before]
    for index, name in zip(empty, new, strict=False):
        places[index] = name
    return places


def safety_margin_m(ego_mps: float, leader: Car | None) -> float:
    """Gap less safe distance, of the car ahead in the path [m]."""
    if leader is None:
        return NOBODY_M
    lead_mps = max(leader.speed_mps, 0.0)
    braking_m = (ego_mps**2 - lead_mps**2) / (2.0 * BRAKING_MPS2)
    return leader.gap_m - max(ego_mps * REACTION_S + braking_m, 0.0)
