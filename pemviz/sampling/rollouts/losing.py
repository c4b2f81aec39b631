"""Rollouts that cannot be simulated to their end, in place of a run that ends at them.

The simulator raises something at a step, or ends its process, whenever it is tried. Such a rollout
is what it was up to there: from the outcome on that the step was given the scenario stays as it is,
and outcomes go on as the error model has them. It is thereby a rollout of a scenario with one more
state, from which nothing leads away, and has the weight of its outcomes: whoever averages weights
may count it as he likes.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pemviz.arrays import BoolArray, IntArray
from pemviz.faults import SimulationError
from pemviz.sampling.rollouts.runners import BatchTask
from pemviz.types import LOST, RolloutBatch


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
