"""The braking scenario for a whole batch of rollouts at once."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.simulators.braking.compiled import CompiledRollouts, compiled_loops
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    SPEED_ERROR_INTEGRAL,
    BrakingScenario,
    Perceived,
    brakes,
)
from pemviz.simulators.signal_bounds import SignalBounds
from pemviz.types import RolloutBatch, StateBatch

ROUNDING = 1e-3
"""By which bounds of signals are wider than they would be without rounding [m, m/s]."""


@dataclass(frozen=True)
class VectorizedSimulator(BrakingScenario):
    """Explicit Euler steps of ``pemviz.simulators.braking``: positions, then speeds.

    The arithmetic works in place on arrays that a step has itself made, since the time goes
    into moving temporaries; the states it is given are never written to.
    """

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The states one time step on, for outcomes ``[N]`` and, with errors, noise ``[N, 1]``."""
        config, dt_s = self.config, self.config.dt_s
        perceived = self.perceived(states, detected, noise)
        ego_mps2, integral_m = self._ego_acceleration(states, perceived)
        braking = states.step * dt_s >= config.lead_brake_time_s
        lead_mps2 = np.where(braking, -config.lead_deceleration_mps2, 0.0)
        return StateBatch(
            step=states.step + 1,
            signals=self._driven(states, ego_mps2, lead_mps2),
            memory={SPEED_ERROR_INTEGRAL: integral_m, **perceived.memory},
        )

    def _driven(
        self, states: StateBatch, ego_mps2: FloatArray, lead_mps2: FloatArray
    ) -> dict[str, FloatArray]:
        """The signals a step on, with accelerations ``[N]``, or one for all [m/s^2]."""
        dt_s = self.config.dt_s
        ego_mps, lead_mps = states.signals[EGO_SPEED], states.signals[LEAD_SPEED]
        gap_m = lead_mps - ego_mps
        gap_m *= dt_s
        gap_m += states.signals[GAP]
        return {  # a car that would reverse stands instead
            GAP: gap_m,
            EGO_SPEED: (ego_mps + ego_mps2 * dt_s).clip(0.0),
            LEAD_SPEED: (lead_mps + lead_mps2 * dt_s).clip(0.0),
        }

    def compiled_rollouts(
        self, logit: Callable[[FloatArray], FloatArray]
    ) -> Callable[[FloatArray], RolloutBatch] | None:
        """As :class:`pemviz.sampling.rollouts.runners.CompilesRollouts` has it."""
        if type(self) is not VectorizedSimulator or self.tracker or self.errors:
            return None
        kernels = compiled_loops()
        return None if kernels is None else CompiledRollouts(self, logit, kernels).simulate

    def signal_bounds(self, states: StateBatch, *, steps: int) -> SignalBounds:
        """Between which values signals stay, from states ``[N]`` to ``steps`` steps later.

        The gap is smallest if the ego accelerates all the time. It then closes ever faster, so
        that it is smallest at one of the two ends.
        """
        config, dt_s = self.config, self.config.dt_s
        gap_m, ego_mps = states.signals[GAP], states.signals[EGO_SPEED]
        lead_mps = states.signals[LEAD_SPEED]
        gained_mps = config.maximum_acceleration_mps2 * dt_s * steps
        slowest_mps = float(lead_mps.min()) if lead_mps.size else 0.0
        closed_m = ego_mps * (steps * dt_s)
        closed_m += gained_mps * dt_s * (steps - 1) / 2.0
        closed_m -= self._shortest_way_m(slowest_mps, first=int(states.step), steps=steps)
        return {
            GAP: (gap_m - np.maximum(closed_m, 0.0) - ROUNDING, np.inf),
            EGO_SPEED: (0.0, ego_mps + (gained_mps + ROUNDING)),
            LEAD_SPEED: (0.0, lead_mps),
        }

    def signals_reached(self, states: StateBatch, *, steps: int) -> SignalBounds:
        """What signals reach at some of the next ``steps`` states, from states ``[N]``.

        Gaps stay largest if the ego brakes as hard as it can all the time. What they are then once
        it is no faster than the lead car, or stands, is told: about the smallest that they become.
        """
        if steps < 1:
            return {}
        config, dt_s = self.config, self.config.dt_s
        gap_m, ego_mps = states.signals[GAP], states.signals[EGO_SPEED]
        lead_mps = float(states.signals[LEAD_SPEED].max(initial=0.0))
        lost_mps = dt_s * max(config.emergency_deceleration_mps2, config.maximum_deceleration_mps2)
        braked = ego_mps / lost_mps
        gained_mps = lost_mps - dt_s * config.lead_deceleration_mps2
        if gained_mps > 0.0:
            braked = np.minimum(braked, (ego_mps - lead_mps) / gained_mps, out=braked)
        braked = np.ceil(braked, out=braked).clip(1.0, steps, out=braked)
        reached_m = self._longest_ways_m(lead_mps, first=int(states.step), steps=steps)[
            braked.astype(np.int64)
        ]
        reached_m += gap_m
        # of a standing ego this is short of its way, and the gap too large
        reached_m -= dt_s * braked * (ego_mps - (0.5 * lost_mps) * (braked - 1.0))
        reached_m += ROUNDING
        return {GAP: (reached_m, -np.inf)}

    def _longest_ways_m(self, speed_mps: float, *, first: int, steps: int) -> FloatArray:
        """How far a lead car goes at most in 0 to ``steps`` steps from step ``first`` on [m]."""
        dt_s, lost_mps = self.config.dt_s, self.config.lead_deceleration_mps2 * self.config.dt_s
        after = np.arange(steps + 1.0)
        unbraked = math.floor(self.config.lead_brake_time_s / dt_s + ROUNDING) + 1 - first
        braked = (after - max(unbraked, 0)).clip(0.0)
        if lost_mps > 0.0:
            braking = braked.clip(max=math.ceil(speed_mps / lost_mps))
            standing = braked - braking
        else:
            braking, standing = braked, 0.0
        return dt_s * (speed_mps * (after - standing) - lost_mps * braking * (braking - 1.0) / 2.0)

    def _shortest_way_m(self, speed_mps: float, *, first: int, steps: int) -> float:
        """How far a lead car goes at least from step ``first`` on [m]."""
        dt_s, lost_mps = self.config.dt_s, self.config.lead_deceleration_mps2 * self.config.dt_s
        unbraked = math.floor(self.config.lead_brake_time_s / dt_s) - first
        unbraked = min(max(unbraked, 0), steps)
        braked = steps - unbraked
        if lost_mps > 0.0:
            braked = min(braked, math.floor(speed_mps / lost_mps))
        braked_m = dt_s * (speed_mps * braked - lost_mps * braked * (braked - 1) / 2.0)
        return speed_mps * unbraked * dt_s + braked_m

    def _ego_acceleration(
        self, states: StateBatch, perceived: Perceived
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
        emergency = brakes(perceived.present, perceived.gap_m, config)
        return (
            np.where(emergency, -config.emergency_deceleration_mps2, cruise_mps2),
            np.where(emergency, held_m, grown_m),
        )
