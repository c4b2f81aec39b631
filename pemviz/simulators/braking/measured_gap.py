"""The gap as perception measures it: what the ego's emergency braking rule acts on.

At a step with noise z the measured gap is the true one and an error along the line of sight, of
the lead car's centre. The noise of the one lead car hangs together over time: a part that stays
for the whole rollout, drawn at its start, and one that is forgotten, renewed by z.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.latents import LatentCounts
from pemviz.types import StateBatch

LASTING_NOISE = "lasting_noise"
FORGETFUL_NOISE = "forgetful_noise"


class ErrorMemory(Protocol):
    """How the noise of an obstacle hangs together; see ``pemviz.pem.NoiseMemory``."""

    @property
    def lasting_share(self) -> float:
        """Share of its variance that an obstacle keeps."""
        ...

    def after(self, before: FloatArray, fresh: FloatArray, *, since_s: float) -> FloatArray:
        """The forgetful part a step on ``[N]``, of standard normals ``[N]``."""
        ...

    def noise(self, lasting: FloatArray, forgetful: FloatArray) -> FloatArray:
        """The noise of an error ``[N]``, of its two parts ``[N]``."""
        ...


@runtime_checkable
class RangeErrors(Protocol):
    """Errors of a measured distance; see ``pemviz.pem.PositionErrorModel``."""

    @property
    def range_memory(self) -> ErrorMemory:
        """How they hang together over time."""
        ...

    def range_error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Measured minus true distance ``[N]`` [m].

        Args:
            salient: ``[N, 11]``.
            noise: Standard normals ``[N]``.
        """
        ...


@dataclass(frozen=True)
class MeasuredGap:
    """What a step's perception makes of the gap.

    Attributes:
        config: The scenario.
        errors: Of the lead car's distance.
    """

    config: ScenarioConfig
    errors: RangeErrors

    @property
    def latents(self) -> LatentCounts:
        """One at every step, and one at the start where a part of the noise stays."""
        return LatentCounts(start=int(self.errors.range_memory.lasting_share > 0.0), noise=1)

    def begin(self, count: int, start: FloatArray | None) -> Mapping[str, FloatArray]:
        """What the states remember of the noise at the start, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: Latents ``[N, 0 or 1]``; ``None``: 0.
        """
        lasts = start is not None and self.latents.start
        lasting = np.array(start[:, 0]) if lasts and start is not None else np.zeros(count)
        return {LASTING_NOISE: lasting, FORGETFUL_NOISE: np.zeros(count)}

    def remembered(self, states: StateBatch, noise: FloatArray) -> Mapping[str, FloatArray]:
        """What the next states remember of the noise, arrays ``[N]``.

        Args:
            states: ``[N]``.
            noise: Latents of the step ``[N, 1]``.
        """
        memory, fresh = self.errors.range_memory, noise[:, 0]
        before = np.asarray(states.memory[FORGETFUL_NOISE], dtype=np.float64)
        renewed = memory.after(before, fresh, since_s=self.config.dt_s)
        forgetful = np.where(states.step == 0, fresh, renewed)
        lasting = np.asarray(states.memory[LASTING_NOISE], dtype=np.float64)
        return {LASTING_NOISE: lasting, FORGETFUL_NOISE: forgetful}

    def error_m(self, salient: FloatArray, memory: Mapping[str, FloatArray]) -> FloatArray:
        """Measured minus true gap ``[N]`` [m], for what is remembered with the step's noise."""
        noise = self.errors.range_memory.noise(memory[LASTING_NOISE], memory[FORGETFUL_NOISE])
        return self.errors.range_error(salient, noise)
