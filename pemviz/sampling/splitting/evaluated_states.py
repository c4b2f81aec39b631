"""At which states of a particle the importance function is computed."""

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, IntArray
from pemviz.sampling.problem import Problem
from pemviz.sampling.splitting.moving import is_last_of_step, states_at
from pemviz.sampling.state.composed import dynamics_of
from pemviz.simulators.latents import stepped
from pemviz.types import CERTAIN, RolloutBatch, Simulator, StateBatch

MOST_EVALUATIONS = 64
"""States of one rollout at which the importance function is computed at most, so that what a
rollout costs grows with its length and not with its square; half of them may be at its start,
the rest come evenly over the steps."""
EVALUATION_COUNT = np.int16
"""Of their numbers."""


def evaluated_at(
    problem: Problem, rollouts: RolloutBatch, *, cut: IntArray, evaluations: AnyArray
) -> BoolArray:
    """At which states ``[N, T]`` after ``cut [N]``, ascending, it is computed.

    That is where an outcome that was not the likelier one has just led elsewhere than the
    other would have: outcomes that change nothing, and those that were to be expected, bring
    a rollout no nearer. So may a step's noise, always. The last states are not among them, since
    nothing follows.

    Args:
        problem: The scenario.
        rollouts: N, whole.
        cut: The last state of each that was evaluated before, or passed over.
        evaluations: ``[N, T]``: how often it was computed so far; overwritten after ``cut``.
    """
    count, steps = rollouts.detected.shape
    to_evaluate = np.zeros((count, steps + 1), dtype=np.bool_, order="F")
    pending = np.zeros(count, dtype=np.bool_)
    for step in range(int(cut[0]), steps):
        active = int(np.searchsorted(cut, step, side="right"))
        detected = rollouts.detected[:active, step]
        if is_last_of_step(rollouts, step, turns=problem.turns):
            pending[:active] = True
        else:
            unlikely = np.flatnonzero(detected != (rollouts.pem_logit[:active, step] >= 0.0))
            if unlikely.size:
                pending[unlikely] |= _mattered(problem.simulator, rollouts, step, unlikely)
        # where the outcome is certain, the state's logit says nothing about the way to a violation
        certain = (
            rollouts.memory[CERTAIN][:active, step + 1] if CERTAIN in rollouts.memory else False
        )
        ready = pending[:active] & ~np.asarray(certain)
        pending[:active] &= ~_marked(to_evaluate, evaluations, ready, step + 1)
    return to_evaluate


def _marked(
    to_evaluate: BoolArray, evaluations: AnyArray, ready: BoolArray, step: int
) -> BoolArray:
    """Decide and tell which of the first particles, ``ready [M]``, are evaluated at ``step``."""
    last, active = evaluations.shape[1] - 1, ready.size
    allowed = MOST_EVALUATIONS * (last + step) // (2 * last) if step < last else 0
    before = evaluations[:active, step - 1]
    chosen = ready & (before < allowed)
    to_evaluate[:active, step] = chosen
    evaluations[:active, step] = before + chosen
    return chosen


def _mattered(simulator: Simulator, rollouts: RolloutBatch, step: int, rows: IntArray) -> BoolArray:
    """Whether the other outcome at ``step`` would have led the ``rows [M]`` elsewhere."""
    before, after = (_rows_at(rollouts, moment, rows) for moment in (step, step + 1))
    other = stepped(dynamics_of(simulator), before, ~rollouts.detected[rows, step])
    differs = np.zeros(rows.size, dtype=np.bool_)
    for reached, instead in ((after.signals, other.signals), (after.memory, other.memory)):
        for name, values in instead.items():
            differs |= np.asarray(reached[name] != values, dtype=np.bool_)
    return differs


def _rows_at(rollouts: RolloutBatch, step: int, rows: IntArray) -> StateBatch:
    return states_at(rollouts, step, rollouts.count).take(rows)
