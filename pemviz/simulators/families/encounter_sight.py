"""What perception of an encounter's slots depends on: of the cars, and of a ghost."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig
from pemviz.simulators.families.ghost import ghost_salient, may_appear
from pemviz.simulators.families.kernels import FamilyLoops, loops_for
from pemviz.simulators.families.loops import numbers_of
from pemviz.simulators.families.names import Each
from pemviz.simulators.families.sight import Sight, salient, seen
from pemviz.simulators.families.sight_loops import COLUMNS, Placed, Seen


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
        found = self._described()
        if self.ghost_gap_m is not None:
            found = np.concatenate([found, ghost_salient(self.config, self.ghost_gap_m)])
        return np.moveaxis(found, 0, -2)

    @cached_property
    def _loops(self) -> FamilyLoops | None:
        shape = self.cars.gap_m.shape
        return loops_for(shape[1]) if len(shape) == 2 else None

    @cached_property
    def _seen(self) -> Sight:
        config, gap_m, aside_m = self.config, self.cars.gap_m, self.cars.aside_m
        if self._loops is None:
            return seen(config, gap_m, aside_m)
        found = Seen(np.empty(gap_m.shape), np.empty(gap_m.shape), np.empty(gap_m.shape, np.bool_))
        self._loops.see(numbers_of(config), gap_m, aside_m, found)
        z_m = gap_m + config.camera_to_bumper_m + config.car_length_m / 2
        return Sight(-aside_m, z_m, *found)

    def _described(self) -> FloatArray:
        """The cars' salient variables ``[K, ..., 11]``."""
        own, heading_rad = self._seen, self.cars.heading_rad
        if self._loops is None:
            return salient(self.config, own, heading_rad)
        placed = Placed(own.x_m, own.z_m, np.arctan2(own.x_m, own.z_m), heading_rad)
        found = Seen(own.truncated, own.occluded, own.present)
        result = np.empty((*heading_rad.shape, COLUMNS))
        self._loops.describe(numbers_of(self.config), placed, found, result)
        return result
