"""The braking scenario for a whole batch of rollouts at once."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, Move, namespace
from pemviz.simulators.braking.emergency_braking import brakes
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    SPEED_ERROR_INTEGRAL,
    BrakingScenario,
    Perceived,
)
from pemviz.types import StateBatch


@dataclass(frozen=True)
class VectorizedSimulator(BrakingScenario):
    """Explicit Euler steps of ``pemviz.simulators.braking``: positions, then speeds.

    The arithmetic works in place on arrays that a step has itself made, since the time goes
    into moving temporaries; the states it is given are never written to. On a device all states
    are of one step, whose number stays a number.
    """

    def moved(self, move: Move) -> Self | None:  # noqa: ARG002
        """Itself: it holds no arrays; ``None`` with errors, which numpy computes."""
        return self if self.errors is None else None

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states one time step on, for outcomes ``[N]`` and, with errors, noise ``[N, 1]``."""
        dt_s = self.config.dt_s
        ego_mps = states.signals[EGO_SPEED]
        lead_mps = states.signals[LEAD_SPEED]
        gap_m = lead_mps - ego_mps
        gap_m *= dt_s
        gap_m += states.signals[GAP]
        told = self.perceived(states, detected, noise)
        ego_mps2, integral_m = self._ego_acceleration(states, told)
        return StateBatch(
            step=states.step + 1,
            signals={
                GAP: gap_m,
                EGO_SPEED: _advance_speed(ego_mps, ego_mps2, dt_s),
                LEAD_SPEED: _advance_speed(lead_mps, self._lead_acceleration(states), dt_s),
            },
            memory={SPEED_ERROR_INTEGRAL: integral_m, **told.memory},
        )

    def _ego_acceleration(
        self, states: StateBatch, told: Perceived
    ) -> tuple[FloatArray, FloatArray]:
        """Commanded acceleration [m/s^2] and the speed error integral [m], both ``[N]``."""
        config = self.config
        error_mps = config.initial_speed_mps - states.signals[EGO_SPEED]
        held_m = states.memory[SPEED_ERROR_INTEGRAL]
        grown_m = error_mps * config.dt_s
        grown_m += held_m
        cruise_mps2 = error_mps
        cruise_mps2 *= config.speed_gain_per_s
        cruise_mps2 += config.speed_integral_gain_per_s2 * grown_m
        cruise_mps2 = cruise_mps2.clip(
            -config.maximum_deceleration_mps2, config.maximum_acceleration_mps2
        )
        emergency = brakes(told.present, told.gap_m, config)
        xp = namespace(emergency)
        return (
            xp.where(emergency, -config.emergency_deceleration_mps2, cruise_mps2),
            xp.where(emergency, held_m, grown_m),
        )

    def _lead_acceleration(self, states: StateBatch) -> FloatArray:
        """The lead car's acceleration [m/s^2], broadcasting to ``[N]``."""
        braking = states.step * self.config.dt_s >= self.config.lead_brake_time_s
        return np.where(braking, -self.config.lead_deceleration_mps2, 0.0)


def _advance_speed(speed_mps: FloatArray, wanted_mps2: FloatArray, dt_s: float) -> FloatArray:
    """Speeds after one step; a car that would reverse stands instead."""
    return (speed_mps + wanted_mps2 * dt_s).clip(0.0)
