"""The ego of one encounter, for the highway-env back end; written from the specification alone."""

from collections.abc import Sequence
from typing import NamedTuple

from pemviz.config import EncounterConfig


class Told(NamedTuple):
    """A car that the ego is told of.

    Attributes:
        gap_m: Bumper to bumper [m].
        aside_m: To the left [m].
        closing_mps: By how much the ego is the faster one [m/s].
    """

    gap_m: float
    aside_m: float
    closing_mps: float


def acceleration(
    config: EncounterConfig, told: Sequence[Told], ego_mps: float, set_mps: float
) -> float:
    """The ego's acceleration [m/s^2]: cruise, time gap, hard braking by time to collision.

    Args:
        config: Gains and limits.
        told: The cars that it is told of.
        ego_mps: Its speed [m/s].
        set_mps: Its set speed [m/s].
    """
    in_path = [
        car
        for car in told
        if abs(car.aside_m) - config.car_width_m / 2 < config.path_half_width_m
        and car.gap_m + config.car_length_m > 0.0
    ]
    wishes = [config.speed_gain_per_s * (set_mps - ego_mps)]
    for car in in_path:
        wanted_m = config.standstill_gap_m + config.time_gap_s * ego_mps
        wishes.append(
            config.gap_gain_per_s2 * (car.gap_m - wanted_m)
            - config.closing_gain_per_s * car.closing_mps
        )
    wanted = min(
        max(min(wishes), -config.maximum_deceleration_mps2), config.maximum_acceleration_mps2
    )
    if any(_is_urgent(config, car) for car in in_path):
        wanted = -config.hard_deceleration_mps2
    return max(wanted, -ego_mps / config.dt_s)


def _is_urgent(config: EncounterConfig, car: Told) -> bool:
    """Whether the time to collision is too small."""
    stopping_s = car.closing_mps / (2.0 * config.hard_deceleration_mps2)
    needed_m = car.closing_mps * (stopping_s + config.hard_reserve_s)
    return car.closing_mps > 0.0 and car.gap_m < needed_m
