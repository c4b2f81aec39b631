"""A random start of which finitely many are distinguished, so that all can be gone through.

The normal distribution of each latent at the start is cut into cells; every start within a cell
begins as its median does. Cells of all latents together are the starts of a scenario whose failure
probability is a sum over them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr, ndtri

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import ConfigError
from pemviz.simulators.latents import (
    LatentSimulator,
    NamesStarts,
    WrappedSimulator,
    begun,
    latent_counts,
    stepped,
    within,
)
from pemviz.simulators.slots import SlotSimulator, WrappedSlots
from pemviz.types import Signal, Simulator, StateBatch

FARTHEST = 4.0
"""Standard deviations from the median up to which cells are equally wide; the outermost two go on
without end."""
MOST_STARTS = 4096


@dataclass(frozen=True)
class StartCells:
    """Cells of S independent standard normals, K = each^S of them together.

    Attributes:
        each: Of one latent; equally wide but for the outermost two, which have no end.
        latents: S.
    """

    each: int
    latents: int

    @property
    def count(self) -> int:
        """K."""
        return self.each**self.latents

    @cached_property
    def log_p(self) -> FloatArray:
        """Log of each cell's probability, ``[K]``."""
        low, high = _mirrored(self._low, self._high)
        return np.log(ndtr(high) - ndtr(low))[self._of_latent].sum(axis=1)

    @cached_property
    def medians(self) -> FloatArray:
        """What latents are in each cell at its median, ``[K, S]``."""
        cell = np.arange(self.count)
        return self.within(cell, np.full((self.count, self.latents), 0.5))

    def index(self, start: FloatArray) -> IntArray:
        """In which cell latents ``[N, S]`` lie, ``[N]``."""
        each = np.searchsorted(self._edges, start, side="right")
        return each @ (self.each ** np.arange(self.latents)[::-1])

    def within(self, cell: IntArray, place: FloatArray) -> FloatArray:
        """Latents ``[N, S]`` of cells ``[N]`` at shares ``place [N, S]`` of their probability."""
        of_latent = self._of_latent[cell]
        low, high = self._low[of_latent], self._high[of_latent]
        upper = low >= 0.0
        below, above = _mirrored(low, high)
        share = np.where(upper, 1.0 - place, place)
        found = ndtri(ndtr(below) + share * (ndtr(above) - ndtr(below)))
        return np.clip(np.where(upper, -found, found), low, high)

    @cached_property
    def _edges(self) -> FloatArray:
        return np.linspace(-FARTHEST, FARTHEST, self.each + 1)[1:-1]

    @property
    def _low(self) -> FloatArray:
        return np.concatenate([[-np.inf], self._edges])

    @property
    def _high(self) -> FloatArray:
        return np.concatenate([self._edges, [np.inf]])

    @cached_property
    def _of_latent(self) -> IntArray:
        """Each latent's own cell, ``[K, S]``."""
        shape = (self.each,) * self.latents
        return np.stack(np.unravel_index(np.arange(self.count), shape), axis=-1)


def _mirrored(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cells above 0 as those below it that they mirror, where no digits are lost."""
    upper = low >= 0.0
    return np.where(upper, -high, low), np.where(upper, -low, high)


@dataclass(frozen=True)
class QuantisedStart(WrappedSimulator):
    """The same scenario, which begins at the median of the cell that its start lies in.

    Attributes:
        cells: Of each latent at the start.
    """

    cells: int

    @property
    def start_cells(self) -> StartCells:
        """All latents' cells."""
        return StartCells(self.cells, self.latents.start)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The scenario's initial states from the medians of the cells of ``start [N, S]``."""
        given = np.zeros((count, self.latents.start)) if start is None else start
        return begun(self.scenario, count=count, start=self._begun_at(given))

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The scenario's next states."""
        return stepped(self.scenario, states, detected, noise)

    def _begun_at(self, start: FloatArray) -> FloatArray:
        return self.start_cells.medians[self.start_cells.index(start)]


@dataclass(frozen=True)
class QuantisedSlots(WrappedSlots, QuantisedStart):
    """The same of a scenario with slots."""


class _Named(QuantisedStart):
    """Tells the start values that rollouts begin with."""

    @property
    def starts(self) -> tuple[Signal, ...]:
        """The scenario's start values."""
        return self._names.starts

    @property
    def start_plane(self) -> tuple[str, str]:
        """Two of them."""
        return self._names.start_plane

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Of the medians of the cells that latents ``[N, S]`` lie in."""
        return self._names.start_values(self._begun_at(start))

    @property
    def _names(self) -> NamesStarts:
        assert isinstance(self.scenario, NamesStarts)  # noqa: S101  so it was chosen
        return self.scenario


class NamedQuantisedStart(_Named, QuantisedStart):
    """A quantised start whose values have names."""


class NamedQuantisedSlots(_Named, QuantisedSlots):
    """The same of a scenario with slots."""


def quantised_start(
    simulator: Simulator | SlotSimulator | LatentSimulator, *, cells: int
) -> QuantisedStart:
    """A scenario whose random start takes finitely many values, all of which can be gone through.

    As the twin of the scenario itself it lets method ``zero-variance`` choose starts, whose answer
    then is the scenario's own: unbiased, the better the finer the cells. With it as simulator and
    twin the answer is exact for it.

    Args:
        simulator: With latents at the start and none at steps.
        cells: Of each latent, at least 2, the K = cells^S of all at most 4,096.

    Raises:
        ConfigError: It has no such latents, or there are too many cells.
    """
    counts, where = latent_counts(simulator), f"quantised_start of simulator {simulator.name!r}"
    if counts.start == 0 or counts.noise > 0:
        message = f"{where}: its latents are {counts}: must be some at the start, none at steps"
        raise ConfigError(message)
    most = int(MOST_STARTS ** (1.0 / counts.start) + 1e-9)
    if isinstance(cells, bool) or not 2 <= cells <= most:
        message = f"{where}: cells = {cells!r}: must be a whole number from 2 to {most}"
        raise ConfigError(message)
    named = isinstance(simulator, NamesStarts)
    if isinstance(simulator, SlotSimulator):
        return (NamedQuantisedSlots if named else QuantisedSlots)(simulator, cells)
    return (NamedQuantisedStart if named else QuantisedStart)(simulator, cells)


def start_cells(simulator: object) -> StartCells | None:
    """The cells of a quantised start at or beneath a simulator; ``None`` if there is none."""
    found = within(simulator, QuantisedStart)
    return None if found is None else found.start_cells
