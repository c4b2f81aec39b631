"""The states that a scenario can be in, step by step, and where each outcome leads from them.

Perception decides one bit a step, and the dynamics are deterministic: the scenario lives on
a graph. Sequences of outcomes that lead to the same state merge, so that all reachable states
can often be held at once, and every sequence of outcomes is a path through them. Where there are
too many, neighbours are taken for one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import distinct
from pemviz.faults import blame, of_no_rollouts
from pemviz.pem.models.pieces import logit_along
from pemviz.pem.models.protocol import DetectorModel
from pemviz.proposals.zero_variance import cell_keys
from pemviz.sampling.slots import turns_of
from pemviz.sampling.zero_variance.unsafe_states import (
    CertainViolation,
    UnsafeStates,
    certain_violation,
)
from pemviz.simulators.latents import begun, stepped
from pemviz.simulators.quantised import start_cells
from pemviz.simulators.signal_bounds import signal_bounds, tells_bounds
from pemviz.types import Simulator, StateBatch

Pause = Callable[[], None]
"""Called now and then during long work; may raise to stop it."""
Unsafe = Callable[[StateBatch], BoolArray]
"""States ``[N]`` to whether being in them violates the specification ``[N]``."""

MERGE_DISTANCE = 1e-6
LARGEST_LAYER = 2_000_000
LARGEST_TOTAL = 40_000_000
COARSE_LAYER = 300_000
COARSE_LAYER_SHARE = 0.25
FIRST_COARSE_SHARE = 3e-4
COARSENING = 1.5
SAFE_NODE = -1
UNSAFE_NODE = -2
KEPT_STATES = 4_000_000
"""So many states in all are kept until it is known which are live; of more, live ones are walked to
once more."""


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
        # columns that are the same throughout tell no states apart
        columns = [one for one in state_columns(states) if one.size and (one != one[0]).any()]
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


@dataclass(frozen=True)
class Layer:
    """The live states of one step: some sequence of outcomes leads to violation, but none must.

    States from which every sequence does are UNSAFE_NODE, as far as the twin tells of them.

    Attributes:
        states: Arrays ``[n]``.
        pem_logit: Logit of 'detected' under the error model, ``[n]``.
        after_miss: Index ``[n]`` in the next layer, or SAFE_NODE or UNSAFE_NODE.
        after_hit: The same after a detection.
    """

    states: StateBatch
    pem_logit: FloatArray
    after_miss: IntArray
    after_hit: IntArray

    @property
    def count(self) -> int:
        """Number of states n."""
        return int(self.pem_logit.size)


@dataclass(frozen=True)
class StateGraph:
    """All states from which the specification can be violated.

    Attributes:
        layers: Live states by step, up to the last step that has any.
        start: Where rollouts start, an index in the first layer, or SAFE_NODE or UNSAFE_NODE: one
            for each of a quantised start's K cells, else a single one, ``[K]``.
        exact: Whether only states closer than MERGE_DISTANCE were taken for one. A state is then
            left out if and only if no sequence of outcomes leads from it to a violation, or every
            one for certain.
        log_start: Log of the probability of each start, ``[K]``.
        certain: Which states were left out since every one does; ``None``: no such.
    """

    layers: tuple[Layer, ...]
    start: IntArray
    exact: bool
    log_start: FloatArray = field(default_factory=lambda: np.zeros(1))
    certain: CertainViolation | None = None


@of_no_rollouts()
def explore(
    *,
    twin: Simulator,
    pem: DetectorModel,
    unsafe: Unsafe,
    largest_layer: int = LARGEST_LAYER,
    most_states: int | None = None,
    pause: Pause = no_pause,
) -> StateGraph:
    """The graph of all states that matter.

    Forward, both outcomes are taken at every state until, as far as the twin tells, nothing can be
    violated any more or something must be; backward, a state is live if one of the two leads to a
    live or an unsafe one. No order among states or outcomes is assumed: a specification may have
    several sides, and a miss may help.

    Args:
        twin: A scenario whose ``step`` is cheap for many states.
        pem: The error model, evaluated at live states only.
        unsafe: What violates the specification.
        largest_layer: Above so many states a step, neighbouring states are taken for one.
        most_states: Above so many reachable states in all, nothing is explored.
        pause: Called several times a step.

    Raises:
        TooManyStates: There are more than ``most_states``.
    """
    certain = certain_violation(twin, unsafe)
    walk = _Walk(twin, unsafe, pause, bounded=tells_bounds(twin), certain=certain)
    try:
        exactly = walk.bounded or certain is not None
        merger = Merger(largest_layer, pause, most_states=most_states, exactly=exactly)
        return _graph(walk, pem, merger)
    except MustMergeNeighbours:
        # an approximation by neighbours follows those too whose value is known
        merger = Merger(largest_layer, pause, most_states=most_states, exactly=False)
        return _graph(replace(walk, bounded=False, certain=None), pem, merger)


@dataclass(frozen=True)
class _Walk:
    """Steps from many states at once; ``pause`` is called after every step of the twin.

    States are followed no further where the twin's own bounds say so, if it is ``bounded``, and
    where a violation is ``certain``.
    """

    twin: Simulator
    unsafe: Unsafe
    pause: Pause
    bounded: bool
    certain: CertainViolation | None

    @property
    def last_step(self) -> int:
        """The last step at which a state can be unsafe."""
        last = self.twin.states - 1
        return min(last, self.unsafe.last) if isinstance(self.unsafe, UnsafeStates) else last

    def children(self, states: StateBatch) -> StateBatch:
        """The states ``[2n]`` after a miss, then after a hit, at states ``[n]``."""
        after: list[StateBatch] = []
        for hit in (False, True):
            after.append(stepped(self.twin, states, np.full(states.shape[0], hit)))
            self.pause()
        return StateBatch.concatenate(after)

    def must_violate(self, states: StateBatch) -> BoolArray:
        """Whether states are unsafe, or lead to unsafe ones for certain, ``[N]``."""
        is_unsafe = self.unsafe(states)
        return is_unsafe if self.certain is None else is_unsafe | self.certain(states)

    def may_violate(self, states: StateBatch) -> BoolArray | bool:
        """Whether some sequence of outcomes may lead from states to an unsafe one, ``[N]``.

        True where that is not known.
        """
        if not (self.bounded and isinstance(self.unsafe, UnsafeStates)):
            return True
        step = int(states.step)
        bounds = signal_bounds(self.twin, states, steps=self.last_step - step)
        return self.unsafe.possible(bounds, after=step)


def _graph(walk: _Walk, pem: DetectorModel, merger: Merger) -> StateGraph:
    """The graph of all states that matter from the start, or any of a quantised start's cells."""
    cells = start_cells(walk.twin)
    if cells is None:
        starts, log_start = begun(walk.twin, count=1), np.zeros(1)
    else:
        starts, log_start = begun(walk.twin, count=cells.count, start=cells.medians), cells.log_p
    node = np.where(walk.must_violate(starts), UNSAFE_NODE, SAFE_NODE)
    layers: tuple[Layer, ...] = ()
    open_ = np.flatnonzero(node == SAFE_NODE)
    if open_.size:
        first, index = merger.merge(starts.take(open_))
        explored = _explored(walk, first, merger)
        live = _live(explored.moves)
        if live and live[0].any():
            layers = _live_layers(walk, first.take(live[0]), explored, live, pem)
            node[open_] = np.where(live[0], np.cumsum(live[0]) - 1, SAFE_NODE)[index]
    return StateGraph(layers, node, merger.exact, log_start, walk.certain)


@dataclass(frozen=True)
class _Explored:
    """All reachable states."""

    moves: Sequence[AnyArray]
    """By step, where a miss and a hit lead from every one, ``[2, n]`` int32."""
    kept: Sequence[StateBatch] | None
    """By step, the states ``[n]``; ``None`` where they are too many, or approximate."""


def _explored(walk: _Walk, start: StateBatch, merger: Merger) -> _Explored:
    moves: list[AnyArray] = []
    states = start
    kept: list[StateBatch] = [start]
    for step in range(walk.last_step):
        children = walk.children(states)
        decided = walk.must_violate(children)
        node = np.where(decided, np.int32(UNSAFE_NODE), np.int32(SAFE_NODE))
        moves.append(node.reshape(2, -1))
        open_ = np.flatnonzero(~decided & walk.may_violate(children))
        if open_.size == 0 or step + 1 == walk.last_step:
            break
        every = open_.size == decided.size
        states, index = merger.merge(children if every else children.take(open_))
        node[open_] = index
        if merger.exact and merger.total <= KEPT_STATES:
            kept.append(states)
        else:
            kept.clear()
    return _Explored(moves, kept if len(kept) == len(moves) else None)


def _live(moves: Sequence[AnyArray]) -> Sequence[BoolArray]:
    """By step, from which states ``[n]`` some sequence of outcomes leads to an unsafe one."""
    live: list[BoolArray] = []
    following = np.empty(0, dtype=np.bool_)
    for move in reversed(moves):
        ends = np.concatenate([following, [True, False]])  # indices -2 and -1
        following = np.any(ends[move], axis=0)
        live.insert(0, following)
    return live


def _live_layers(
    walk: _Walk,
    start: StateBatch,
    explored: _Explored,
    live: Sequence[BoolArray],
    pem: DetectorModel,
) -> tuple[Layer, ...]:
    """The layers of live states, walked through once more where states were not kept."""
    layers: list[Layer] = []
    states = start
    for step, (move, alive) in enumerate(zip(explored.moves, live, strict=True)):
        after = live[step + 1] if step + 1 < len(live) else np.empty(0, dtype=np.bool_)
        number = np.concatenate(
            [np.where(after, np.cumsum(after) - 1, SAFE_NODE), [UNSAFE_NODE, SAFE_NODE]]
        )
        node = number[move if alive.all() else move[:, alive]]
        try:
            logit = logit_along(pem, walk.twin.salient(states.signals))
        except BaseException as error:  # a model of the user's may raise anything
            blame(error, "error model: logit", step=step // turns_of(walk.twin))
        walk.pause()
        layers.append(Layer(states, logit, after_miss=node[0], after_hit=node[1]))
        if not after.any():
            break
        if explored.kept is None:
            # of the moves to a state the first, as in merging: the last one written stays
            arriving = np.flatnonzero(node.ravel() >= 0)[::-1]
            first = np.empty(int(after.sum()), dtype=np.int64)
            first[node.ravel()[arriving]] = arriving
            states = walk.children(states).take(first)
        else:
            reached = explored.kept[step + 1]
            states = reached if after.all() else reached.take(after)
    return tuple(layers)
