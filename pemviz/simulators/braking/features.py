"""What a proposal may know of the braking scenario's states."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, Move, namespace
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.emergency_braking import is_close
from pemviz.simulators.braking.measured_gap import FORGETFUL_NOISE, LASTING_NOISE, RangeErrors
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED, BrakingScenario
from pemviz.types import StateBatch

REACH = 3.0
"""Noise up to which a measured gap is expected to be too small: detections matter as far as that.
"""


@dataclass(frozen=True)
class BrakingFeatures:
    """Gap, closing speed and time; and where detections make a difference at all.

    Attributes:
        config: The scenario's parameters.
        scenario: A back end with errors of the measured gap; ``None``: there are none.
    """

    config: ScenarioConfig
    scenario: BrakingScenario | None = None

    def moved(self, move: Move) -> Self | None:  # noqa: ARG002
        """Itself: it holds no arrays; ``None`` with errors, which numpy computes."""
        return self if self._errors is None else None

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], closing speed [m/s] and time [s] of states ``[...]``, as ``[..., 3]``.

        With errors of the measured gap the noise that the states carry is a fourth, ``[..., 4]``.
        """
        gap_m = states.signals[GAP]
        closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
        xp = namespace(gap_m)
        errors = self._errors
        count = 3 if errors is None else 4
        values = xp.empty((*gap_m.shape, count), dtype=xp.float64, device=gap_m.device)
        values[..., 0] = gap_m
        values[..., 1] = closing_mps
        values[..., 2] = states.step * self.config.dt_s
        if errors is not None:
            lasting, forgetful = states.memory[LASTING_NOISE], states.memory[FORGETFUL_NOISE]
            values[..., 3] = errors.range_memory.noise(lasting, forgetful)
        return values

    def reacts(self, states: StateBatch) -> BoolArray:
        """Whether a detection at states ``[...]`` would trigger the emergency brake."""
        gap_m = states.signals[GAP]
        if self.scenario is None or self._errors is None:
            return is_close(gap_m, self.config)
        salient = self.scenario.salient(states.signals)
        nearest = self._errors.range_error(salient, np.full(np.shape(gap_m), -REACH))
        return is_close(gap_m + nearest.clip(max=0.0), self.config)

    @property
    def _errors(self) -> RangeErrors | None:
        return None if self.scenario is None else self.scenario.errors
