"""States from which a violation is certain: their value is 1, whatever follows."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray
from pemviz.sampling.zero_variance.unsafe_states import UnsafeStates
from pemviz.simulators.bounds import SignalBounds, signals_reached, tells_reached
from pemviz.types import Simulator, StateBatch


@dataclass(frozen=True)
class CertainViolation:
    """Which states violate later for certain, as far as a twin tells.

    Attributes:
        twin: What tells how far its signals go at least.
        unsafe: What violates the specification.
    """

    twin: Simulator
    unsafe: UnsafeStates

    def __call__(self, states: StateBatch) -> BoolArray:
        """Whether all sequences of outcomes lead from states ``[N]`` of one step to unsafe ones.

        False where that is not known.
        """
        after = int(states.step)

        def reached(steps: int) -> SignalBounds:
            left = self.twin.states - 1 - after
            return signals_reached(self.twin, states, steps=min(steps, left))

        return np.broadcast_to(self.unsafe.certain(reached, after=after), states.shape)


def certain_violation(twin: Simulator, unsafe: object) -> CertainViolation | None:
    """What tells it; ``None`` where nothing is known."""
    if isinstance(unsafe, UnsafeStates) and tells_reached(twin):
        return CertainViolation(twin, unsafe)
    return None
