"""How the ego drives: what it is told of other cars, with a tracker or without, and what it does.

Set speed, time gap, hard braking. Arrays have a row for each other car, ``[K, N]``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.encounter_signals import by_car, of_cars
from pemviz.simulators.tracking.tracker import Tracker

MEASURED_CLOSING = "measured_closing"
"""Memory: closing speed at a car's last hit, where the tracker's filter has no speeds."""


@dataclass(frozen=True)
class Reported:
    """What perception reports of other cars, or the controller is told of them, ``[K, N]``.

    Whether it is told of a car at all, where the rest counts; gaps from bumper to bumper [m],
    offsets to the left [m], and by how much the ego is the faster one [m/s].
    """

    there: BoolArray
    gap_m: FloatArray
    aside_m: FloatArray
    closing_mps: FloatArray


def nothing_reported(
    tracker: Tracker | None, cars: Sequence[str], count: int
) -> dict[str, AnyArray]:
    """What states remember before any outcome, arrays ``[count]``."""
    if tracker is None:
        return {}
    none = np.zeros((len(cars), count))
    closing = {} if tracker.has_speeds else by_car(MEASURED_CLOSING, cars, none)
    return {**tracker.memory(tracker.start(count, slots=len(cars))), **closing}


def reported_after(
    tracker: Tracker | None,
    cars: Sequence[str],
    memory: Mapping[str, AnyArray],
    measured: Reported,
) -> tuple[Reported, dict[str, AnyArray]]:
    """What the controller is told of what perception reports, and what the next states remember.

    Args:
        tracker: Between perception and controller, if there is one.
        cars: Names of the K other cars.
        memory: Of the states in which perception acted.
        measured: What it reports.
    """
    if tracker is None:
        return measured, {}
    before = tracker.state(memory, slots=len(cars))
    positions_m = np.stack([measured.gap_m.T, measured.aside_m.T], axis=-1)
    tracks = tracker.update(before, measured.there.T, positions_m)
    if tracker.has_speeds:
        closing_mps, kept = -tracks.speed_mps[..., 0].T, {}
    else:
        held_mps = of_cars(MEASURED_CLOSING, cars, memory)
        closing_mps = np.where(measured.there, measured.closing_mps, held_mps)
        kept = by_car(MEASURED_CLOSING, cars, closing_mps)
    gap_m, aside_m = tracks.position_m[..., 0].T, tracks.position_m[..., 1].T
    reported = Reported(tracks.confirmed.T, gap_m, aside_m, closing_mps)
    return reported, {**tracker.memory(tracks), **kept}


def acceleration(
    config: EncounterConfig, reported: Reported, *, ego_mps: FloatArray, set_mps: FloatArray
) -> FloatArray:
    """What the ego does for a step ``[N]`` [m/s^2], at a speed, towards its set speed ``[N]``."""
    heeded = reported.there & in_path(config, reported.gap_m, reported.aside_m)
    follow = follow_acceleration(config, reported.gap_m, reported.closing_mps, ego_mps)
    wanted = np.minimum(
        config.speed_gain_per_s * (set_mps - ego_mps),
        np.where(heeded, follow, np.inf).min(axis=0),
    ).clip(-config.maximum_deceleration_mps2, config.maximum_acceleration_mps2)
    hard = (heeded & is_urgent(config, reported.gap_m, reported.closing_mps)).any(axis=0)
    braked = np.where(hard, -config.hard_deceleration_mps2, wanted)
    return np.maximum(braked, -ego_mps / config.dt_s)


def in_path(config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray) -> BoolArray:
    """Whether cars at gaps and offsets ``[...]`` [m] are in the ego's path."""
    return is_beside(config, aside_m) & (gap_m + config.car_length_m > 0.0)


def is_beside(
    config: EncounterConfig, aside_m: FloatArray, *, wider_m: FloatArray | float = 0.0
) -> BoolArray:
    """Whether cars at offsets ``[...]`` [m] are in the path, ahead or not, if ``wider_m`` wider."""
    reach_m = config.path_half_width_m + config.car_width_m / 2 + wider_m
    return np.abs(aside_m) < reach_m


def follow_acceleration(
    config: EncounterConfig, gap_m: FloatArray, closing_mps: FloatArray, ego_mps: FloatArray
) -> FloatArray:
    """What keeping the time gap to a car asks for, ``[...]`` [m/s^2]."""
    kept_m = config.standstill_gap_m + config.time_gap_s * ego_mps
    return config.gap_gain_per_s2 * (gap_m - kept_m) - config.closing_gain_per_s * closing_mps


def is_urgent(config: EncounterConfig, gap_m: FloatArray, closing_mps: FloatArray) -> BoolArray:
    """Whether the time to collision is too small, ``[...]``."""
    needed_s = closing_mps / (2.0 * config.hard_deceleration_mps2) + config.hard_reserve_s
    return (closing_mps > 0.0) & (gap_m < closing_mps * needed_s)
