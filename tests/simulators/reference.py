"""The docstring of ``pemviz.simulators.braking`` in plain Python, one rollout at a time."""

from collections.abc import Sequence

import numpy as np

from pemviz.config import ScenarioConfig
from tests.simulators.one_track import OneTrack


def reference_rollout(
    config: ScenarioConfig, detected: Sequence[bool], tracker=None, measure=None
) -> dict[str, list[float]]:
    """T values for each signal and for the controller's memory; T - 1 gaps that it is told.

    With ``measure`` a step and its gap give the gap that perception measures there.
    """
    follows = None if tracker is None else OneTrack(tracker)
    target = config.initial_speed_kmh * 1000 / 3600
    gap, ego, lead, integral = config.initial_gap_m, target, target, 0.0
    track = {"gap": [gap], "ego_speed": [ego], "lead_speed": [lead], "integral": [integral]}
    told = []
    for step, is_detected in enumerate(detected):
        seen = is_detected
        told.append(gap if measure is None else measure(step, gap))
        if follows is not None:
            follows.update(is_detected, np.array([told[-1]]))
            seen = follows.confirmed
            told[-1] = float(follows.x[0, 0]) if seen else gap
        if seen and told[-1] < config.emergency_gap_m:
            ego_acceleration = -config.emergency_deceleration_mps2
        else:
            error = target - ego
            integral = integral + error * config.dt_s
            ego_acceleration = (
                config.speed_gain_per_s * error + config.speed_integral_gain_per_s2 * integral
            )
            if ego_acceleration > config.maximum_acceleration_mps2:
                ego_acceleration = config.maximum_acceleration_mps2
            if ego_acceleration < -config.maximum_deceleration_mps2:
                ego_acceleration = -config.maximum_deceleration_mps2
        lead_acceleration = 0.0
        if step * config.dt_s >= config.lead_brake_time_s:
            lead_acceleration = -config.lead_deceleration_mps2
        gap = gap + lead * config.dt_s - ego * config.dt_s
        ego = max(0.0, ego + max(ego_acceleration, -ego / config.dt_s) * config.dt_s)
        lead = max(0.0, lead + max(lead_acceleration, -lead / config.dt_s) * config.dt_s)
        for name, value in zip(track, (gap, ego, lead, integral), strict=True):
            track[name].append(value)
    return {**track, "told": told}
