"""Misses in bursts: scenario and error model with the last outcome as part of the state.

:mod:`pemviz.pem.models.memory` gives the formula. Here it becomes an error model like any other
on a back end like any other, so that a method needs to know nothing of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem import Pem, PemEnsemble
from pemviz.pem.models.memory import Memory, persistence, remembering_logit
from pemviz.pem.models.with_memory import PemWithMemory
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.back_end import BackEnd
from pemviz.sampling.frailty import (
    FrailFeatures,
    FrailModel,
    FrailPem,
    FrailSimulator,
    frail,
    without_frailty,
)
from pemviz.sampling.problem import Problem
from pemviz.simulators.remembering import LAST_OUTCOME, RememberingSimulator, remembering
from pemviz.types import Simulator, StateBatch

SHORT_RHO = 0.1
"""Below, proposals leave outcomes that the scenario ignores to the model: what remains of them is
worth less than what changing them costs in weights. On one scenario with rho 0.08 the error of
method ``mixture`` falls from 11 to 4 %; with rho 0.37 it makes no difference."""


@dataclass(frozen=True, eq=False)
class RememberingPem(PemWithMemory):
    """An error model whose misses hang together."""

    def logit(self, salient: FloatArray) -> FloatArray:
        """Logit of P(detected) ``[...]``, of the model's variables and the last outcome."""
        return self.after(self.pem.logit(salient[..., :-1]), salient[..., -1])

    def after(self, own: FloatArray, last: FloatArray) -> FloatArray:
        """The model's own logits ``[...]`` after what :data:`LAST_OUTCOME` says ``[...]``."""
        remembered = remembering_logit(own, missed_before=last < 0.0, rho=self.rho)
        return np.where(last == 0.0, own, remembered)


@dataclass(frozen=True)
class RememberingEnsemble:
    """Models that the data could as well have produced, with the same memory each."""

    name: str
    members: Sequence[Pem]


@runtime_checkable
class ForeseesReactions(Protocol):
    """Features of a scenario that can tell where an outcome will matter a few steps later."""

    def reacts_within(self, states: StateBatch, *, steps: int) -> BoolArray:
        """Whether the scenario may react at states ``[...]``, or so many steps of it later."""
        ...


@dataclass(frozen=True)
class RememberingFeatures:
    """What a scenario offers to look at, and the last outcome.

    An outcome to which the scenario does not react is remembered: it matters as well.

    Attributes:
        features: The scenario's own.
        rho: Correlation of one outcome with the next.
        ignores: Whether outcomes to which the scenario does not react pass for indifferent.
        within_steps: Likewise those to which it will not within so many steps, where it can tell.
    """

    features: StateFeatures
    rho: float
    ignores: bool = False
    within_steps: int | None = None

    def values(self, states: StateBatch) -> FloatArray:
        """The scenario's features and the last outcome, ``[..., D + 1]``."""
        last = states.signals[LAST_OUTCOME.name]
        own = self.features.values(states)
        return np.concatenate((own, np.broadcast_to(last, own.shape[:-1])[..., None]), -1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """True everywhere, unless it ``ignores`` what the scenario does."""
        if self.ignores:
            return self.features.reacts(states)
        if self.within_steps is not None and isinstance(self.features, ForeseesReactions):
            return self.features.reacts_within(states, steps=self.within_steps)
        last = states.signals[LAST_OUTCOME.name]
        return np.ones_like(last, dtype=np.bool)

    def for_proposals(self) -> "RememberingFeatures":
        """The same to a proposal, which leaves the model where that is worth its price."""
        if self.rho < SHORT_RHO:
            return replace(self, ignores=True)
        steps = None if self.rho >= 1.0 else int(np.ceil(np.log(SHORT_RHO) / np.log(self.rho)))
        return replace(self, within_steps=steps)


def with_memory(
    back_end: BackEnd, pem: Pem, ensemble: PemEnsemble | None, *, memory: Memory
) -> tuple[BackEnd, Pem, PemEnsemble | None]:
    """Back end, error model and its ensemble with a memory; as they are without.

    Raises:
        ConfigError: The scenario has a signal named like the last outcome, or like what outcomes
            tell of the obstacle.
    """
    if memory == Memory():
        return back_end, pem, ensemble
    dt_s = back_end.simulator.dt_s
    if memory.tau_s > 0.0:
        features = RememberingFeatures(back_end.features, float(persistence(dt_s, memory.tau_s)))
        back_end = replace(
            back_end,
            simulator=remembering(back_end.simulator),
            twin=None if back_end.twin is None else remembering(back_end.twin),
            features=features,
        )
    model = RememberingPem(pem, memory, dt_s)
    if memory.frailty > 0.0:
        model = FrailPem(pem, memory, dt_s)
        back_end = replace(
            back_end,
            simulator=frail(back_end.simulator, model),
            twin=None if back_end.twin is None else frail(back_end.twin, model),
            features=FrailFeatures(back_end.features),
        )
    members = None
    if ensemble is not None:
        members = RememberingEnsemble(
            name=ensemble.name,
            members=[remembering_as(member, model) for member in ensemble.members],
        )
    return back_end, model, members


def proposal_features(features: StateFeatures) -> StateFeatures:
    """What a proposal looks at, and where it may leave the model, of what a scenario offers."""
    if isinstance(features, FrailFeatures):
        return replace(features, features=proposal_features(features.features), everywhere=True)
    return features.for_proposals() if isinstance(features, RememberingFeatures) else features


def without_memory(back_end: BackEnd) -> BackEnd:
    """The back end as it is for single outcomes; the inverse of :func:`with_memory`."""
    twin = back_end.twin
    return replace(
        back_end,
        simulator=_single_outcomes(back_end.simulator),
        twin=None if twin is None else _single_outcomes(twin),
        features=single_outcome_features(back_end.features),
    )


def _single_outcomes(simulator: Simulator) -> Simulator:
    simulator = without_frailty(simulator)
    return simulator.scenario if isinstance(simulator, RememberingSimulator) else simulator


def single_outcome_features(features: StateFeatures) -> StateFeatures:
    """What the scenario itself offers to look at, beneath a memory."""
    if isinstance(features, FrailFeatures):
        features = features.features
    return features.features if isinstance(features, RememberingFeatures) else features


def memory_of_pem(pem: Pem) -> Memory:
    """How an error model's misses hang together."""
    return pem.memory if isinstance(pem, RememberingPem | FrailModel) else Memory()


def single_outcome_model(pem: Pem) -> Pem:
    """The model of single outcomes beneath a memory."""
    return pem.pem if isinstance(pem, RememberingPem | FrailModel) else pem


def single_outcome_salient(pem: Pem, salient: FloatArray) -> FloatArray:
    """What the model of single outcomes sees ``[..., D]``, of what ``pem`` sees."""
    if isinstance(pem, FrailModel):
        return pem.own_salient(salient)
    return salient[..., :-1] if isinstance(pem, RememberingPem) else salient


def first_logit(pem: Pem, salient: FloatArray) -> FloatArray:
    """Logit of P(detected) ``[...]`` where no outcome came before, of what ``pem`` sees."""
    return single_outcome_model(pem).logit(single_outcome_salient(pem, salient))


def remembering_as(pem: Pem, like: Pem) -> Pem:
    """``pem``, a model of single outcomes, with the memory that ``like`` has.

    With frailty it is one of whole chains of outcomes; :func:`problem_under` asks it for more.
    """
    if isinstance(like, FrailModel):
        return FrailModel(pem, like.memory, like.dt_s)
    return replace(like, pem=pem) if isinstance(like, RememberingPem) else pem


def problem_under(problem: Problem, pem: Pem) -> Problem:
    """The problem with another model of single outcomes, remembering as the problem's does."""
    like, simulator = problem.pem, problem.simulator
    if not isinstance(like, FrailModel):
        return replace(problem, pem=remembering_as(pem, like))
    model = FrailPem(pem, like.memory, like.dt_s)
    return replace(problem, pem=model, simulator=FrailSimulator(without_frailty(simulator), model))
