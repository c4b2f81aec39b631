"""Scenarios that tell by how much what was measured in a rollout was off."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from pemviz.arrays import AnyArray, FloatArray


@runtime_checkable
class TellsErrors(Protocol):
    """A scenario with latents of steps that says what errors they make.

    Any :class:`pemviz.Simulator` may offer it; views then show errors in place of latents.
    """

    def told_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Measured minus true values at each step of one rollout [m].

        Args:
            signals: ``[T]`` by name.
            memory: ``[T]`` by name, what its states remember.

        Returns:
            ``[T-1]`` by what was measured; NaN where nothing was.
        """
        ...


def tells_errors(simulator: object) -> TellsErrors | None:
    """A simulator, or the scenario that it wraps, if it tells of errors."""
    found = simulator
    while found is not None and not isinstance(found, TellsErrors):
        found = getattr(found, "scenario", None)
    return found
