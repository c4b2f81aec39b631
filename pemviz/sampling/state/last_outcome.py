"""Misses in bursts: the last outcome as part of the state.

:mod:`pemviz.pem.models.memory` gives the formula.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem.models.memory import persistence, remembering_logit
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.state.component import Known, ModelLogit
from pemviz.sampling.state.hidden import HiddenProperty, OwnLogit
from pemviz.types import CERTAIN, LAST, LAST_OUTCOME, Signal, StateBatch

SHORT_RHO = 0.1
"""Below, proposals leave outcomes that the scenario ignores to the model: what remains of them
matters less than what changing them costs in weights. On one scenario with rho 0.08 the error of
method ``mixture`` falls from 11 to 4 %; with rho 0.37 it makes no difference."""


@runtime_checkable
class ForeseesReactions(Protocol):
    """Features of a scenario that can tell where an outcome will matter a few steps later."""

    def reacts_within(self, states: StateBatch, *, steps: int) -> BoolArray:
        """Whether the scenario may react at states ``[...]``, or so many steps of it later."""
        ...


@dataclass(frozen=True)
class LastOutcome(HiddenProperty):
    """What came last is likelier to come again.

    Attributes:
        tau_s: Memory time [s].
        dt_s: Time between two outcomes of one obstacle [s].
        turns: Slots that take turns within a step, where the scenario has slots: each has a last
            outcome of its own, and one that was absent has none.
        ignores: Whether outcomes to which the scenario does not react pass for indifferent.
        within_steps: Likewise those to which it will not within so many steps, where it can tell.
    """

    tau_s: float
    dt_s: float
    turns: int | None = None
    ignores: bool = False
    within_steps: int | None = None

    signals: ClassVar[tuple[Signal, ...]] = (LAST_OUTCOME,)
    follows_model: ClassVar[bool] = False

    @cached_property
    def rho(self) -> float:
        """Correlation of one outcome with the next, of one obstacle; 0 to below 1."""
        return float(persistence(self.dt_s, self.tau_s))

    def owns(self, memory: str) -> bool:
        """The last outcomes of slots."""
        return self.turns is not None and memory.startswith(LAST)

    def begin(self, states: StateBatch, model: ModelLogit) -> Known:  # noqa: ARG002  outcomes alone
        """None yet."""
        none = np.zeros(states.shape)
        slots = {f"{LAST}{slot}": np.zeros(states.shape) for slot in range(self.turns or 0)}
        return Known({LAST_OUTCOME.name: none}, slots)

    def next(
        self,
        before: StateBatch,
        detected: BoolArray,
        states: StateBatch,
        model: ModelLogit,  # noqa: ARG002  as above
    ) -> Known:
        """The outcome itself; with slots that of the slot whose turn is next, if it is there."""
        outcome = np.where(detected, 1.0, -1.0)
        if self.turns is None:
            return Known({LAST_OUTCOME.name: outcome})
        turn = int(before.step) % self.turns
        kept = {n: v for n, v in before.memory.items() if n.startswith(LAST)}
        kept[f"{LAST}{turn}"] = np.where(before.memory[CERTAIN], 0.0, outcome)
        following = kept[f"{LAST}{(turn + 1) % self.turns}"]
        return Known({LAST_OUTCOME.name: np.where(states.memory[CERTAIN], 0.0, following)}, kept)

    def logit(self, shown: FloatArray, own: OwnLogit) -> FloatArray:
        """The model's own logits after the last outcome, ``[...]``."""
        logit, last = own(), shown[..., 0]
        remembered = remembering_logit(logit, missed_before=last < 0.0, rho=self.rho)
        return np.where(last == 0.0, logit, remembered)

    def matters(self, features: StateFeatures, states: StateBatch) -> BoolArray | None:
        """Everywhere, unless it ``ignores`` what the scenario does not react to."""
        if self.ignores:
            return features.reacts(states)
        if self.within_steps is not None and isinstance(features, ForeseesReactions):
            return features.reacts_within(states, steps=self.within_steps)
        return np.ones_like(states.signals[LAST_OUTCOME.name], dtype=np.bool_)

    def for_proposals(self) -> "LastOutcome":
        """The same, which leaves the model where that pays."""
        if self.rho < SHORT_RHO:
            return replace(self, ignores=True)
        steps = None if self.rho >= 1.0 else int(np.ceil(np.log(SHORT_RHO) / np.log(self.rho)))
        return replace(self, within_steps=steps)


def last_outcome(signals: Mapping[str, FloatArray], *, otherwise: FloatArray) -> FloatArray:
    """:data:`LAST_OUTCOME` ``[...]``; 0 where nothing depends on it, as ``otherwise [...]``."""
    found = signals.get(LAST_OUTCOME.name)
    return np.zeros(otherwise.shape) if found is None else found
