"""The signals of an encounter: their names, and what the rules ask for.

That is safe distance, reason to brake, and the regulation's line for cut-ins. Arrays have a row for
each other car, ``[K, N]``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig
from pemviz.types import Signal

EGO_X = "ego_x"
EGO_SPEED = "ego_speed"
EGO_ACCELERATION = "ego_acceleration"
CLEARANCE = "clearance"
SAFE_DISTANCE = "safe_distance"
NEEDLESS = "needless_deceleration"
AVOIDABLE_BY = "avoidable_by"
COLLIDED = "collided"
IMPACT_SPEED = "impact_speed"

GAP, ASIDE, SPEED, HEADING = OF_EACH = ("gap", "aside", "speed", "heading")
"""What there is of every other car, as ``gap_NAME``."""
FALSE_POSITIVE = "ghost"
"""A slot that is about no car."""
LARGEST_MPS2 = 20.0
WIDEST_M = 50.0
INTRUSION_M = 0.3
"""Beyond the lane marking: where a car that cuts in has come into the lane (UN R157, 5.2.5.2)."""
SEEN_S = 0.72
"""For so long its lateral movement must have been to be seen by then."""
ASSUMED_DECELERATION_MPS2 = 6.0
ASSUMED_DELAY_S = 0.35
UNAVOIDABLE_S = -10.0
"""Also before there is a cut-in; its opposite bounds the other side."""


@dataclass(frozen=True, eq=False)
class CarStates:
    """The other cars, and perhaps the ghost last, ``[K, ...]``.

    Gaps are from bumper to bumper along the road, offsets to the left of the ego, headings
    counterclockwise from the road.
    """

    gap_m: FloatArray
    aside_m: FloatArray
    speed_mps: FloatArray
    heading_rad: FloatArray

    @staticmethod
    def of(names: Sequence[str], signals: Mapping[str, FloatArray]) -> "CarStates":
        """Those with these names."""
        return CarStates(*(of_cars(what, names, signals) for what in OF_EACH))

    @cached_property
    def along_mps(self) -> FloatArray:
        """Speeds along the road [m/s]."""
        return self.speed_mps * np.cos(self.heading_rad)

    def first(self, count: int) -> "CarStates":
        """So many."""
        each = (self.gap_m, self.aside_m, self.speed_mps, self.heading_rad)
        return CarStates(*(rows[:count] for rows in each))

    def signals(self, names: Sequence[str]) -> dict[str, FloatArray]:
        """Their signals."""
        each = (self.gap_m, self.aside_m, self.speed_mps, self.heading_rad)
        by_what = (by_car(what, names, rows) for what, rows in zip(OF_EACH, each, strict=True))
        return {name: values for found in by_what for name, values in found.items()}


def of_cars(what: str, cars: Sequence[str], signals: Mapping[str, AnyArray]) -> AnyArray:
    """One signal, or a part of a memory, of all cars, ``[K, ...]``."""
    return np.stack([signals[f"{what}_{car}"] for car in cars])


def by_car(what: str, cars: Sequence[str], values: AnyArray) -> dict[str, AnyArray]:
    """Arrays ``[K, ...]`` as one for each car by name."""
    return {f"{what}_{car}": one for car, one in zip(cars, values, strict=True)}


def encounter_signals(config: EncounterConfig, names: Sequence[str]) -> tuple[Signal, ...]:
    """All signals of slots with these names, with the bounds that the agm metric normalises by."""
    gap_m, speed_mps = config.gap_bound_m, config.speed_bound_mps
    found = [
        Signal(EGO_X, "ego_x_m", "m", -gap_m, gap_m),
        Signal(EGO_SPEED, "ego_speed_mps", "m/s", 0.0, speed_mps),
        Signal(EGO_ACCELERATION, f"{EGO_ACCELERATION}_mps2", "m/s^2", -LARGEST_MPS2, LARGEST_MPS2),
    ]
    for name in names:
        found += [
            Signal(f"{GAP}_{name}", f"{GAP}_{name}_m", "m", -gap_m, gap_m),
            Signal(f"{ASIDE}_{name}", f"{ASIDE}_{name}_m", "m", -WIDEST_M, WIDEST_M),
            Signal(f"{SPEED}_{name}", f"{SPEED}_{name}_mps", "m/s", 0.0, speed_mps),
            Signal(f"{HEADING}_{name}", f"{HEADING}_{name}_rad", "rad", -1.0, 1.0),
        ]
    found += [
        Signal(CLEARANCE, "clearance_m", "m", -gap_m, gap_m),
        Signal(SAFE_DISTANCE, "safe_distance_m", "m", -gap_m, gap_m),
        Signal(NEEDLESS, f"{NEEDLESS}_mps2", "m/s^2", 0.0, LARGEST_MPS2),
    ]
    if config.logical_scenario == "cut-in":
        found.append(Signal(AVOIDABLE_BY, "avoidable_by_s", "s", UNAVOIDABLE_S, -UNAVOIDABLE_S))
    return (
        *found,
        Signal(COLLIDED, COLLIDED, "", 0.0, 1.0),
        Signal(IMPACT_SPEED, "impact_speed_mps", "m/s", 0.0, speed_mps),
    )


def clearance(config: EncounterConfig, cars: CarStates) -> FloatArray:
    """Distance from the ego to the nearest car, along the road or across, ``[N]`` [m]."""
    along = np.abs(cars.gap_m + config.car_length_m) - config.car_length_m
    return np.maximum(along, np.abs(cars.aside_m) - config.car_width_m).min(axis=0)


def ahead_in_lane(config: EncounterConfig, cars: CarStates) -> BoolArray:
    """Which cars are, with any part of theirs, ``[K, ...]``."""
    reach_m = (config.lane_width_m + config.car_width_m) / 2
    return (np.abs(cars.aside_m) < reach_m) & (cars.gap_m + config.car_length_m > 0.0)


def nearest_ahead(config: EncounterConfig, cars: CarStates) -> BoolArray:
    """Which of those is the nearest, ``[K, N]``; the first in order, if several are."""
    ahead = ahead_in_lane(config, cars)
    nearest = np.where(ahead, cars.gap_m, np.inf).argmin(axis=0)
    return ahead & (np.arange(len(ahead))[:, None] == nearest)


def distance_margin(config: EncounterConfig, cars: CarStates, ego_mps: FloatArray) -> FloatArray:
    """Gaps less the safe distances, ``[K, N]`` [m] (Maierhofer et al. 2020, eq. of R_G1)."""
    braking_m = (ego_mps**2 - cars.along_mps**2) / (2.0 * config.hard_deceleration_mps2)
    return cars.gap_m - (braking_m + config.reaction_time_s * ego_mps).clip(0.0)


def settled_distance(
    config: EncounterConfig, cars: CarStates, ego_mps: FloatArray, states_ahead: IntArray
) -> FloatArray:
    """Margin to the nearest car ahead in lane, if there was time to recover, ``[N]`` [m].

    Each car is the nearest for so many states up to this one: ``states_ahead [K, N]``.
    """
    recovery_steps = int(np.floor(config.recovery_time_s / config.dt_s + 1e-9))
    counts, bound_m = states_ahead > recovery_steps, config.gap_bound_m
    margins_m = np.where(counts, distance_margin(config, cars, ego_mps), bound_m)
    return margins_m.min(axis=0).clip(-bound_m, bound_m)


def needless_deceleration(
    config: EncounterConfig,
    cars: CarStates,
    ego_mps: FloatArray,
    *,
    ego_mps2: FloatArray,
    others_mps2: FloatArray,
) -> FloatArray:
    """By how much a step's braking exceeds what there is a reason for, ``[N]`` [m/s^2].

    Args:
        config: The encounter.
        cars: Of the state at which the step begins.
        ego_mps: The ego's speed there, ``[N]``.
        ego_mps2: Its acceleration in the step, ``[N]``.
        others_mps2: The other cars' deceleration, ``[K, N]``.
    """
    ahead = ahead_in_lane(config, cars)
    too_near = (ahead & (distance_margin(config, cars, ego_mps) < 0.0)).any(axis=0)
    own = -ego_mps2 - np.where(nearest_ahead(config, cars), others_mps2, 0.0).sum(axis=0)
    return np.where(too_near, 0.0, own.clip(0.0))


def has_come_in(config: EncounterConfig, aside_m: FloatArray) -> BoolArray:
    """Whether a car at ``[...]`` [m] has come into the lane by the regulation's measure."""
    near_side_m = np.abs(aside_m) - config.car_width_m / 2
    return near_side_m <= config.lane_width_m / 2 - INTRUSION_M


def avoidable_by(
    cars: CarStates, ego_mps: FloatArray, *, begin_s: FloatArray, time_s: float
) -> FloatArray:
    """The regulation's margin of the first car, if it has come into the lane, ``[N]`` [s].

    Its lateral movement began at ``begin_s [N]``.
    """
    closing_mps = ego_mps - cars.along_mps[0]
    closes = closing_mps > 0.0
    collides_s = cars.gap_m[0] / np.where(closes, closing_mps, 1.0)
    needed_s = closing_mps / (2.0 * ASSUMED_DECELERATION_MPS2) + ASSUMED_DELAY_S
    margin_s = np.where(closes, collides_s - needed_s, -UNAVOIDABLE_S)
    margin_s = np.where(time_s < begin_s + SEEN_S, UNAVOIDABLE_S, margin_s)
    return margin_s.clip(UNAVOIDABLE_S, -UNAVOIDABLE_S)
