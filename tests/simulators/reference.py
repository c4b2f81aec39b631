"""A tracker and the docstring of ``pemviz.simulators.braking`` in plain Python, one at a time."""

from collections.abc import Sequence

import numpy as np

from pemviz import Kalman
from pemviz.config import ScenarioConfig
from pemviz.simulators.tracking.filters import LastPosition


class OneTrack:
    """The same for one obstacle, with lists and matrices, as a text book would have it."""

    def __init__(self, tracker):
        self.tracker, self.outcomes, self.confirmed, self.x, self.p = tracker, [], False, None, None
        self.dt_s = tracker.dt_s

    def update(self, hit, z):
        tracker = self.tracker
        self.outcomes.append(hit)
        self._filter(hit, z)
        if self.confirmed:
            misses = next((i for i, seen in enumerate(reversed(self.outcomes)) if seen), None)
            if misses is None or misses * self.dt_s > tracker.coast_s + 1e-6:
                self.__init__(tracker)
        elif sum(self.outcomes[-tracker.window :]) >= tracker.hits:
            self.confirmed = True
        elif not any(self.outcomes[-tracker.window + 1 :]) or tracker.window == 1:
            self.__init__(tracker)

    def _filter(self, hit, z):
        dt_s = self.dt_s
        f = np.array([[1.0, dt_s], [0.0, 1.0]])
        kind = self.tracker.filter
        if self.x is None:
            if hit:
                self.x = np.array([z, np.zeros_like(z)])
                if isinstance(kind, Kalman):
                    self.p = np.diag([kind.position_sd_m, kind.first_speed_sd_mps]) ** 2.0
            return
        if kind == LastPosition():
            self.x = np.array([z, np.zeros_like(z)]) if hit else self.x
            return
        self.x = f @ self.x
        if isinstance(kind, Kalman):
            g = np.array([dt_s**2 / 2.0, dt_s])
            self.p = f @ self.p @ f.T + np.outer(g, g) * kind.acceleration_sd_mps2**2
            s = self.p[0, 0] + kind.position_sd_m**2
            gain = self.p[:, 0] / s
        else:
            beta = kind.alpha**2 / (2 - kind.alpha) if kind.beta is None else kind.beta
            gain = np.array([kind.alpha, beta / dt_s])
        if hit:
            self.x = self.x + np.outer(gain, z - self.x[0])
            if isinstance(kind, Kalman):
                self.p = self.p - np.outer(gain, gain) * s


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
    reported = []
    for step, is_detected in enumerate(detected):
        seen = is_detected
        reported.append(gap if measure is None else measure(step, gap))
        if follows is not None:
            follows.update(is_detected, np.array([reported[-1]]))
            seen = follows.confirmed
            reported[-1] = float(follows.x[0, 0]) if seen else gap
        if seen and reported[-1] < config.emergency_gap_m:
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
    return {**track, "reported": reported}
