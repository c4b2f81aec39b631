"""How likely outcomes become if misses become rarer, or bursts shorter, where obstacles differ.

With frailty a rollout's likelihood is an integral over the obstacle's visibility u, a sum over
nodes u_j with weights w_j (:mod:`pemviz.pem.models.frailty`), and not a product over steps::

    L = sum_j w_j prod_t P(o_t | s_t, o_{t-1}, u_j)
    d log L = sum_t sum_j P(u_j | all outcomes) d log P(o_t | s_t, o_{t-1}, u_j)

so that derivatives still are sums over steps (Louis 1982, Journal of the Royal Statistical Society
B 44:226).
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from pemviz.analysis.causes import Failures
from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.pem.models.frailty import log_sums
from pemviz.pem.models.memory import Memory, miss_quantile
from pemviz.sampling.state.composed import ComposedSimulator
from pemviz.sampling.state.last_outcome import last_outcome
from pemviz.sampling.state.visibility import Visibility
from pemviz.simulators.absorbing import VIOLATED

CHUNK_OUTCOMES = 20_000
LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)

Slopes = Callable[[IntArray, IntArray], FloatArray]
"""Rows and steps ``[K]`` to derivatives by node ``[K, J]``."""


@dataclass(frozen=True, eq=False)
class FrailOutcomes:
    """Of M rollouts' outcomes; those after a violation are left out, which sums over them.

    Attributes:
        visibility: How obstacles differ.
        own: Logit of 'detected' of the model of single outcomes, ``[M, T-1]``.
        last: The outcome before: missed (-1), detected (1), none (0), ``[M, T-1]``.
        missed: ``[M, T-1]``.
        counting: Which outcomes count, ``[M, T-1]``.
    """

    visibility: Visibility
    own: FloatArray
    last: FloatArray
    missed: BoolArray
    counting: BoolArray

    @staticmethod
    def of(
        failures: Failures, *, system: ComposedSimulator, visibility: Visibility
    ) -> "FrailOutcomes":
        """Those of violations on a system one of whose properties is ``visibility``."""
        rollouts = failures.rollouts
        states, shape = rollouts.decision_states(), rollouts.detected.shape
        own = system.own_logit(states)
        violated = states.memory.get(VIOLATED)
        return FrailOutcomes(
            visibility=visibility,
            own=own,
            last=last_outcome(states.signals, otherwise=own),
            missed=~rollouts.detected,
            counting=np.ones(shape, dtype=np.bool_) if violated is None else ~violated,
        )

    @property
    def tau_s(self) -> float:
        """Memory time [s]."""
        return self.visibility.memory.tau_s

    def log_change_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What it adds ``[M]`` if misses ``inside [M, T-1]`` are ``factor`` times as likely.

        With a factor in (0, 1].
        """
        log_miss = math.log(factor) - np.logaddexp(0.0, self.own)
        with np.errstate(divide="ignore"):  # where a miss is certain and stays so
            rarer = np.log(-np.expm1(log_miss)) - log_miss
        own = np.where(inside, rarer if factor < 1.0 else self.own, self.own)
        return self._log_change(replace(self, own=own), inside & self.counting)

    def log_change_of_tau_within(self, inside: BoolArray, *, factor: float) -> FloatArray:  # noqa: ARG002
        """What it adds ``[M]`` if the memory time is ``factor`` times as long, in (0, 1]."""
        memory = Memory(tau_s=factor * self.tau_s, frailty=self.visibility.memory.frailty)
        other = replace(self, visibility=replace(self.visibility, memory=memory))
        return self._log_change(other, self.counting)

    def slope(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of P(missed) at each step."""
        return self._slope

    @cached_property
    def _slope(self) -> FloatArray:
        return self._mean_slope(self._node_slopes)

    def slope_of_tau(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of the memory time, by step."""
        return self._mean_slope(self._node_slopes_of_tau)

    def _log_change(self, other: "FrailOutcomes", changed: BoolArray) -> FloatArray:
        after = self._joint + other._by_node(changed) - self._by_node(changed)
        return log_sums(after) - log_sums(self._joint)

    @cached_property
    def _joint(self) -> FloatArray:
        """Log probability of u_j and of all outcomes that count, ``[M, J]``."""
        return self.visibility.nodes.log_weight + self._by_node(self.counting)

    def _by_node(self, chosen: BoolArray) -> FloatArray:
        """Log likelihood ``[M, J]`` of the ``chosen [M, T-1]`` outcomes given u_j."""
        result = np.zeros((len(chosen), self.visibility.nodes.u.size))
        for row, step in _chunks(chosen):
            log_p = self._log_p(row, step)
            first = np.flatnonzero(np.diff(row, prepend=-1))
            result[row[first]] += np.add.reduceat(log_p, first, axis=0)
        return result

    def _mean_slope(self, by_node: Slopes) -> FloatArray:
        posterior = np.exp(self._joint - log_sums(self._joint)[:, None])
        result = np.zeros(self.missed.shape)
        for row, step in _chunks(self.counting):
            result[row, step] = (posterior[row] * by_node(row, step)).sum(axis=1)
        return result

    def _node_slopes(self, row: IntArray, step: IntArray) -> FloatArray:
        """D log P(outcome) / d log p by node, ``[K, J]``."""
        own, nodes = self.own[row, step], self.visibility.nodes
        quantile, moved = miss_quantile(own), nodes.moved(own)
        # d Phi^-1(p) / d log p is p over the normal density there
        log_rate = -np.logaddexp(0.0, own) + 0.5 * quantile**2 + LOG_ROOT_TWO_PI
        log_density = -0.5 * moved**2 - LOG_ROOT_TWO_PI
        log_fresh = np.where(self._first(row, step), 0.0, math.log1p(-self.visibility.rho))
        log_scale = 0.5 * math.log1p(nodes.frailty**2)
        change = (log_scale + log_rate + log_fresh)[:, None] + log_density
        sign = np.where(self.missed[row, step], 1.0, -1.0)[:, None]
        return sign * np.exp(change - self._log_p(row, step))

    def _node_slopes_of_tau(self, row: IntArray, step: IntArray) -> FloatArray:
        """D log P(outcome) / d log tau by node, ``[K, J]``: d rho / d log tau = rho dt / tau."""
        moved, rho = self.visibility.nodes.moved(self.own[row, step]), self.visibility.rho
        missed, last = self.missed[row, step], self.last[row, step]
        again = (missed == (last < 0.0))[:, None]
        other = np.where(missed[:, None], -moved, moved)  # the opposite outcome, without memory
        same, changed = np.exp(log_ndtr(other) - self._log_p(row, step)), -1.0 / (1.0 - rho)
        slope = np.where(again, same, changed) * rho * self.visibility.dt_s / self.tau_s
        return np.where(self._first(row, step)[:, None], 0.0, slope)

    def _log_p(self, row: IntArray, step: IntArray) -> FloatArray:
        return self.visibility.log_outcome(
            self.own[row, step], self.last[row, step], self.missed[row, step]
        )

    def _first(self, row: IntArray, step: IntArray) -> BoolArray:
        return self.last[row, step] == 0.0


def _chunks(chosen: BoolArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Rows and steps of the chosen, in order of rows, some at a time; a row may be divided."""
    row, step = np.nonzero(chosen)
    edges = [*range(0, row.size, CHUNK_OUTCOMES), row.size]
    for start, stop in itertools.pairwise(edges):
        yield row[start:stop], step[start:stop]
