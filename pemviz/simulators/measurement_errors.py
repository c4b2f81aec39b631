"""Errors of what perception measures, and their noise, which hangs together over time.

The noise of one error has a part that stays for the whole rollout, sampled at its start, and one
that is forgotten, renewed at every step; states remember both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.latents import LatentCounts
from pemviz.types import StateBatch

LASTING, FORGETFUL = "lasting_", "forgetful_"
"""Memory: the parts of an error's noise, with its name."""


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


class ErrorKind(Protocol):
    """One kind of error; see ``pemviz.pem.models.position_errors.ErrorAxis``."""

    @property
    def memory(self) -> ErrorMemory:
        """How its noise hangs together over time."""
        ...


class PositionErrors(Protocol):
    """Errors of measured places; see ``pemviz.pem.PositionErrorModel``."""

    @property
    def axes(self) -> Sequence[ErrorKind]:
        """The kinds of error: first along the line of sight, then across it."""
        ...

    def range_error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Measured minus true distance ``[N]`` [m], for ``[N, 11]`` and standard normals."""
        ...

    def error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Measured minus true ``[..., M]`` [m], for ``[..., 11]`` and standard normals."""
        ...


@dataclass(frozen=True)
class MeasurementNoise:
    """The noise of M errors, each with a latent at every step.

    Attributes:
        memories: How the noise of each hangs together over time, by the error's name.
        dt_s: Time between two measurements [s].
    """

    memories: Mapping[str, ErrorMemory]
    dt_s: float

    @property
    def latents(self) -> LatentCounts:
        """One an error at every step, and at the start where a part of any noise stays."""
        count = len(self.memories)
        lasts = any(memory.lasting_share > 0.0 for memory in self.memories.values())
        return LatentCounts(start=count if lasts else 0, noise=count)

    def begin(self, count: int, start: FloatArray | None) -> dict[str, AnyArray]:
        """What states remember of the noise at the start, for latents ``[count, 0 or M]`` or 0."""
        none = np.zeros(count)
        given = [] if start is None or not self.latents.start else [np.array(z) for z in start.T]
        lasting = dict(zip(self.memories, given or [none] * len(self.memories), strict=True))
        return _remembered(lasting, dict.fromkeys(self.memories, none))

    def renewed(self, states: StateBatch, noise: FloatArray | None) -> dict[str, AnyArray]:
        """What the next states remember: the noise of the step, of latents ``[N, M]`` or 0."""
        first, lasting, forgetful = states.step == 0, {}, {}
        fresh = np.zeros((len(self.memories), *states.shape)) if noise is None else noise.T
        for (name, memory), new in zip(self.memories.items(), fresh, strict=True):
            lasting[name], before = _parts(states.memory, name)
            forgetful[name] = np.where(first, new, memory.after(before, new, since_s=self.dt_s))
        return _remembered(lasting, forgetful)

    def values(self, memory: Mapping[str, AnyArray]) -> list[FloatArray]:
        """The noise of each error, standard normal ``[...]``, that states remember."""
        return [own.noise(*_parts(memory, name)) for name, own in self.memories.items()]


def _remembered(
    lasting: Mapping[str, AnyArray], forgetful: Mapping[str, AnyArray]
) -> dict[str, AnyArray]:
    return {
        **{f"{LASTING}{name}": values for name, values in lasting.items()},
        **{f"{FORGETFUL}{name}": values for name, values in forgetful.items()},
    }


def _parts(memory: Mapping[str, AnyArray], name: str) -> tuple[FloatArray, FloatArray]:
    lasting, forgetful = memory[f"{LASTING}{name}"], memory[f"{FORGETFUL}{name}"]
    return np.asarray(lasting, dtype=np.float64), np.asarray(forgetful, dtype=np.float64)
