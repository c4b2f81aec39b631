"""How far a state is from a violation: the importance function that splitting's levels cut.

Splitting is unbiased with any importance function that is below 0 at the end of every rollout that
violates; the nearer it is to a decreasing function of the probability of a violation from there on,
the smaller is the variance (Garvels, Van Ommeren, Kroese 2002; Cerou, Guyader, Rousset 2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_expit

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import distinct_rows
from pemviz.sampling.problem import Problem, ranked
from pemviz.sampling.state.composed import dynamics_of
from pemviz.simulators.latents import stepped
from pemviz.types import CERTAIN, RolloutBatch, Simulator, StateBatch

MOST_EVALUATIONS = 64
"""States of one rollout at which the importance function is computed at most, so that what a
rollout costs grows with its length and not with its square; half of them may be at its start,
the rest come evenly over the steps."""
EVALUATION_COUNT = np.int16
"""Of their numbers."""
OUT_OF_REACH = 1e9
"""Added where neither extreme continuation violates: above what any other state has."""
BLOCK_VALUES = 1 << 20
"""Values of one signal that continuations take up at a time."""


def states_at(rollouts: RolloutBatch, step: int, rows: slice | IntArray) -> StateBatch:
    """The kept states of some rollouts."""
    return StateBatch(
        step=np.array(step, dtype=np.int64),
        signals={name: values[rows, step] for name, values in rollouts.signals.items()},
        memory={name: values[rows, step] for name, values in rollouts.memory.items()},
    )


def is_last_of_step(rollouts: RolloutBatch, outcome: int, *, turns: int) -> bool:
    """Whether there is noise in the scenario, and an outcome is followed by it."""
    latents = rollouts.latents
    return latents is not None and latents.noise.shape[2] > 0 and (outcome + 1) % turns == 0


def evaluated_at(
    problem: Problem, rollouts: RolloutBatch, *, cut: IntArray, evaluations: AnyArray
) -> BoolArray:
    """At which states ``[N, T]`` after ``cut [N]``, ascending, the importance function is computed.

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
        ready = pending[:active].copy()
        if CERTAIN in rollouts.memory:
            # where the outcome is certain, its logit says nothing about the way to a violation
            ready &= ~rollouts.memory[CERTAIN][:active, step + 1]
        after = step + 1
        allowed = MOST_EVALUATIONS * (steps + after) // (2 * steps) if after < steps else 0
        before = evaluations[:active, step]
        chosen = ready & (before < allowed)
        to_evaluate[:active, after] = chosen
        evaluations[:active, after] = before + chosen
        pending[:active] &= ~chosen
    return to_evaluate


def _mattered(simulator: Simulator, rollouts: RolloutBatch, step: int, rows: IntArray) -> BoolArray:
    """Whether the other outcome at ``step`` would have led the ``rows [M]`` elsewhere."""
    before, after = (states_at(rollouts, moment, rows) for moment in (step, step + 1))
    other = stepped(dynamics_of(simulator), before, ~rollouts.detected[rows, step])
    differs = np.zeros(rows.size, dtype=np.bool_)
    for reached, instead in ((after.signals, other.signals), (after.memory, other.memory)):
        for name, values in instead.items():
            differs |= np.asarray(reached[name] != values, dtype=np.bool_)
    return differs


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

    It depends on the rollouts up to the states alone, none of which is a last one.
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
    same = _led_to_by_the_same(rollouts, row, step)
    if same is not None:
        first, which = same
        return _of_block(problem, rollouts, row[first], step[first])[which]
    prefixes = _Prefixes(rollouts, row, step)
    none = np.zeros(row.size, dtype=np.int64)
    detected, missed = (
        prefixes.carried_on(problem, others=none, then=np.full(row.size, outcome))
        for outcome in (True, False)
    )
    best, worst = np.maximum(detected, missed), np.minimum(detected, missed)
    result = np.where(best < 0.0, best, OUT_OF_REACH + worst)
    between = np.flatnonzero((best >= 0.0) & (worst < 0.0))
    if between.size:
        if between.size < row.size:
            prefixes = _Prefixes(rollouts, row[between], step[between])
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


def _led_to_by_the_same(
    rollouts: RolloutBatch, row: IntArray, step: IntArray
) -> tuple[IntArray, IntArray] | None:
    """Which states the same outcomes led to: see :func:`pemviz.chunks.distinct_rows`.

    ``None`` where chance has more to say than outcomes, or few states are equal.
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

    Bisection; between two whole numbers the robustness is taken to be linear. With none it is
    ``best``, at least 0, with all that are left ``worst``, below 0.
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


@dataclass(frozen=True, eq=False)
class _Prefixes:
    """Rollouts ``row [M]`` up to their states ``step [M]``, ascending, gone on with outcomes."""

    rollouts: RolloutBatch
    row: IntArray
    step: IntArray

    def carried_on(self, problem: Problem, *, others: IntArray, then: BoolArray) -> FloatArray:
        """Robustness ``[M]``, `ranked`, of rollouts that go on to their ends with given outcomes.

        The next outcomes, ``others [M]`` of them, are not ``then [M]``; all later ones are.
        """
        simulator, until = dynamics_of(problem.simulator), self.step + others
        states = states_at(self.rollouts, 0, self.row[:0])
        for moment in range(int(self.step[0]), simulator.states - 1):
            before = states.shape[0]
            active = int(np.searchsorted(self.step, moment, side="right"))
            if active > before:
                arriving = states_at(self.rollouts, moment, self.row[before:active])
                states = StateBatch.concatenate([replace(states, step=arriving.step), arriving])
            reached = stepped(simulator, states, then[:active] ^ (moment < until[:active]))
            for name, values in reached.signals.items():
                self._signals[name][:active, moment + 1] = values
            states = replace(
                reached,
                signals={**states.signals, **reached.signals},
                memory={**states.memory, **reached.memory},
            )
        return ranked(problem, self._signals)

    @cached_property
    def _signals(self) -> Mapping[str, FloatArray]:
        """By name, ``[M, T]``; what lies after the states is overwritten by each going on."""
        # neighbours in memory are the rollouts of one step, which is written at a time
        return {
            name: np.asfortranarray(values.T.take(self.row, axis=-1).T)
            for name, values in self.rollouts.signals.items()
        }
