"""How likely chains of outcomes are, for any memory time and frailty.

With misses that hang together as ``memory`` says (:mod:`pemviz.pem.models.memory`), an obstacle's
visibility u is integrated out by the nodes u_j and weights w_j of
:class:`pemviz.pem.models.frailty.VisibilityNodes`::

    log p(o_1 .. o_t) = log sum_j w_j prod_s P(o_s | s, o_{s-1}, u_j)
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtr

from pemviz.arrays import Batch, BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.pem.models.frailty import VisibilityNodes
from pemviz.pem.models.memory import Memory, miss_quantile, persistence
from pemviz.types import outcome_log_likelihood

ALWAYS = 4.0
"""Nodes within so many standard deviations are always looked at,"""
NOTHING = 40.0
"""and beyond them those that are not so many nats below the most likely one."""


@dataclass(frozen=True)
class Outcomes(Batch):
    """Outcomes before a violation, in the order of rollouts.

    Attributes:
        rollout: Which rollout, ``[M]``.
        basis: ``[M, B]``.
        missed: ``[M]``.
        last: The outcome before: missed (-1), detected (1), none (0), ``[M]``.
        logit: Of 'detected' under the model of single outcomes, ``[M]``.
        matters: Whether the scenario itself reacts, ``[M]``.
    """

    rollout: IntArray
    basis: FloatArray
    missed: BoolArray
    last: FloatArray
    logit: FloatArray
    matters: BoolArray


def under_logits(outcomes: Outcomes, logit: FloatArray, *, count: int) -> FloatArray:
    """Log likelihood of N rollouts' outcomes ``[N]``, under logits of 'detected' ``[M]``."""
    return _summed(outcomes, outcome_log_likelihood(logit, ~outcomes.missed), count)


@dataclass(frozen=True)
class ByNode:
    """What each visibility has to do with N rollouts.

    Attributes:
        u: Nodes, ``[J]``.
        log_joint: Log of weight times likelihood, ``[J, N]``.
    """

    u: FloatArray
    log_joint: FloatArray

    @property
    def log_likelihood(self) -> FloatArray:
        """With u integrated out, ``[N]``."""
        return np.asarray(log_sum_exp(self.log_joint, axis=0))

    @property
    def mean(self) -> FloatArray:
        """Posterior mean of u, ``[N]``."""
        share = np.exp(self.log_joint - np.max(self.log_joint, axis=0))
        return (self.u @ share) / share.sum(axis=0)


def by_node(outcomes: Outcomes, memory: Memory, *, dt_s: float, count: int) -> ByNode:
    """Outcomes of N rollouts under a frailty above 0.

    Nodes are taken from the middle outwards, until they add nothing to any rollout.
    """
    nodes = VisibilityNodes(memory.frailty)
    given = _GivenVisibility.of(outcomes, memory, dt_s=dt_s)
    middle = nodes.u.size // 2
    found: dict[int, FloatArray] = {}
    largest = np.full(count, -np.inf)

    def is_needed(place: int) -> bool:
        joint = nodes.log_weight[place] + _summed(outcomes, given.log_p(nodes.u[place]), count)
        found[place] = joint
        np.maximum(largest, joint, out=largest)
        near = abs(nodes.u[place]) < ALWAYS or place == middle
        return near or bool((joint > largest - NOTHING).any())

    for outwards in (range(middle, nodes.u.size), range(middle - 1, -1, -1)):
        for place in outwards:
            if not is_needed(place):
                break
    order = sorted(found)
    return ByNode(nodes.u[order], np.stack([found[place] for place in order]))


@dataclass(frozen=True)
class _GivenVisibility:
    """Outcomes' probabilities given u.

    Phi(quantile + slope u); times 1 - rho where an outcome came before, plus rho where it was the
    same.
    """

    quantile: FloatArray
    slope: FloatArray
    again: IntArray
    fresh: IntArray
    log_fresh: FloatArray
    rho: float

    @staticmethod
    def of(outcomes: Outcomes, memory: Memory, *, dt_s: float) -> "_GivenVisibility":
        """Of M outcomes."""
        sign = np.where(outcomes.missed, 1.0, -1.0)
        rho = float(persistence(dt_s, memory.tau_s))
        again = (sign * outcomes.last < 0.0) & (rho > 0.0)
        after_any = np.where(outcomes.last == 0.0, 0.0, math.log1p(-rho))
        return _GivenVisibility(
            quantile=sign * miss_quantile(outcomes.logit) * math.sqrt(1.0 + memory.frailty**2),
            slope=sign * memory.frailty,
            again=np.flatnonzero(again),
            fresh=np.flatnonzero(~again),
            log_fresh=after_any[~again],
            rho=rho,
        )

    def log_p(self, u: float) -> FloatArray:
        """Log probabilities ``[M]``."""
        moved = self.quantile + self.slope * u
        if self.rho == 0.0:
            return log_ndtr(moved)
        log_p = np.empty(moved.size)
        log_p[self.fresh] = log_ndtr(moved[self.fresh]) + self.log_fresh
        log_p[self.again] = np.log(self.rho + (1.0 - self.rho) * ndtr(moved[self.again]))
        return log_p


def _summed(outcomes: Outcomes, log_p: FloatArray, count: int) -> FloatArray:
    return np.bincount(outcomes.rollout, weights=log_p, minlength=count).astype(np.float64)
