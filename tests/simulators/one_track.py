"""A tracker of one obstacle, written out."""

import numpy as np

from pemviz import Kalman
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
