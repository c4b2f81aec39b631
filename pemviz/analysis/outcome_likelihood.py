"""How likely outcomes become if misses become rarer, or bursts shorter: by re-weighting.

A rollout's likelihood is a product over its steps, so how it changes is a sum of what changes at
each step. A step's factor is that of :mod:`pemviz.pem.models.memory`: with p the model's own
P(missed) in the state, r = exp(-dt / tau) and m = 1 after a miss, 0 after a hit, P(missed) is
p (1 - r) + m r. The first outcome has r = 0, and so has every outcome without a memory.

Where obstacles differ (frailty) a rollout's likelihood is an integral over the obstacle's
visibility u, a sum over nodes u_j with weights w_j (:mod:`pemviz.pem.models.memory`)::

    L = sum_j w_j prod_t P(o_t | s_t, o_{t-1}, u_j)
    d log L = sum_t sum_j P(u_j | all outcomes) d log P(o_t | s_t, o_{t-1}, u_j)

so that derivatives still are sums over steps (Louis 1982, Journal of the Royal Statistical Society
B 44:226).
"""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit, log_expit, log_ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums
from pemviz.pem.models.memory import Memory, log_sums, miss_quantile, persistence
from pemviz.sampling.state.composed import ComposedSimulator
from pemviz.sampling.state.last_outcome import last_outcome
from pemviz.sampling.state.visibility import Visibility
from pemviz.types import LAST_OUTCOME, VIOLATED, RolloutBatch

CHUNK_OUTCOMES = 20_000
LOG_ROOT_TWO_PI = 0.5 * math.log(2.0 * math.pi)

Slopes = Callable[[IntArray, IntArray], FloatArray]
"""Rows and steps ``[K]`` to derivatives by node ``[K, J]``."""


class StepByStep(ABC):
    """A likelihood to which each step adds something of its own."""

    @abstractmethod
    def log_change(self, *, factor: float) -> FloatArray:
        """What it adds ``[M, T-1]`` if misses are ``factor`` times as likely, in (0, 1]."""

    def log_change_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What it adds ``[M]`` if misses ``inside [M, T-1]`` alone are."""
        return row_sums(np.where(inside, self.log_change(factor=factor), 0.0))


@dataclass(frozen=True, eq=False)
class IndependentOutcomes(StepByStep):
    """Of outcomes that are independent given the state.

    Attributes:
        missed: Outcomes ``[M, T-1]``.
        miss: P(missed) ``[M, T-1]``.
    """

    missed: BoolArray
    miss: FloatArray

    @staticmethod
    def of(rollouts: RolloutBatch) -> "IndependentOutcomes":
        """Those of rollouts without a memory."""
        return IndependentOutcomes(~rollouts.detected, expit(-rollouts.pem_logit))

    def log_change(self, *, factor: float) -> FloatArray:
        """What it adds ``[M, T-1]`` if misses are ``factor`` times as likely, in (0, 1]."""
        with np.errstate(divide="ignore", invalid="ignore"):  # where a miss is certain
            hits = np.log1p(-factor * self.miss) - np.log1p(-self.miss)
        return np.where(self.missed, math.log(factor), hits)

    def slope(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of P(missed)."""
        with np.errstate(divide="ignore", invalid="ignore"):  # certain misses: no figure
            return np.where(self.missed, 1.0, -self.miss / (1.0 - self.miss))


@dataclass(frozen=True, eq=False)
class RememberedOutcomes(StepByStep):
    """Of outcomes that depend on the one before; P(missed) is the model's own, in the state alone.

    Attributes:
        missed: Outcomes ``[M, T-1]``.
        again: Whether the outcome is that of the step before ``[M, T-1]``.
        first: Whether there is no outcome before ``[M, T-1]``.
        miss: The model's own P(missed | state) ``[M, T-1]``.
        tau_s: Memory time [s], above 0.
        dt_s: Time between two outcomes [s].
    """

    missed: BoolArray
    again: BoolArray
    first: BoolArray
    miss: FloatArray
    tau_s: float
    dt_s: float

    @staticmethod
    def of(rollouts: RolloutBatch, *, tau_s: float, dt_s: float) -> "RememberedOutcomes":
        """Those of rollouts with a memory; their logits, given the outcome before, tell p.

        Of ``P(missed | hit before) = p (1 - r)`` and ``P(detected | miss before) =
        (1 - p) (1 - r)`` that which applies is solved for p, without loss of digits in p after a
        hit and in 1 - p after a miss.
        """
        last = rollouts.decision_states().signals[LAST_OUTCOME.name]
        log_rest = math.log(-math.expm1(-dt_s / tau_s))
        after_hit = np.exp(log_expit(-rollouts.pem_logit) - log_rest)
        after_miss = -np.expm1(log_expit(rollouts.pem_logit) - log_rest)
        own = np.where(last < 0.0, after_miss, after_hit)
        missed, first = ~rollouts.detected, last == 0.0
        return RememberedOutcomes(
            missed=missed,
            again=~first & (missed == (last < 0.0)),
            first=first,
            miss=np.where(first, expit(-rollouts.pem_logit), np.clip(own, 0.0, 1.0)),
            tau_s=tau_s,
            dt_s=dt_s,
        )

    def log_change(self, *, factor: float) -> FloatArray:
        """What it adds ``[M, T-1]`` if misses are ``factor`` times as likely, in (0, 1]."""
        kept = self._kept(1.0)
        fresh = np.where(self.missed, self.miss, 1.0 - self.miss)
        with np.errstate(divide="ignore", invalid="ignore"):  # where a miss is certain
            rarer = np.where(self.missed, factor * self.miss, 1.0 - factor * self.miss)
            change = np.log(rarer * (1.0 - kept) + self.again * kept)
            change -= np.log(fresh * (1.0 - kept) + self.again * kept)
        return np.where(self.missed & ~self.again, math.log(factor), change)

    def slope(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of the model's own P(missed)."""
        kept = self._kept(1.0)
        fresh = np.where(self.missed, self.miss, 1.0 - self.miss)
        with np.errstate(divide="ignore", invalid="ignore"):  # certain misses: no figure
            slope = self.miss * (1.0 - kept) / (fresh * (1.0 - kept) + self.again * kept)
        return np.where(self.missed, np.where(self.again, slope, 1.0), -slope)

    def log_change_of_tau_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What steps ``inside`` add ``[M]`` if tau is ``factor`` times as long, in (0, 1]."""
        fresh = np.where(self.missed, self.miss, 1.0 - self.miss)
        kept, shorter = self._kept(1.0), self._kept(factor)
        other = np.log1p(-shorter) - np.log1p(-kept)
        with np.errstate(divide="ignore", invalid="ignore"):  # what only the memory makes possible
            same = np.log(fresh + (1.0 - fresh) * shorter) - np.log(fresh + (1.0 - fresh) * kept)
        return row_sums(np.where(inside, np.where(self.again, same, other), 0.0))

    def slope_of_tau(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of the memory time: d r / d log tau = r dt / tau."""
        fresh = np.where(self.missed, self.miss, 1.0 - self.miss)
        kept = self._kept(1.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # what only the memory makes possible
            same = (1.0 - fresh) / (fresh + (1.0 - fresh) * kept)
        return np.where(self.again, same, -1.0 / (1.0 - kept)) * kept * self.dt_s / self.tau_s

    def _kept(self, factor: float) -> FloatArray:
        """The r of each outcome ``[M, T-1]`` with a memory time ``factor`` times as long."""
        return np.where(self.first, 0.0, float(persistence(self.dt_s, factor * self.tau_s)))


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
        rollouts: RolloutBatch, *, system: ComposedSimulator, visibility: Visibility
    ) -> "FrailOutcomes":
        """Those of rollouts on a system one of whose properties is ``visibility``."""
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
        """What it adds ``[M]`` if misses ``inside [M, T-1]`` are that likely, in (0, 1]."""
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
        log_fresh = np.where(self.last[row, step] == 0.0, 0.0, math.log1p(-self.visibility.rho))
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
        return np.where((last == 0.0)[:, None], 0.0, slope)

    def _log_p(self, row: IntArray, step: IntArray) -> FloatArray:
        return self.visibility.log_outcome(
            self.own[row, step], self.last[row, step], self.missed[row, step]
        )


def _chunks(chosen: BoolArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Rows and steps of the chosen, in order of rows, some at a time; a row may be divided."""
    row, step = np.nonzero(chosen)
    edges = [*range(0, row.size, CHUNK_OUTCOMES), row.size]
    for start, stop in itertools.pairwise(edges):
        yield row[start:stop], step[start:stop]


OutcomeLikelihood = IndependentOutcomes | RememberedOutcomes | FrailOutcomes
MemoryLikelihood = RememberedOutcomes | FrailOutcomes
