"""Where perception says that what it reports is: off along the line of sight, and across it.

The noise of each slot hangs together over time: a part that stays for the whole rollout, drawn at
its start, and one that is forgotten, renewed at every step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.latents import LatentCounts
from pemviz.simulators.measurement_errors import ErrorMemory
from pemviz.types import StateBatch

KINDS = ("range", "cross_range")
"""Of error, in the order of a slot's latents."""
LASTING, FORGETFUL = "lasting", "forgetful"
FARTHEST_ASIDE_M = 2.0
"""What is farther beside the path than this is not taken to be measured in it."""


class ErrorKind(Protocol):
    """One kind of error; see ``pemviz.pem.models.position_errors.ErrorAxis``."""

    @property
    def memory(self) -> ErrorMemory:
        """How its noise hangs together over time."""
        ...


@runtime_checkable
class PlaneErrors(Protocol):
    """Errors of measured places; see ``pemviz.pem.PositionErrorModel``."""

    @property
    def axes(self) -> Sequence[ErrorKind]:
        """The kinds of error: first along the line of sight, then across it."""
        ...

    def error(self, salient: FloatArray, noise: FloatArray) -> FloatArray:
        """Measured minus true ``[..., M]`` [m], for ``[..., 11]`` and standard normals."""
        ...


@dataclass(frozen=True)
class MeasuredPlaces:
    """What errors make of places, and what states remember of their noise.

    Attributes:
        errors: Of every slot alike.
        names: Of the K slots.
        dt_s: Time between two measurements [s].
    """

    errors: PlaneErrors
    names: tuple[str, ...]
    dt_s: float

    @property
    def latents(self) -> LatentCounts:
        """Two a slot at every step, and two at the start where a part of any noise stays."""
        lasts = any(self._memory(kind).lasting_share > 0.0 for kind in range(len(KINDS)))
        count = len(self.names) * len(KINDS)
        return LatentCounts(start=count if lasts else 0, noise=count)

    def begin(self, count: int, start: FloatArray) -> dict[str, AnyArray]:
        """What the states remember of the noise at the start, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: Their latents ``[N, 0 or 2 K]``, those of a slot side by side.
        """
        places = range(len(KINDS) * len(self.names))
        none = np.zeros(count)
        lasting = [np.array(start[:, place]) if self.latents.start else none for place in places]
        return {**self._named(LASTING, lasting), **self._named(FORGETFUL, [none for _ in places])}

    def renewed(self, states: StateBatch, noise: FloatArray | None) -> dict[str, AnyArray]:
        """What the next states remember, which is the noise of the step that leads to them.

        Args:
            states: ``[N]``.
            noise: Latents of the step ``[N, 2 K]``; ``None``: 0.
        """
        before = self._parts(FORGETFUL, states.memory)
        fresh = np.zeros((len(before), *states.shape)) if noise is None else np.asarray(noise).T
        first = states.step == 0
        forgetful = [
            np.where(
                first,
                new,
                self._memory(place % len(KINDS)).after(old, new, since_s=self.dt_s),
            )
            for place, (old, new) in enumerate(zip(before, fresh, strict=True))
        ]
        lasting = self._parts(LASTING, states.memory)
        return {**self._named(LASTING, lasting), **self._named(FORGETFUL, forgetful)}

    def errors_m(self, salient: FloatArray, memory: Mapping[str, AnyArray]) -> FloatArray:
        """Measured minus true, along the line of sight and across it, ``[N, K, 2]`` [m].

        Args:
            salient: Of the slots, ``[N, K, 11]``.
            memory: With the step's noise, :meth:`renewed`.
        """
        kinds, slots = len(KINDS), len(self.names)
        own = zip(self._parts(LASTING, memory), self._parts(FORGETFUL, memory), strict=True)
        noise = np.zeros((*salient.shape[:-1], len(self.errors.axes)))
        for place, (lasting, forgetful) in enumerate(own):
            slot, kind = divmod(place, kinds)
            noise[:, slot, kind] = self._memory(kind).noise(lasting, forgetful)
        flat = self.errors.error(
            salient.reshape(-1, salient.shape[-1]), noise.reshape(-1, noise.shape[-1])
        )
        return flat.reshape(-1, slots, noise.shape[-1])[..., :kinds]

    def _memory(self, kind: int) -> ErrorMemory:
        return self.errors.axes[kind].memory

    def _names_of(self, part: str) -> list[str]:
        return [f"{part}_{kind}_{name}" for name in self.names for kind in KINDS]

    def _named(self, part: str, values: Sequence[AnyArray]) -> dict[str, AnyArray]:
        return dict(zip(self._names_of(part), values, strict=True))

    def _parts(self, part: str, memory: Mapping[str, AnyArray]) -> list[FloatArray]:
        return [np.asarray(memory[name], dtype=np.float64) for name in self._names_of(part)]


def displaced(
    config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray, errors_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured gaps and offsets ``[...]`` [m] of cars whose centres are off by errors.

    Args:
        config: The encounter.
        gap_m: True ones, ``[...]`` [m].
        aside_m: Likewise.
        errors_m: Along the line of sight from the camera and across it to the right, ``[..., 2]``.
    """
    x_m = -aside_m
    z_m = gap_m + config.camera_to_bumper_m + config.car_length_m / 2
    distance_m = np.hypot(x_m, z_m)
    sine, cosine = x_m / distance_m, z_m / distance_m
    along, across = errors_m[..., 0], errors_m[..., 1]
    return gap_m + along * cosine - across * sine, aside_m - along * sine - across * cosine
