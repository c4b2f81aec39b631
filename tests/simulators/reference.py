"""The docstring of ``pemviz.simulators.braking`` in plain Python, one rollout at a time."""

from collections.abc import Sequence

from pemviz.config import ScenarioConfig


def reference_rollout(config: ScenarioConfig, detected: Sequence[bool]) -> dict[str, list[float]]:
    """T values for each signal and for the controller's memory."""
    target = config.initial_speed_kmh * 1000 / 3600
    gap, ego, lead, integral = config.initial_gap_m, target, target, 0.0
    track = {"gap": [gap], "ego_speed": [ego], "lead_speed": [lead], "integral": [integral]}
    for step, seen in enumerate(detected):
        if seen and gap < config.emergency_gap_m:
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
    return track
