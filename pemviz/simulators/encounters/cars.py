"""The other cars of an encounter: where they begin, and what they do whatever the ego does.

Arrays have a row for each car, ``[K, ...]``.
"""

from collections.abc import Mapping

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import EncounterConfig

HALVINGS = 60
"""Of the interval from 0 to 1: as many as double precision tells apart."""
LARGEST_SINE = 0.3
"""Of a heading."""
NEIGHBOUR = "neighbour"
CARS: Mapping[str, tuple[str, ...]] = {
    "braking": ("lead",),
    "cut-in": ("cutting_in", "lead"),
    "cut-out": ("lead", "revealed"),
}
KEPT: Mapping[str, tuple[str, ...]] = {
    "braking": ("ego_speed", "brake_time", "deceleration"),
    "cut-in": ("ego_speed", "cut_in_time", "duration"),
    "cut-out": ("ego_speed", "cut_out_time", "duration"),
}
"""Start values that steps need, by logical scenario."""
START_PLANES: Mapping[str, tuple[str, str]] = {
    "braking": ("gap", "deceleration"),
    "cut-in": ("gap", "closing_speed"),
    "cut-out": ("gap", "margin"),
}

Values = Mapping[str, FloatArray]


def car_names(config: EncounterConfig) -> tuple[str, ...]:
    """The K other cars, in the order of their slots."""
    own = CARS[config.logical_scenario]
    return (*own, NEIGHBOUR) if config.neighbour else own


def begun_cars(
    config: EncounterConfig, values: Values
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gaps [m], offsets to the left [m] and speeds [m/s] at s_0, ``[K, N]``, for start values."""
    ego_mps, gap_m = values["ego_speed"], values["gap"]
    lane_m, width_m = config.lane_width_m, config.car_width_m
    slower_mps = np.maximum(ego_mps - values["closing_speed"], 0.0)
    gaps_m, speeds_mps = [gap_m], [slower_mps]
    if config.logical_scenario == "cut-in":
        crossing_share = _share_of((lane_m - width_m) / (2.0 * lane_m))
        until_s = values["cut_in_time"] + crossing_share * values["duration"]
        gap_m = gap_m + np.minimum(values["closing_speed"], ego_mps) * until_s
        gaps_m = [gap_m, gap_m + config.car_length_m + values["lead_gap"]]
        speeds_mps.append(ego_mps)
    elif config.logical_scenario == "cut-out":
        revealed_mps = values["revealed_speed"]
        clear_s = values["cut_out_time"] + _share_of(width_m / lane_m) * values["duration"]
        until_touch_s = clear_s + values["margin"]
        approached_m = np.maximum(slower_mps - revealed_mps, 0.0) * until_touch_s
        gaps_m.append(gap_m + config.car_length_m + approached_m)
        speeds_mps.append(revealed_mps)
    if config.neighbour:
        gaps_m.append(values["neighbour_gap"])
        speeds_mps.append(ego_mps)
    aside_m = lateral_places(config, values, time_s=0.0)
    return np.stack(gaps_m), aside_m, np.stack(speeds_mps)


def lateral_places(config: EncounterConfig, values: Values, *, time_s: float) -> FloatArray:
    """Where the profile of each car has it at a time, ``[K, N]`` [m] to the left of the ego."""
    shape = np.shape(values["ego_speed"])
    places = [np.zeros(shape) for _ in CARS[config.logical_scenario]]
    beside_m = config.lane_width_m * (1.0 if config.side == "left" else -1.0)
    if config.logical_scenario != "braking":
        begin_s = values["cut_in_time" if config.logical_scenario == "cut-in" else "cut_out_time"]
        share = minimum_jerk((time_s - begin_s) / values["duration"])
        from_m, to_m = (beside_m, 0.0) if config.logical_scenario == "cut-in" else (0.0, beside_m)
        places[0] = from_m + (to_m - from_m) * share
    if config.neighbour:
        places.append(np.full(shape, -beside_m))
    return np.stack(places)


def decelerations(config: EncounterConfig, values: Values, *, time_s: float) -> FloatArray:
    """How hard each car brakes in the step that begins at a time, ``[K, N]`` [m/s^2]."""
    result = np.zeros((len(car_names(config)), *np.shape(values["ego_speed"])))
    if config.logical_scenario == "braking":
        result[0] = np.where(time_s >= values["brake_time"], values["deceleration"], 0.0)
    return result


def headings(
    aside_m: FloatArray, next_m: FloatArray, speed_mps: FloatArray, before: FloatArray, dt_s: float
) -> FloatArray:
    """Headings ``[K, N]`` [rad] that bring cars to where their profile has them a step later.

    Cars that stand keep theirs.
    """
    moves = speed_mps > 0.0
    wanted = (next_m - aside_m) / np.where(moves, speed_mps * dt_s, 1.0)
    return np.where(moves, np.arcsin(wanted.clip(-LARGEST_SINE, LARGEST_SINE)), before)


def minimum_jerk(share: FloatArray) -> FloatArray:
    """S(u) = 10 u^3 - 15 u^4 + 6 u^5 between 0 and 1, ``[...]`` (Flash & Hogan 1985)."""
    u = np.asarray(share).clip(0.0, 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


def _share_of(wanted: float) -> float:
    """The share u of its duration with S(u) = ``wanted``; 0 or 1 where that lies beyond."""
    if not 0.0 < wanted < 1.0:
        return float(wanted >= 1.0)
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        below = float(minimum_jerk(np.asarray(middle))) < wanted
        low, high = (middle, high) if below else (low, middle)
    return high
