"""The braking scenario for a whole batch of rollouts at once."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    SPEED_ERROR_INTEGRAL,
    lead_car_salient,
    scenario_signals,
)
from pemviz.types import Signal, StateBatch


@dataclass(frozen=True)
class VectorizedSimulator:
    """Explicit Euler steps of DESIGN section 3: positions with the old speeds, then speeds."""

    config: ScenarioConfig

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.config.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.config.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """Gap [m], ego speed and lead speed [m/s]."""
        return scenario_signals(self.config)

    def initial(self, *, count: int) -> StateBatch:
        """Both cars at the initial speed, arrays ``[count]``."""
        speed_mps = np.full(count, self.config.initial_speed_mps)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={
                GAP: np.full(count, self.config.initial_gap_m),
                EGO_SPEED: speed_mps,
                LEAD_SPEED: speed_mps,
            },
            memory={SPEED_ERROR_INTEGRAL: np.zeros(count)},
        )

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The states one time step on, for outcomes ``[N]``."""
        dt_s = self.config.dt_s
        gap_m = states.signals[GAP]
        ego_mps = states.signals[EGO_SPEED]
        lead_mps = states.signals[LEAD_SPEED]
        ego_mps2, integral_m = self._ego_acceleration(states, detected)
        return StateBatch(
            step=states.step + 1,
            signals={
                GAP: gap_m + (lead_mps - ego_mps) * dt_s,
                EGO_SPEED: _advance_speed(ego_mps, ego_mps2, dt_s),
                LEAD_SPEED: _advance_speed(lead_mps, self._lead_acceleration(states), dt_s),
            },
            memory={SPEED_ERROR_INTEGRAL: integral_m},
        )

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The lead car's salient variables ``[..., 11]``."""
        return lead_car_salient(self.config, signals)

    def _ego_acceleration(
        self, states: StateBatch, detected: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Commanded acceleration [m/s^2] and the speed error integral [m], both ``[N]``."""
        config = self.config
        error_mps = config.initial_speed_mps - states.signals[EGO_SPEED]
        held_m = states.memory[SPEED_ERROR_INTEGRAL]
        grown_m = held_m + error_mps * config.dt_s
        cruise_mps2 = np.clip(
            config.speed_gain_per_s * error_mps + config.speed_integral_gain_per_s2 * grown_m,
            -config.maximum_deceleration_mps2,
            config.maximum_acceleration_mps2,
        )
        emergency = detected & (states.signals[GAP] < config.emergency_gap_m)
        return (
            np.where(emergency, -config.emergency_deceleration_mps2, cruise_mps2),
            np.where(emergency, held_m, grown_m),
        )

    def _lead_acceleration(self, states: StateBatch) -> FloatArray:
        """The lead car's acceleration [m/s^2], broadcasting to ``[N]``."""
        braking = states.step * self.config.dt_s >= self.config.lead_brake_time_s
        return np.where(braking, -self.config.lead_deceleration_mps2, 0.0)


def _advance_speed(speed_mps: FloatArray, wanted_mps2: FloatArray, dt_s: float) -> FloatArray:
    """Speeds after one step; a car that would reverse stands instead."""
    return np.maximum(speed_mps + wanted_mps2 * dt_s, 0.0)
