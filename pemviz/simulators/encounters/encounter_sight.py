"""What perception of an encounter's slots depends on: of the cars, and of a ghost."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.ghost import ghost_salient, may_appear
from pemviz.simulators.encounters.names import Each
from pemviz.simulators.encounters.sight import Sight, salient, seen


@dataclass(frozen=True, eq=False)
class EncounterSight:
    """Presence and salient variables at states ``[...]``, computed when first asked for.

    Attributes:
        config: The encounter.
        cars: Where the other cars are, ``[K, ...]``.
        ghost_gap_m: The ghost's ``[...]`` [m], whose slot comes last; ``None`` without one.
    """

    config: EncounterConfig
    cars: Each
    ghost_gap_m: FloatArray | None = None

    @property
    def present(self) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[..., K]``."""
        return self._present

    @property
    def salient(self) -> FloatArray:
        """The slots' salient variables ``[..., K, 11]``."""
        return self._salient

    @cached_property
    def _present(self) -> BoolArray:
        found, cars = self._seen.present, self.cars
        if self.ghost_gap_m is not None:
            own = may_appear(self.config, self.ghost_gap_m, cars.gap_m, cars.aside_m)
            found = np.concatenate([found, own[None]])
        return np.moveaxis(found, 0, -1)

    @cached_property
    def _salient(self) -> FloatArray:
        found = salient(self.config, self._seen, self.cars.heading_rad)
        if self.ghost_gap_m is not None:
            found = np.concatenate([found, ghost_salient(self.config, self.ghost_gap_m)])
        return np.moveaxis(found, 0, -2)

    @cached_property
    def _seen(self) -> Sight:
        return seen(self.config, self.cars.gap_m, self.cars.aside_m)
