"""A visibility of which a part comes and goes, as part of the state.

:mod:`pemviz.pem.models.varying_frailty` gives the formulas. The state carries how likely each pair
of u and w is after the outcomes so far; P(detected | outcomes so far) is a function of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.pem.models.varying_frailty import VaryingFrailty, VaryingNodes
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.state.component import CARRIED, Known, ModelLogit
from pemviz.sampling.state.hidden import HiddenProperty, OwnLogit
from pemviz.sampling.state.visibility import SEEN_LOGIT, VISIBILITY
from pemviz.types import RolloutBatch, Signal, StateBatch

BEFORE = f"{CARRIED}visibility before the next outcome"
"""Memory: records ``[N]`` of the ``shares [U, W]`` of the nodes, and of what the model of single
outcomes says in the state, ``own``."""


@dataclass(frozen=True)
class VaryingVisibility(HiddenProperty):
    """Some obstacles are hard to see, for as long as they are there or for a while.

    Attributes:
        law: How much, and for how long.
        dt_s: Time between two outcomes [s].
        everywhere: As of :class:`~pemviz.sampling.state.visibility.Visibility`.
    """

    law: VaryingFrailty
    dt_s: float
    everywhere: bool = False

    signals: ClassVar[tuple[Signal, ...]] = (VISIBILITY, SEEN_LOGIT)

    @property
    def label(self) -> str:
        """What varies, by how much."""
        varying = f"time-varying frailty {self.law.varying:.3g} ({self.law.varying_s:.3g} s)"
        return f"frailty {self.law.frailty:.3g} and {varying}" if self.law.frailty else varying

    @property
    def shown(self) -> tuple[str, ...]:
        """The logit alone."""
        return (SEEN_LOGIT.name,)

    @cached_property
    def nodes(self) -> VaryingNodes:
        """Of the integral over u and w."""
        return VaryingNodes(self.law, self.dt_s)

    @cached_property
    def _moves(self) -> FloatArray:
        return self.nodes.moved_on(self.dt_s)

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:
        """Before any outcome u and w are standard normals."""
        own = model(states)
        return self._known(own, self.nodes.begun(own.size))

    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: ModelLogit
    ) -> Known:
        """The shares after outcomes ``[N]``, moved on to the next frame."""
        then = before.memory[BEFORE]
        after, _ = self.nodes.after(then["shares"], then["own"], ~detected)
        return self._known(model(states), self.nodes.later(after, self._moves))

    def logit(self, shown: FloatArray, own: OwnLogit) -> FloatArray:  # noqa: ARG002  it is in it
        """The states say it."""
        return shown[..., 0]

    def features(self, states: StateBatch) -> tuple[FloatArray, ...]:
        """The mean visibility."""
        return (states.signals[VISIBILITY.name],)

    def matters(self, features: StateFeatures, states: StateBatch) -> BoolArray | None:
        """As elsewhere, unless it is ``everywhere``."""
        return super().matters(features, states) if self.everywhere else None

    def for_proposals(self) -> "VaryingVisibility":
        """The same, which acts ``everywhere``."""
        return replace(self, everywhere=True)

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of rollouts' outcomes ``[N, T-1]`` together, ``[N]``."""
        return self.nodes.log_likelihood(own, detected)

    def memory_at(
        self, rollouts: RolloutBatch, *, step: IntArray, model: ModelLogit
    ) -> Mapping[str, AnyArray]:
        """The shares and the logit at states of rollouts that led there, ``[N]``."""
        shares = self.nodes.begun(rollouts.count)
        for moment in range(int(step[-1])):
            later = slice(int(np.searchsorted(step, moment, side="right")), None)
            missed = ~rollouts.detected[later, moment]
            own = _own_at(rollouts, later, moment, model)
            after, _ = self.nodes.after(shares[later], own, missed)
            shares[later] = self.nodes.later(after, self._moves)
        own = _own_at(rollouts, np.arange(rollouts.count), step, model)
        return {BEFORE: self._record(own, shares)}

    def _known(self, own: FloatArray, shares: FloatArray) -> Known:
        logit, mean = self.nodes.logit_and_mean(shares, own)
        signals = {VISIBILITY.name: mean, SEEN_LOGIT.name: logit}
        return Known(signals, {BEFORE: self._record(own, shares)})

    def _record(self, own: FloatArray, shares: FloatArray) -> AnyArray:
        parts = [("shares", np.float64, shares.shape[1:]), ("own", np.float64)]
        record = np.empty(own.size, dtype=np.dtype(parts))
        record["shares"], record["own"] = shares, own
        return record


def _own_at(
    rollouts: RolloutBatch, rows: slice | IntArray, step: int | IntArray, model: ModelLogit
) -> FloatArray:
    signals = {name: values[rows, step] for name, values in rollouts.signals.items()}
    return model(StateBatch(np.asarray(step), signals))
