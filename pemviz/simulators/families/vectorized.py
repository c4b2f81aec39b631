"""Encounters of a family for a whole batch of rollouts at once."""

from dataclasses import dataclass

import numpy as np

from pemviz.simulators.families.arrival import Left, Moved
from pemviz.simulators.families.names import EGO_SPEED, EGO_X, OF_EACH
from pemviz.simulators.families.scenario import FamilyScenario


@dataclass(frozen=True)
class VectorizedFamily(FamilyScenario):
    """Explicit Euler steps of ``pemviz.simulators.families``: positions, then speeds."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    def moved_cars(self, left: Left) -> Moved:
        """Where all cars are a step on if none touches another."""
        dt_s, signals = self.config.dt_s, left.states.signals
        gap_m, aside_m, speed_mps, heading_rad = (left.of_cars(what) for what in OF_EACH)
        ego_m, ego_mps = signals[EGO_X], signals[EGO_SPEED]
        x_m = ego_m + gap_m + self.config.car_length_m
        return Moved(
            ego_x_m=ego_m + ego_mps * dt_s,
            ego_mps=(ego_mps + left.ego_mps2 * dt_s).clip(0.0),
            x_m=x_m + speed_mps * np.cos(heading_rad) * dt_s,
            y_m=aside_m + speed_mps * np.sin(heading_rad) * dt_s,
            speed_mps=(speed_mps - left.others_mps2 * dt_s).clip(0.0),
        )
