"""Frailty: what outcomes tell of the obstacle's visibility as part of the state.

:mod:`pemviz.pem.models.memory` gives the formulas. The state carries the posterior of the
obstacle's visibility u, and P(detected | outcomes so far) is a function of the state: methods need
to know nothing of u, and weights are those of outcomes with u integrated out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from scipy.special import log_ndtr

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import FEWEST, distinct_rows
from pemviz.pem.models.memory import (
    Memory,
    VisibilityNodes,
    frail_logit,
    log_sums,
    persistence,
    remembered_outcomes,
)
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.state.component import CARRIED, Known, ModelLogit
from pemviz.sampling.state.hidden import HiddenProperty, OwnLogit
from pemviz.sampling.state.last_outcome import last_outcome
from pemviz.types import RolloutBatch, Signal, StateBatch

VISIBILITY = Signal(name="visibility", key="visibility", unit="", low=-1e3, high=1e3)
"""Posterior mean of u; the larger, the harder to see the obstacle has proved."""
SEEN_LOGIT = Signal(name="seen_logit", key="seen_logit", unit="", low=-1e6, high=1e6)
"""Logit of P(detected | outcomes so far)."""
NEXT = f"{CARRIED}visibility after the next outcome"
"""Memory: log posterior of u_j if the next outcome is a miss, and if it is a detection, ``[N]``
records of ``missed [J]`` and ``detected [J]`` and of the posteriors' means."""
CHUNK_ROWS = 256
"""States at a time, so that what is known by node stays in the processor's cache."""


@dataclass(frozen=True)
class FilteredVisibility(HiddenProperty):
    """A filter of how hard to see the obstacle is, whose states say what P(detected) follows.

    Attributes:
        everywhere: Whether outcomes to which the scenario does not react are of interest too: they
            bring no violation nearer, but they tell something of the obstacle, and so change what
            the next ones are.
    """

    everywhere: bool = field(default=False, kw_only=True)

    signals: ClassVar[tuple[Signal, ...]] = (VISIBILITY, SEEN_LOGIT)

    @property
    def shown(self) -> tuple[str, ...]:
        """The logit alone."""
        return (SEEN_LOGIT.name,)

    def logit(self, shown: FloatArray, own: OwnLogit) -> FloatArray:  # noqa: ARG002  it is in it
        """The states say it."""
        return shown[..., 0]

    def features(self, states: StateBatch) -> tuple[FloatArray, ...]:
        """The posterior mean of the visibility."""
        return (states.signals[VISIBILITY.name],)

    def matters(self, features: StateFeatures, states: StateBatch) -> BoolArray | None:
        """As elsewhere, unless it is ``everywhere``."""
        return super().matters(features, states) if self.everywhere else None

    def for_proposals(self) -> Self:
        """The same, which acts ``everywhere``."""
        return replace(self, everywhere=True)


@dataclass(frozen=True)
class Visibility(FilteredVisibility):
    """Some obstacles are hard to see for as long as they are there.

    Attributes:
        memory: With a frailty above 0; its memory time, if any, is that of a
            :class:`~pemviz.sampling.state.last_outcome.LastOutcome` before this property.
        dt_s: Time between two outcomes [s].
    """

    memory: Memory
    dt_s: float

    @cached_property
    def nodes(self) -> VisibilityNodes:
        """Of the integral over u."""
        return VisibilityNodes(self.memory.frailty)

    @cached_property
    def rho(self) -> float:
        """Correlation of one outcome with the next, beyond what the obstacle explains."""
        return float(persistence(self.dt_s, self.memory.tau_s))

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:
        """Before any outcome u is a standard normal."""
        log_weight = self.nodes.log_weight
        everywhere = np.broadcast_to(log_weight, (*states.shape, log_weight.size))
        return self._known(states, model(states), everywhere, np.zeros(states.shape))

    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: ModelLogit
    ) -> Known:
        """The posterior of u after outcomes ``[N]``."""
        after = before.memory[NEXT]
        log_posterior = np.where(detected[:, None], after["detected"], after["missed"])
        mean = np.where(detected, after["mean_detected"], after["mean_missed"])
        return self._known(states, model(states), log_posterior, mean)

    def log_outcomes(self, own: FloatArray, last: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log P(missed) and log P(detected) by node, ``[N, J]``.

        From the logits of the model of single outcomes ``[N]`` and the outcome before ``[N]``.
        """
        return remembered_outcomes(self.nodes.log_outcomes(own), last=last, rho=self.rho)

    def log_outcome(self, own: FloatArray, last: FloatArray, missed: BoolArray) -> FloatArray:
        """Log probability by node ``[N, J]`` of outcomes ``[N]`` alone."""
        moved = self.nodes.moved(own)
        log_p = log_ndtr(np.where(missed[:, None], moved, -moved))
        if self.rho == 0.0:
            return log_p
        log_p += np.where(last == 0.0, 0.0, np.log1p(-self.rho))[:, None]
        again = (last != 0.0) & (missed == (last < 0.0))
        log_p[again] = np.logaddexp(log_p[again], np.log(self.rho))
        return log_p

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of rollouts' outcomes ``[N, T-1]`` together, ``[N]``."""
        log_joint = np.tile(self.nodes.log_weight, (len(detected), 1))
        last = np.zeros(len(detected))
        for step in range(detected.shape[1]):
            log_joint += self.log_outcome(own[:, step], last, ~detected[:, step])
            last = np.where(detected[:, step], 1.0, -1.0)
        return log_sums(log_joint)

    def memory_at(
        self, rollouts: RolloutBatch, *, step: IntArray, model: ModelLogit
    ) -> Mapping[str, AnyArray]:
        """What :data:`NEXT` holds at states of rollouts that led there, ``[N]``."""
        log_joint = np.tile(self.nodes.log_weight, (rollouts.count, 1))
        for moment in range(int(step[-1])):
            later = slice(int(np.searchsorted(step, moment, side="right")), None)
            logit, last = self._at(rollouts, later, moment, model)
            log_joint[later] += self.log_outcome(logit, last, ~rollouts.detected[later, moment])
        log_joint -= log_sums(log_joint)[:, None]
        logit, last = self._at(rollouts, np.arange(rollouts.count), step, model)
        return {NEXT: self._next(logit, last, log_joint)[0]}

    @staticmethod
    def _at(
        rollouts: RolloutBatch,
        rows: slice | IntArray,
        step: int | IntArray,
        model: ModelLogit,
    ) -> tuple[FloatArray, FloatArray]:
        signals = {name: values[rows, step] for name, values in rollouts.signals.items()}
        logit = model(StateBatch(np.asarray(step), signals))
        return logit, last_outcome(signals, otherwise=logit)

    def _known(
        self, states: StateBatch, own: FloatArray, log_posterior: FloatArray, mean: FloatArray
    ) -> Known:
        last = last_outcome(states.signals, otherwise=own)
        after, logit = self._next(own, last, log_posterior)
        return Known({VISIBILITY.name: mean, SEEN_LOGIT.name: logit}, {NEXT: after})

    def _next(
        self, own: FloatArray, last: FloatArray, log_posterior: FloatArray
    ) -> tuple[AnyArray, FloatArray]:
        """Posteriors after the next outcome, ``[N]`` records, and its logit ``[N]``."""
        nodes, log_outcomes = self.nodes, _log_outcomes(self, own, last)
        after, logit = np.empty(own.size, dtype=_record(nodes.u.size)), np.empty(own.size)
        for start in range(0, own.size, CHUNK_ROWS):
            rows = slice(start, start + CHUNK_ROWS)
            miss, hit = log_outcomes(rows)
            log_miss = _put(after[rows], "missed", log_posterior[rows] + miss, nodes.u)
            logit[rows] = _put(after[rows], "detected", log_posterior[rows] + hit, nodes.u)
            logit[rows] -= log_miss
        return after, logit


@dataclass(frozen=True)
class GivenVisibility(HiddenProperty):
    """Obstacles of one visibility u, as if it were known.

    Attributes:
        frailty: Spread of obstacles' own visibility, above 0.
        u: The visibility.
    """

    frailty: float
    u: float

    follows_model: ClassVar[bool] = False

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:  # noqa: ARG002  nothing to know
        """Nothing."""
        return Known({})

    def next(
        self,
        before: StateBatch,  # noqa: ARG002  as above
        detected: BoolArray,  # noqa: ARG002
        states: StateBatch,  # noqa: ARG002
        model: ModelLogit,  # noqa: ARG002
    ) -> Known:
        """Nothing."""
        return Known({})

    def logit(self, shown: FloatArray, own: OwnLogit) -> FloatArray:  # noqa: ARG002  as above
        """The model's own logits for the visibility, ``[...]``."""
        return frail_logit(own(), visibility=np.asarray(self.u), frailty=self.frailty)


def _log_outcomes(
    visibility: Visibility, own: FloatArray, last: FloatArray
) -> Callable[[slice], tuple[FloatArray, FloatArray]]:
    """What :meth:`Visibility.log_outcomes` gives some of states ``[N]``, of a chunk at a time.

    Rollouts meet few gaps, since equal outcomes lead to equal states: those are evaluated once.
    """
    same = distinct_rows(np.stack([own, last], axis=1)) if own.size >= FEWEST else None
    if same is None:
        return lambda rows: visibility.log_outcomes(own[rows], last[rows])
    first, place = same
    miss, hit = np.empty((2, first.size, visibility.nodes.u.size))
    for start in range(0, first.size, CHUNK_ROWS):
        rows = slice(start, start + CHUNK_ROWS)
        miss[rows], hit[rows] = visibility.log_outcomes(own[first[rows]], last[first[rows]])
    return lambda rows: (miss[place[rows]], hit[place[rows]])


def _record(nodes: int) -> np.dtype[Any]:
    outcomes, of_node, number = ("missed", "detected"), (np.float64, (nodes,)), (np.float64, ())
    return np.dtype(
        [(name, *of_node) for name in outcomes] + [(f"mean_{name}", *number) for name in outcomes]
    )


def _put(after: AnyArray, outcome: str, log_joint: FloatArray, u: FloatArray) -> FloatArray:
    """Write the posterior after an ``outcome``; its log probability ``[N]``."""
    largest = log_joint.max(axis=1)
    share = np.exp(log_joint - largest[:, None])
    total = share.sum(axis=1)
    log_p = np.log(total) + largest
    np.subtract(log_joint, log_p[:, None], out=after[outcome])
    after[f"mean_{outcome}"] = (share * u).sum(axis=1) / total
    return log_p
