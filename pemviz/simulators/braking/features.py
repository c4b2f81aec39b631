"""What a proposal may know of the braking scenario's states."""

from dataclasses import dataclass
from typing import Self

from pemviz.arrays import BoolArray, FloatArray, Move, namespace
from pemviz.config import ScenarioConfig
from pemviz.simulators.braking.emergency_braking import is_close
from pemviz.simulators.braking.scenario import EGO_SPEED, GAP, LEAD_SPEED
from pemviz.types import StateBatch


@dataclass(frozen=True)
class BrakingFeatures:
    """Gap, closing speed and time; and where detections make a difference at all."""

    config: ScenarioConfig

    def moved(self, move: Move) -> Self:  # noqa: ARG002
        """Itself: it holds no arrays."""
        return self

    def values(self, states: StateBatch) -> FloatArray:
        """Gap [m], closing speed [m/s] and time [s] of states ``[...]``, as ``[..., 3]``."""
        gap_m = states.signals[GAP]
        closing_mps = states.signals[EGO_SPEED] - states.signals[LEAD_SPEED]
        xp = namespace(gap_m)
        values = xp.empty((*gap_m.shape, 3), dtype=xp.float64, device=gap_m.device)
        values[..., 0] = gap_m
        values[..., 1] = closing_mps
        values[..., 2] = states.step * self.config.dt_s
        return values

    def reacts(self, states: StateBatch) -> BoolArray:
        """Whether a detection at states ``[...]`` would trigger the emergency brake."""
        return is_close(states.signals[GAP], self.config)
