"""What the rules ask for: safe distance, reason to brake, the regulation's line for cut-ins.

Arrays have a row for each other car, ``[K, N]``.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig

INTRUSION_M = 0.3
"""Beyond the lane marking: where a car that cuts in has come into the lane (UN R157, 5.2.5.2)."""
SEEN_S = 0.72
"""For so long its lateral movement must have been to be seen by then."""
ASSUMED_DECELERATION_MPS2 = 6.0
ASSUMED_DELAY_S = 0.35
UNAVOIDABLE_S = -10.0
"""Also before there is a cut-in; its opposite bounds the other side."""


@dataclass(frozen=True)
class Cars:
    """A state's cars.

    Attributes:
        ego_mps: The ego's speed ``[N]`` [m/s].
        gap_m: ``[K, N]`` bumper to bumper [m].
        aside_m: ``[K, N]`` to the left of the ego [m].
        along_mps: ``[K, N]`` speed along the road [m/s].
    """

    ego_mps: FloatArray
    gap_m: FloatArray
    aside_m: FloatArray
    along_mps: FloatArray


def clearance(config: EncounterConfig, cars: Cars) -> FloatArray:
    """Distance from the ego to the nearest car, along the road or across, ``[N]`` [m]."""
    along = np.abs(cars.gap_m + config.car_length_m) - config.car_length_m
    return np.maximum(along, np.abs(cars.aside_m) - config.car_width_m).min(axis=0)


def ahead_in_lane(config: EncounterConfig, cars: Cars) -> BoolArray:
    """Which cars are, with any part of theirs, ``[K, N]``."""
    return is_ahead_in_lane(config, cars.gap_m, cars.aside_m)


def is_ahead_in_lane(config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray) -> BoolArray:
    """Whether cars at gaps and offsets ``[...]`` [m] are ahead in the ego's lane."""
    reach_m = (config.lane_width_m + config.car_width_m) / 2
    return (np.abs(aside_m) < reach_m) & (gap_m + config.car_length_m > 0.0)


def nearest_ahead(config: EncounterConfig, cars: Cars) -> BoolArray:
    """Which of those is the nearest, ``[K, N]``; the first in order, if several are."""
    ahead = ahead_in_lane(config, cars)
    nearest = np.where(ahead, cars.gap_m, np.inf).argmin(axis=0)
    return ahead & (np.arange(len(ahead))[:, None] == nearest)


def distance_margin(config: EncounterConfig, cars: Cars) -> FloatArray:
    """Gaps less the safe distances, ``[K, N]`` [m] (Maierhofer et al. 2020, eq. of R_G1)."""
    braking_m = (cars.ego_mps**2 - cars.along_mps**2) / (2.0 * config.hard_deceleration_mps2)
    return cars.gap_m - (braking_m + config.reaction_time_s * cars.ego_mps).clip(0.0)


def recovery_steps(config: EncounterConfig) -> int:
    """For how many states there is time to recover the distance to a car that has come."""
    return int(np.floor(config.recovery_time_s / config.dt_s + 1e-9))


def settled_distance(config: EncounterConfig, cars: Cars, states_ahead: IntArray) -> FloatArray:
    """Margin to the nearest car ahead in lane, if there was time to recover, ``[N]`` [m].

    Args:
        config: The encounter.
        cars: The state's.
        states_ahead: For how many states up to this one each car is the nearest, ``[K, N]``.
    """
    counts, bound_m = states_ahead > recovery_steps(config), config.gap_bound_m
    margins_m = np.where(counts, distance_margin(config, cars), bound_m)
    return margins_m.min(axis=0).clip(-bound_m, bound_m)


def needless_deceleration(
    config: EncounterConfig, cars: Cars, *, ego_mps2: FloatArray, others_mps2: FloatArray
) -> FloatArray:
    """By how much a step's braking exceeds what there is a reason for, ``[N]`` [m/s^2].

    Args:
        config: The encounter.
        cars: Of the state at which the step begins.
        ego_mps2: The ego's acceleration in it, ``[N]`` [m/s^2].
        others_mps2: The other cars' deceleration, ``[K, N]`` [m/s^2].
    """
    ahead = ahead_in_lane(config, cars)
    too_near = (ahead & (distance_margin(config, cars) < 0.0)).any(axis=0)
    own = -ego_mps2 - np.where(nearest_ahead(config, cars), others_mps2, 0.0).sum(axis=0)
    return np.where(too_near, 0.0, own.clip(0.0))


def has_come_in(config: EncounterConfig, aside_m: FloatArray) -> BoolArray:
    """Whether a car at ``[...]`` [m] has come into the lane by the regulation's measure."""
    near_side_m = np.abs(aside_m) - config.car_width_m / 2
    return near_side_m <= config.lane_width_m / 2 - INTRUSION_M


def avoidable_by(cars: Cars, *, begin_s: FloatArray, time_s: float) -> FloatArray:
    """The regulation's margin of a car that has come into the lane, ``[N]`` [s].

    Args:
        cars: The state's, that one first.
        begin_s: When its lateral movement began, ``[N]`` [s].
        time_s: The state's.
    """
    closing_mps = cars.ego_mps - cars.along_mps[0]
    closes = closing_mps > 0.0
    collides_s = cars.gap_m[0] / np.where(closes, closing_mps, 1.0)
    needed_s = closing_mps / (2.0 * ASSUMED_DECELERATION_MPS2) + ASSUMED_DELAY_S
    margin_s = np.where(closes, collides_s - needed_s, -UNAVOIDABLE_S)
    margin_s = np.where(time_s < begin_s + SEEN_S, UNAVOIDABLE_S, margin_s)
    return margin_s.clip(UNAVOIDABLE_S, -UNAVOIDABLE_S)
