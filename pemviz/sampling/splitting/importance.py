"""How far a state is from a violation: the importance function that splitting's levels cut.

Splitting is unbiased with any importance function that is below 0 at the end of every rollout that
violates; the nearer it is to a decreasing function of the probability of a violation from there on,
the smaller is the variance (Garvels, Van Ommeren, Kroese 2002; Cerou, Guyader, Rousset 2019).
"""

from collections.abc import Callable

import numpy as np
from scipy.special import log_expit

from pemviz.arrays import FloatArray, IntArray
from pemviz.chunks import distinct_rows
from pemviz.sampling.problem import Problem
from pemviz.sampling.splitting.prefixes import Prefixes
from pemviz.types import RolloutBatch

OUT_OF_REACH = 1e9
"""Added where neither extreme continuation violates: above what any other state has."""
BLOCK_VALUES = 1 << 20
"""Values of one signal that continuations take up at a time."""


def importance(
    problem: Problem, rollouts: RolloutBatch, *, row: IntArray, step: IntArray
) -> FloatArray:
    """About -log of the probability of a violation [nats] from states ``(row, step)``, ``[M]``.

    From such a state the scenario goes on to its end with everything detected and with
    everything missed, noise at 0. With ``best`` the higher robustness of the two and ``worst`` the
    lower:

    - where both violate, the function is ``best``, which is below 0;
    - where neither does, it is ``OUT_OF_REACH + worst``;
    - between, it goes on as for ``best`` but with the other outcome at the next j steps. With
      the smallest such j that violates, and q the probability of the other outcome here, the
      function is ``-j log q``; j is interpolated so that it tells how near the robustness came.

    Args:
        problem: The scenario and the metric.
        rollouts: N rollouts; the function at a state depends on the states up to it alone.
        row: Which rollout.
        step: Which of its states but the last.

    Returns:
        ``[M]``.
    """
    result = np.empty(row.size)
    order = np.argsort(step, kind="stable")
    block = max(BLOCK_VALUES // (2 * problem.simulator.states), 1)
    for start in range(0, row.size, block):
        problem.pause()
        chosen = order[start : start + block]
        result[chosen] = _of_block(problem, rollouts, row[chosen], step[chosen])
    return result


def importance_at_end(robustness: FloatArray) -> FloatArray:
    """The importance function of last states, from rollouts `ranked` ``[N]``."""
    return np.where(robustness < 0.0, robustness, OUT_OF_REACH + robustness)


def _of_block(
    problem: Problem, rollouts: RolloutBatch, row: IntArray, step: IntArray
) -> FloatArray:
    """The function for few enough states, in the order of their steps."""
    alike = _alike(rollouts, row, step)
    if alike is not None:
        first, which = alike
        return _of_block(problem, rollouts, row[first], step[first])[which]
    prefixes = Prefixes(rollouts, row, step)
    none = np.zeros(row.size, dtype=np.int64)
    detected, missed = (
        prefixes.carried_on(problem, others=none, then=np.full(row.size, outcome))
        for outcome in (True, False)
    )
    best, worst = np.maximum(detected, missed), np.minimum(detected, missed)
    result = np.where(best < 0.0, best, OUT_OF_REACH + worst)
    between = np.flatnonzero((best >= 0.0) & (worst < 0.0))
    if between.size:
        prefixes = prefixes if between.size == row.size else prefixes.take(between)
        better = detected[between] >= missed[between]
        needed = _needed_on_end(
            lambda others: prefixes.carried_on(problem, others=others, then=better),
            best[between],
            worst[between],
            steps_left=problem.simulator.states - 1 - prefixes.step,
        )
        logit = rollouts.pem_logit[row[between], prefixes.step]
        result[between] = -needed * log_expit(np.where(better, -logit, logit))
    return result


def _alike(
    rollouts: RolloutBatch, row: IntArray, step: IntArray
) -> tuple[IntArray, IntArray] | None:
    """Which states were led to by the same outcomes: see :func:`pemviz.chunks.distinct_rows`.

    ``None`` where chance has more to say than outcomes, or few are alike.
    """
    if rollouts.latents is not None:
        return None
    outcomes = rollouts.detected[row] & (np.arange(rollouts.detected.shape[1]) < step[:, None])
    bits = np.packbits(outcomes, axis=1)
    keys = np.zeros((row.size, bits.shape[1] // 8 + 2))
    keys[:, 0] = step
    keys[:, 1:].view(np.uint8)[:, : bits.shape[1]] = bits
    return distinct_rows(keys)


def _needed_on_end(
    robustness: Callable[[IntArray], FloatArray],
    best: FloatArray,
    worst: FloatArray,
    *,
    steps_left: IntArray,
) -> FloatArray:
    """How many of the next outcomes must be the other one for a robustness of 0, ``[M]``.

    Bisection; between two whole numbers the robustness is taken to be linear.

    Args:
        robustness: How many they are, ``[M]``, to the robustness then.
        best: With none, at least 0.
        worst: With all that are left, below 0.
        steps_left: How many those are.
    """
    low, high = np.zeros_like(steps_left), steps_left
    above, below = best, worst
    while (high - low > 1).any():
        middle = (low + high) // 2
        found = robustness(middle)
        fails = found < 0.0
        low, high = np.where(fails, low, middle), np.where(fails, middle, high)
        above, below = np.where(fails, above, found), np.where(fails, found, below)
    return low + (high - low) * (above / (above - below))
