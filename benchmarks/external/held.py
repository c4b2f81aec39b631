"""What is common to systems of others whose controller goes by the state last detected."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from benchmarks.external.motions import Flags, Numbers, Values

ERROR_RANGES = {"err": (-0.3, 0.3), "rate_err": (-3.0, 3.0), "room": (-1.0, 1.0)}
"""How far what is held of the pole is off, and the room that is left, as a share."""


@dataclass(frozen=True, kw_only=True)
class HeldState(ABC):
    """A cart with a pole: its controller acts on the state as it was when last detected.

    Attributes:
        base: Log-odds of a detection while the pole does not turn.
        slope: How much less for each rad/s.
        ranges: What the state's numbers are shown in, by name, in the system's own order.
        first: Where every rollout starts, likewise.
        gains: Of the controller on what is held, likewise.
    """

    base: float
    slope: float
    steps: int
    starts: int = 0
    noises: int = 0
    misses: bool = True
    ranges: ClassVar[Mapping[str, tuple[float, float]]]
    first: ClassVar[tuple[float, ...]]
    gains: ClassVar[tuple[float, ...]]

    @property
    def shown(self) -> Mapping[str, tuple[float, float]]:
        """Its state, how far what is held is off, and the room that is left."""
        return {**self.ranges, **ERROR_RANGES}

    @property
    def spec(self) -> str:
        """There is room left."""
        return f"always[0,{self.steps}] (room >= 0.0)"

    def begin(self, start: Numbers) -> Values:
        """Where every rollout starts; that state is held."""
        numbers = zip(self.ranges, self.first, strict=True)
        state = {name: np.full(len(start), one) for name, one in numbers}
        return self._with_errors(state, {f"held_{name}": value for name, value in state.items()})

    def move(self, values: Values, step: int, detected: Flags, noise: Numbers) -> Values:  # noqa: ARG002
        """A step on; once it has failed its state stays."""
        held = {n: np.where(detected, values[n], values[f"held_{n}"]) for n in self.ranges}
        wanted = np.sum([g * held[n] for g, n in zip(self.gains, held, strict=True)], axis=0)
        later, going = self.later(values, wanted), values["room"] >= 0.0
        state = {n: np.where(going, later[n], values[n]) for n in self.ranges}
        return self._with_errors(state, {f"held_{n}": held[n] for n in self.ranges})

    @abstractmethod
    def later(self, values: Values, wanted: Numbers) -> Values:
        """The state a step on, where the controller's law wants so much."""

    @abstractmethod
    def room(self, state: Values) -> Numbers:
        """What is left until it fails, as a share; below 0 it has."""

    def _with_errors(self, state: Values, held: Values) -> Values:
        errors = {
            "err": state["th"] - held["held_th"],
            "rate_err": state["thd"] - held["held_thd"],
            "room": self.room(state),
        }
        return {**state, **held, **errors}

    def logit(self, values: Values) -> Numbers:
        """The faster the pole turns, the less is detected."""
        return self.base - self.slope * np.abs(values["thd"])

    def margin(self, values: Values) -> Numbers:
        """The room that is left."""
        return values["room"]
