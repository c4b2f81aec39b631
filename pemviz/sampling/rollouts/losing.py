"""Rollouts that cannot be simulated to their end, in place of a run that ends at them.

The simulator raises something at a step, or ends its process, whenever it is tried. Such a rollout
is what it was up to there: from the outcome on that the step was given the scenario stays as it is,
and outcomes go on as the error model has them. It is thereby a rollout of a scenario with one more
state, from which nothing leads away, and has the weight of its outcomes: whoever averages weights
may count it as he likes.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from pemviz.arrays import BoolArray, IntArray
from pemviz.faults import SimulationError, counted_from
from pemviz.pem.models.protocol import Pem
from pemviz.sampling.rollouts.runners import BatchTask, by_numpy
from pemviz.types import LOST, RolloutBatch, Simulator

TRIES = 3
"""After which a rollout counts as one that cannot be simulated."""


def marked(rollouts: RolloutBatch, lost_at: int | None = None) -> RolloutBatch:
    """Rollouts that say which of their states were not reached: those after an outcome, or none."""
    count, outcomes = rollouts.detected.shape
    states = np.arange(outcomes + 1)
    after = np.zeros_like(states, dtype=np.bool_) if lost_at is None else states > lost_at
    lost = np.repeat(after[:, None], count, axis=1).T  # a step of all in one piece
    return replace(rollouts, memory={**rollouts.memory, LOST: lost})


def lost_rows(rollouts: RolloutBatch) -> BoolArray:
    """Which rollouts could not be simulated to their end, ``[N]``."""
    if LOST not in rollouts.memory:
        return np.zeros(rollouts.count, dtype=np.bool_)
    return np.asarray(rollouts.memory[LOST][:, -1], dtype=np.bool_)


def lost_at(rollouts: RolloutBatch) -> IntArray:
    """Index of the outcome that each of the lost ones broke at, ``[N]``; of the others the last."""
    outcomes = rollouts.detected.shape[1]
    if LOST not in rollouts.memory:
        return np.full(rollouts.count, outcomes, dtype=np.int64)
    return outcomes - np.count_nonzero(rollouts.memory[LOST], axis=1).astype(np.int64)


def losing_here(
    simulator: Simulator, pem: Pem, tasks: Iterable[BatchTask]
) -> Iterator[RolloutBatch]:
    """One batch after the other, in the thread that wants it; a ``BatchRunner``.

    Raises:
        SimulationError: Other people's code but the simulator's raises something, or the simulator
            before a first outcome.
    """
    for task in tasks:
        yield _simulated(simulator, pem, task, tries=0)


def _simulated(simulator: Simulator, pem: Pem, task: BatchTask, *, tries: int) -> RolloutBatch:
    try:
        return marked(by_numpy(simulator, pem, task))
    except SimulationError as error:
        tries += 1
        if not error.broke:
            raise
        count = len(task.uniforms)
        if count == 1 and tries >= TRIES:
            return without_the_rest(
                error.outcomes, task, error, lambda stays: by_numpy(simulator, pem, stays)
            )
        parts: list[RolloutBatch] = []
        for some in _apart(task, error.rollouts):
            with counted_from(sum(part.count for part in parts)):
                parts.append(_simulated(simulator, pem, some, tries=tries))
    return RolloutBatch.concatenate(parts)


def _apart(task: BatchTask, rollouts: range | None) -> list[BatchTask]:
    """The rollout that is known to break and those beside it; halves where it is not known."""
    count = len(task.uniforms)
    if count == 1 or rollouts is None or len(rollouts) != 1:
        return list(task.split(2))
    row = rollouts[0]
    slices = slice(0, row), slice(row, row + 1), slice(row + 1, count)
    return [task.take(rows) for rows in slices if rows.start < rows.stop]


def without_the_rest(
    outcomes: int | None,
    task: BatchTask,
    error: SimulationError,
    simulate: Callable[[BatchTask], RolloutBatch],
) -> RolloutBatch:
    """The one rollout of a task up to its last outcome that was followed by nothing.

    Args:
        outcomes: How many it had by then.
        task: The rollout.
        error: What is raised if it breaks without any, so that there is nothing to keep.
        simulate: What simulates it; where it breaks at an earlier outcome now, less is kept.

    Raises:
        SimulationError: As above.
    """
    while outcomes:
        at = outcomes - 1
        try:
            return marked(simulate(replace(task, stays_from=at)), at)
        except SimulationError as again:
            if not again.broke:
                raise
            outcomes = min(again.outcomes or 0, at)
    raise error
