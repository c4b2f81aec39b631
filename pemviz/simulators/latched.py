"""A back end that remembers whether a rollout has violated already."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.types import Signal, Simulator, StateBatch

VIOLATED = "violated"


@dataclass(frozen=True)
class LatchedSimulator:
    """The same scenario; its states' memory also holds ``violated``.

    A proposal that makes violations likely must know when there has been one: from then on
    nothing is to be gained, and leaving the error model only spreads the weights.

    Attributes:
        scenario: The back end itself.
        unsafe: States ``[N]`` to whether being in them is a violation.
    """

    scenario: Simulator
    unsafe: Callable[[StateBatch], BoolArray]

    @property
    def name(self) -> str:
        """The back end's name."""
        return self.scenario.name

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.scenario.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.scenario.dt_s

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The back end's signals."""
        return self.scenario.signals

    def initial(self, *, count: int) -> StateBatch:
        """The back end's initial states and whether they violate."""
        return self._latched(self.scenario.initial(count=count), np.zeros(count, dtype=np.bool_))

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The back end's next states; a violation stays."""
        return self._latched(self.scenario.step(states, detected), states.memory[VIOLATED])

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The back end's salient variables."""
        return self.scenario.salient(signals)

    def _latched(self, states: StateBatch, before: BoolArray) -> StateBatch:
        return replace(states, memory={**states.memory, VIOLATED: before | self.unsafe(states)})
