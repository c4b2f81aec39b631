"""What a proposal may know of the braking scenario's states."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.emergency_braking import is_close
from pemviz.simulators.braking.measured_gap import FORGETFUL_NOISE, LASTING_NOISE, RangeErrors
from pemviz.simulators.braking.scenario import (
    EGO_SPEED,
    GAP,
    LEAD_SPEED,
    BrakingScenario,
    scenario_tracker,
)
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import StateBatch

REACH = 3.0
"""Noise up to which a measured gap is expected to be too small: detections matter as far as that.
"""


@dataclass(frozen=True)
class BrakingFeatures:
    """Gap, closing speed and time, and the tracks; where detections make a difference at all.

    Attributes:
        config: The scenario's parameters.
        scenario: A back end with errors of the measured gap; ``None``: there are none.
    """

    config: ScenarioConfig
    scenario: BrakingScenario | None = None

    @cached_property
    def tracker(self) -> Tracker | None:
        """What stands between perception and controller."""
        return scenario_tracker(self.config)

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], closing speed [m/s] and time [s] of states ``[...]``, as ``[..., 3]``.

        With errors of the measured gap the noise that the states carry is a fourth; with a tracker
        there is also what :meth:`Tracker.numbers` gives.
        """
        gap_m = states.signals[GAP]
        closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
        more: list[FloatArray] = []
        if self._errors is not None:
            lasting, forgetful = states.memory[LASTING_NOISE], states.memory[FORGETFUL_NOISE]
            more.append(self._errors.range_memory.noise(lasting, forgetful))
        if self.tracker is not None:
            more += self.tracker.numbers(self.tracker.state(states.memory))
        shape = (*gap_m.shape, 3 + len(more))
        values = np.empty(shape, dtype=np.float64)
        values[..., 0] = gap_m
        values[..., 1] = closing_mps
        values[..., 2] = states.step * self.config.dt_s
        for column, numbers in enumerate(more, start=3):
            values[..., column] = numbers
        return values

    def reacts(self, states: StateBatch) -> BoolArray:
        """Whether a detection at states ``[...]`` would trigger the emergency brake.

        With a tracker: or may do so later, while the tracker still knows of it.
        """
        gap_m = states.signals[GAP]
        if self.tracker is not None:
            gap_m = gap_m - self._closed_m(states, self.tracker)
        if self.scenario is None or self._errors is None:
            return is_close(gap_m, self.config)
        salient = self.scenario.salient(states.signals)
        nearest = self._errors.range_error(salient, np.full(np.shape(gap_m), -REACH))
        return is_close(gap_m + nearest.clip(max=0.0), self.config)

    def _closed_m(self, states: StateBatch, tracker: Tracker) -> FloatArray:
        """By how much gaps ``[...]`` may shrink while the tracker knows of an outcome [m]."""
        known_s = (tracker.window - 1 + tracker.coast_steps) * self.config.dt_s
        closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
        closing_mps2 = self.config.lead_deceleration_mps2 + self.config.maximum_acceleration_mps2
        return (closing_mps * known_s + 0.5 * closing_mps2 * known_s**2).clip(0.0)

    @property
    def _errors(self) -> RangeErrors | None:
        return None if self.scenario is None else self.scenario.errors
