"""A visibility of which a part comes and goes, as part of the state.

:mod:`pemviz.pem.models.varying_frailty` gives the formulas. The state carries how likely each pair
of u and w is after the outcomes so far; P(detected | outcomes so far) is a function of it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.pem.models.varying_frailty import VaryingFrailty, VaryingNodes, chunks
from pemviz.sampling.state.component import CARRIED, Known, ModelLogit
from pemviz.sampling.state.visibility import SEEN_LOGIT, VISIBILITY, FilteredVisibility
from pemviz.types import RolloutBatch, StateBatch

BEFORE = f"{CARRIED}visibility before the next outcome"
"""Memory: records ``[N]`` of the ``shares [U, W]`` of the nodes, and of what the model of single
outcomes says in the state, ``own``."""


@dataclass(frozen=True)
class VaryingVisibility(FilteredVisibility):
    """Some obstacles are hard to see, for as long as they are there or for a while.

    Attributes:
        law: How much, and for how long.
        dt_s: Time between two outcomes [s].
    """

    law: VaryingFrailty
    dt_s: float

    has_few_states: ClassVar[bool] = False  # each chain of outcomes has a distribution of its own
    in_name: ClassVar[bool] = False

    @property
    def label(self) -> str:
        """What varies, by how much."""
        return self.law.label

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
        return self._known(own, lambda rows: self.nodes.begun(own[rows].size))

    def next(
        self, before: StateBatch, detected: BoolArray, states: StateBatch, model: ModelLogit
    ) -> Known:
        """The shares after outcomes ``[N]``, moved on to the next frame."""
        then = before.memory[BEFORE]
        return self._known(model(states), self._moved_on(then["shares"], then["own"], detected))

    def _moved_on(
        self, shares: FloatArray, own: FloatArray, detected: BoolArray
    ) -> Callable[[slice], FloatArray]:
        log_outcomes = self.nodes.log_outcomes(own, ~detected)

        def of(rows: slice) -> FloatArray:
            after, _ = self.nodes.after(shares[rows], log_outcomes[rows])
            return self.nodes.later(after, self._moves)

        return of

    def log_likelihood(self, own: FloatArray, detected: BoolArray) -> FloatArray:
        """Log likelihood of rollouts' outcomes ``[N, T-1]`` together, ``[N]``."""
        return self.nodes.log_likelihood(own, detected)

    def memory_at(
        self, rollouts: RolloutBatch, *, step: IntArray, model: ModelLogit
    ) -> Mapping[str, AnyArray]:
        """The shares and the logit at states of rollouts that led there, ``[N]``."""
        record = self._record(rollouts.count)
        shares = record["shares"]
        shares[:] = self.nodes.prior
        for moment in range(int(step[-1])):
            later = int(np.searchsorted(step, moment, side="right"))
            own = _own_at(rollouts, slice(later, None), moment, model)
            going = shares[later:]
            moved_on = self._moved_on(going, own, rollouts.detected[later:, moment])
            for rows in chunks(len(going)):
                going[rows] = moved_on(rows)
        record["own"] = _own_at(rollouts, np.arange(rollouts.count), step, model)
        return {BEFORE: record}

    def _known(self, own: FloatArray, shares: Callable[[slice], FloatArray]) -> Known:
        """What is known where the model of single outcomes says ``own [N]``."""
        nodes, every = self.nodes, np.ones(own.shape, dtype=np.bool_)
        hit, miss = nodes.log_outcomes(own, ~every), nodes.log_outcomes(own, every)
        record, mean, logit = self._record(own.size), np.empty(own.size), np.empty(own.size)
        record["own"] = own
        for rows in chunks(own.size):
            part = shares(rows)
            record["shares"][rows] = part
            logit[rows], mean[rows] = nodes.logit_and_mean(part, hit[rows], miss[rows])
        return Known({VISIBILITY.name: mean, SEEN_LOGIT.name: logit}, {BEFORE: record})

    def _record(self, count: int) -> AnyArray:
        parts = [("shares", np.float64, self.nodes.prior.shape), ("own", np.float64)]
        return np.empty(count, dtype=np.dtype(parts))


def _own_at(
    rollouts: RolloutBatch, rows: slice | IntArray, step: int | IntArray, model: ModelLogit
) -> FloatArray:
    signals = {name: values[rows, step] for name, values in rollouts.signals.items()}
    return model(StateBatch(np.asarray(step), signals))
