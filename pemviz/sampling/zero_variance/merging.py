"""Taking states that are alike for one, and neighbours too where there are too many."""

from collections.abc import Callable

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.chunks import distinct
from pemviz.proposals.zero_variance import cell_keys
from pemviz.types import StateBatch

Pause = Callable[[], None]
"""Called now and then during long work; may raise to stop it."""

MERGE_DISTANCE = 1e-6
LARGEST_LAYER = 2_000_000
LARGEST_TOTAL = 40_000_000
COARSE_LAYER = 300_000
COARSE_LAYER_SHARE = 0.25
FIRST_COARSE_SHARE = 3e-4
COARSENING = 1.5


def no_pause() -> None:
    """Go on."""


class TooManyStates(Exception):  # noqa: N818  an answer, not a fault
    """A scenario has more states than the caller wants to look at."""


class MustMergeNeighbours(Exception):  # noqa: N818  an answer, not a fault
    """A scenario has so many states that some that differ would have to be taken for one."""


class Merger:
    """Merges the states of one step after the other.

    Once there were too many, at one step or in all, memory and time are spent as sparingly as
    the approximation is good for. Cells that were wide enough for one step are the first to be
    tried for the next.
    """

    def __init__(
        self,
        largest_layer: int,
        pause: Pause = no_pause,
        *,
        most_states: int | None = None,
        exactly: bool = False,
    ) -> None:
        """Merge neighbours where a step has more than ``largest_layer`` states.

        Above ``most_states`` over all steps, merging ends with :class:`TooManyStates`; where it is
        to merge ``exactly``, with :class:`MustMergeNeighbours` instead of merging them.
        """
        self._largest = largest_layer
        self._most = most_states
        self._exactly = exactly
        self._pause = pause
        self.total = 0
        """How many states there are by now."""
        self._share = FIRST_COARSE_SHARE
        self.exact = True
        """Whether all states taken for one so far were closer than MERGE_DISTANCE."""

    def merge(self, states: StateBatch) -> tuple[StateBatch, IntArray]:
        """The first of the states ``[n]`` in each cell, and the index of each state's ``[n]``.

        Raises:
            TooManyStates: There are more by now than ``most_states``.
            MustMergeNeighbours: It can no longer be done ``exactly``.
        """
        columns = _varying(state_columns(states))
        if not columns:
            return states.take(slice(0, 1)), np.zeros(states.shape[0], dtype=np.int64)
        self._pause()
        first, index = distinct(cell_keys(columns, [MERGE_DISTANCE] * len(columns)))
        self._pause()
        if self._most is not None and self.total + first.size > self._most:
            raise TooManyStates
        if self.total + first.size > LARGEST_TOTAL:
            self._largest = min(self._largest, COARSE_LAYER)
        if first.size > self._largest:
            if self._exactly:
                raise MustMergeNeighbours
            self._largest = min(self._largest, COARSE_LAYER)
            self.exact = False
            first, index = self._coarsely(columns)
        self.total += first.size
        return states.take(first), index

    def _coarsely(self, columns: list[FloatArray]) -> tuple[IntArray, IntArray]:
        spans = [float(np.ptp(column)) for column in columns]
        self._share /= COARSENING
        while True:
            self._pause()
            self._share *= COARSENING
            cells = [max(span * self._share, MERGE_DISTANCE) for span in spans]
            first, index = distinct(cell_keys(columns, cells))
            if first.size <= self._largest * COARSE_LAYER_SHARE or self._share >= 1.0:
                return first, index


def state_names(states: StateBatch) -> tuple[str, ...]:
    """Names of all signals and of the controller's memory, in the order keys use."""
    return (*sorted(states.signals), *sorted(states.memory))


def state_columns(states: StateBatch) -> list[FloatArray]:
    """Signals and memory in the order of :func:`state_names`."""
    return [
        *(states.signals[name] for name in sorted(states.signals)),
        *(np.asarray(states.memory[name], dtype=np.float64) for name in sorted(states.memory)),
    ]


def _varying(columns: list[FloatArray]) -> list[FloatArray]:
    """Columns ``[n]`` that are not the same throughout: the others tell no states apart."""
    return [column for column in columns if column.size and (column != column[0]).any()]
