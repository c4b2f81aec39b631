"""How likely outcomes become if misses become rarer, or bursts shorter: by re-weighting.

A rollout's likelihood is a product over its steps, so how it changes is a sum of what changes at
each step. A step's factor is that of :mod:`pemviz.pem.models.memory`: with p the model's own
P(missed) in the state, r = exp(-dt / tau) and m = 1 after a miss, 0 after a hit, P(missed) is
p (1 - r) + m r. The first outcome has r = 0, and so has every outcome without a memory.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import expit, log_expit

from pemviz.arrays import BoolArray, FloatArray, row_sums
from pemviz.pem.models.memory import persistence
from pemviz.types import LAST_OUTCOME, RolloutBatch


class OutcomeLikelihood(Protocol):
    """Changes of M rollouts' log likelihoods."""

    def log_change_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What it adds ``[M]`` if misses ``inside [M, T-1]`` are ``factor`` times as likely.

        With a factor in (0, 1].
        """
        ...

    def slope(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of P(missed) at each step."""
        ...


class MemoryLikelihood(Protocol):
    """Changes with the memory time too."""

    @property
    def tau_s(self) -> float:
        """Memory time [s], above 0."""
        ...

    def log_change_of_tau_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What it adds ``[M]`` if the memory time is ``factor`` times as long, in (0, 1].

        Args:
            inside: The steps that decide, ``[M, T-1]``.
            factor: The same at all of them.
        """
        ...

    def slope_of_tau(self) -> FloatArray:
        """Derivative ``[M, T-1]`` in the log of the memory time, by step."""
        ...


class StepByStep(ABC):
    """A likelihood to which each step adds something of its own."""

    @abstractmethod
    def log_change(self, *, factor: float) -> FloatArray:
        """What it adds ``[M, T-1]`` if misses are ``factor`` times as likely, in (0, 1]."""

    def log_change_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """What it adds ``[M]`` if misses ``inside [M, T-1]`` are ``factor`` times as likely.

        With a factor in (0, 1].
        """
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

    def log_change_of_tau(self, *, factor: float) -> FloatArray:
        """What it adds ``[M, T-1]`` if the memory time is ``factor`` times as long, in (0, 1]."""
        fresh = np.where(self.missed, self.miss, 1.0 - self.miss)
        kept, shorter = self._kept(1.0), self._kept(factor)
        other = np.log1p(-shorter) - np.log1p(-kept)
        with np.errstate(divide="ignore", invalid="ignore"):  # what only the memory makes possible
            same = np.log(fresh + (1.0 - fresh) * shorter) - np.log(fresh + (1.0 - fresh) * kept)
        return np.where(self.again, same, other)

    def log_change_of_tau_within(self, inside: BoolArray, *, factor: float) -> FloatArray:
        """The sum ``[M]`` of what steps ``inside [M, T-1]`` add."""
        return row_sums(np.where(inside, self.log_change_of_tau(factor=factor), 0.0))

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
