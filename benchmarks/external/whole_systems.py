"""Simulators of others, whole, that can only be reset and stepped, as their users would give them.

Others' programs are not given them: they are no motions in numpy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from benchmarks.external.catalogue import Published
from benchmarks.external.quadrature import Known
from pemviz import DetectorModel, EpisodicSimulator


@dataclass(frozen=True, kw_only=True)
class WholeSystem(Published):
    """A failure probability of a simulator that can only be reset and stepped.

    Attributes:
        module: Beside this one, imported only when it is asked for since its packages may not be
            there: has ``DETECTOR``, ``STEPS``, ``system()`` and ``plain()``, plain rollouts.
    """

    module: str
    latents: int = 0

    @property
    def spec(self) -> str:
        """There is room left."""
        return f"always[0,{self._module.STEPS}] (room >= 0.0)"

    @property
    def detector(self) -> DetectorModel:
        """The model of its detector."""
        return self._module.DETECTOR

    def system(self) -> EpisodicSimulator:
        """The environment."""
        return self._module.system()

    def found_again(self) -> Known:
        """Its probability by fewer plain rollouts of other seeds."""
        return self._module.plain()

    @property
    def _module(self) -> Any:
        return import_module(f"{__package__}.{self.module}")


WHOLE: Sequence[WholeSystem] = (
    WholeSystem(
        name="intersection-v0",
        source="highway-env, three cars",
        module="intersection",
        truth=0.0143,
        relative_error=0.086,
        how="9,500 plain rollouts, one after the other",
        needs=("highway_env", "gymnasium"),
    ),
    WholeSystem(
        name="BlueSky, two aircraft",
        source="bluesky-simulator",
        module="airspace",
        truth=1.39e-4,
        relative_error=0.085,
        how="1,000,000 plain rollouts, 2,000 pairs at a time",
        needs=("bluesky",),
    ),
)
