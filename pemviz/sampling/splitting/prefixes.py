"""Prefixes: rollouts up to some of their states, gone on with outcomes that are given."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.sampling.problem import Problem, ranked
from pemviz.sampling.state.composed import dynamics_of, kept_with_rollouts
from pemviz.simulators.latents import stepped
from pemviz.types import RolloutBatch, Simulator, StateBatch


@dataclass(frozen=True, eq=False)
class Prefixes:
    """M prefixes, each to a state, in the order of the states' steps.

    Attributes:
        rollouts: Whose prefixes they are.
        row: Which rollout, ``[M]``.
        step: To which of its states, ``[M]``, ascending.
    """

    rollouts: RolloutBatch
    row: IntArray
    step: IntArray

    def take(self, chosen: IntArray) -> "Prefixes":
        """Some of them, in their order."""
        return Prefixes(self.rollouts, self.row[chosen], self.step[chosen])

    def carried_on(self, problem: Problem, *, others: IntArray, then: BoolArray) -> FloatArray:
        """Robustness ``[M]``, `ranked`, of rollouts that go on to their ends with given outcomes.

        Args:
            problem: The scenario and the metric.
            others: How many of the next outcomes are not ``then``, ``[M]``.
            then: All later outcomes, ``[M]``.
        """
        simulator, until = dynamics_of(problem.simulator), self.step + others
        self._go_on(simulator, until, then)
        return ranked(problem, self._signals)

    @cached_property
    def _signals(self) -> Mapping[str, FloatArray]:
        """By name, ``[M, T]``; what lies after the states is overwritten by each going on."""
        # neighbours in memory are the rollouts of one step, which is written at a time
        return {
            name: np.asfortranarray(values.T.take(self.row, axis=-1).T)
            for name, values in self.rollouts.signals.items()
        }

    def _go_on(self, simulator: Simulator, until: IntArray, then: BoolArray) -> None:
        """Overwrite the signals after the states."""
        states = self._at(slice(0, 0), moment=0)
        for moment in range(int(self.step[0]), simulator.states - 1):
            before = states.shape[0]
            active = int(np.searchsorted(self.step, moment, side="right"))
            if active > before:
                arriving = self._at(slice(before, active), moment=moment)
                states = StateBatch.concatenate([replace(states, step=arriving.step), arriving])
            reached = stepped(simulator, states, then[:active] ^ (moment < until[:active]))
            for name, values in reached.signals.items():
                self._signals[name][:active, moment + 1] = values
            states = replace(
                reached,
                signals={**states.signals, **reached.signals},
                memory={**states.memory, **reached.memory},
            )

    def _at(self, prefixes: slice, *, moment: int) -> StateBatch:
        """The states that some of the prefixes lead to, all of the step ``moment``."""
        row, step = self.row[prefixes], self.step[prefixes]
        kept = kept_with_rollouts(self.rollouts.memory)
        return StateBatch(
            step=np.array(moment, dtype=np.int64),
            signals={name: values[row, step] for name, values in self.rollouts.signals.items()},
            memory={name: values[row, step] for name, values in kept.items()},
        )
