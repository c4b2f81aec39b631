"""A problem's motion as pemviz takes it: a simulator with latents, and a detector model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.external.motions import Motion, Values
from pemviz import BoolArray, FloatArray, LatentCounts, Signal, StateBatch


@dataclass(frozen=True)
class MotionSimulator:
    """A motion as a simulator: values shown are signals, the others memory.

    Attributes:
        motion: What moves.
        name: The simulator's.
        dt_s: Time step; nothing depends on it [s].
    """

    motion: Motion
    name: str
    dt_s: float = 1.0

    @property
    def states(self) -> int:
        """One more than it moves."""
        return self.motion.steps + 1

    @property
    def latents(self) -> LatentCounts:
        """Standard normals at the start and at each step."""
        return LatentCounts(start=self.motion.starts, noise=self.motion.noises)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The values shown."""
        return tuple(
            Signal(name=name, key=name, unit="", low=low, high=high)
            for name, (low, high) in self.motion.shown.items()
        )

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """``count`` states from standard normals ``[count, S]``, if it takes any."""
        given = np.empty((count, 0)) if start is None else start
        return self._states(np.zeros((), dtype=np.int64), self.motion.begin(given))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The next states after outcomes ``[N]`` and standard normals ``[N, M]``."""
        given = np.empty((len(detected), 0)) if noise is None else noise
        values = {**states.signals, **states.memory}
        moved = self.motion.move(values, int(states.step), detected, given)
        return self._states(states.step + 1, moved)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """All signals, in their order."""
        return np.stack([signals[name] for name in self.motion.shown], axis=-1)

    def _states(self, step: Any, values: Values) -> StateBatch:
        shown = self.motion.shown
        return StateBatch(
            step=step,
            signals={name: values[name] for name in shown},
            memory={name: value for name, value in values.items() if name not in shown},
        )


@dataclass(frozen=True)
class MotionDetector:
    """A motion's detector as a model of salient variables."""

    motion: Motion

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of 'detected' ``[...]`` at salient variables ``[..., D]``."""
        return self.motion.logit(
            {name: salient[..., i] for i, name in enumerate(self.motion.shown)}
        )
