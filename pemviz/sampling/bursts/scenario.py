"""What rollouts for all memory times are drawn on, and what they are drawn from."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.defensive_share import share_for
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    StateFeatures,
)
from pemviz.proposals.pilots import PilotFamily
from pemviz.sampling.memory import RememberingFeatures, RememberingPem
from pemviz.sampling.problem import Problem, sample
from pemviz.simulators.latched import VIOLATED
from pemviz.types import Proposal, ScoredRollouts, StateBatch

DEFENSIVE_STEPS = 2.0
PILOTED_S = (0.0, 0.3)
"""Memory times whose models a family of pilots is around, each [s]."""
SHORT_RHO = 0.01
"""Below, what an outcome leaves behind is not worth changing one that the scenario ignores."""


@dataclass(frozen=True)
class Drawing:
    """A fitted proposal: coefficients ``[B]``, around the model with a memory time."""

    tau_s: float
    coefficients: FloatArray


@dataclass(frozen=True)
class Scenario:
    """What rollouts are drawn on: the problem with memory and latch, and what is looked at."""

    problem: Problem
    pem: Pem
    features: RememberingFeatures
    own_features: StateFeatures
    basis: PolynomialBasis | None = None

    @property
    def steps(self) -> int:
        """Outcomes of a rollout."""
        return self.problem.simulator.states - 1

    @property
    def defensive(self) -> float:
        """Share of the model in every outcome's probability."""
        return share_for(drawn_steps=DEFENSIVE_STEPS, steps=self.steps)

    def model(self, tau_s: float) -> RememberingPem:
        """The error model with a memory time."""
        return RememberingPem(self.pem, Memory(tau_s=tau_s), self.problem.simulator.dt_s)

    def is_short(self, tau_s: float) -> bool:
        """Whether a memory time is so short that ignored outcomes are left to the model."""
        return self.model(tau_s).rho < SHORT_RHO

    def reacting(self, tau_s: float) -> StateFeatures:
        """Whose ``reacts`` says where a proposal may leave the model with a memory time."""
        return self.own_features if self.is_short(tau_s) else self.features

    def proposal(self, drawing: Drawing) -> OffsetLogisticProposal:
        """What rollouts are drawn from."""
        assert self.basis is not None  # noqa: S101  chosen from the pilots' rollouts
        return OffsetLogisticProposal(
            features=_Seen(self.features, reacting=self.reacting(drawing.tau_s)),
            basis=self.basis,
            coefficients=drawing.coefficients,
            violated=VIOLATED,
            defensive=self.defensive,
        )


@dataclass(frozen=True)
class _Seen:
    """The values of some features, where others say that outcomes matter."""

    features: StateFeatures
    reacting: StateFeatures

    def values(self, states: StateBatch) -> FloatArray:
        return self.features.values(states)

    def reacts(self, states: StateBatch) -> BoolArray:
        return self.reacting.reacts(states)


def drawn_by_pilots(
    scenario: Scenario, *, each: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``each`` rollouts from every family of pilots."""
    return ScoredRollouts.concatenate(list(_by_family(scenario, each, seeds)))


def _by_family(
    scenario: Scenario, each: int, seeds: np.random.SeedSequence
) -> Iterator[ScoredRollouts]:
    for tau_s, child in zip(PILOTED_S, seeds.spawn(len(PILOTED_S)), strict=True):
        pilots = PilotFamily.over(scenario.steps).drawn(
            each,
            np.random.default_rng(child.spawn(1)[0]),
            features=scenario.reacting(tau_s),
            violated=VIOLATED,
        )
        yield _sampled(scenario, pilots, tau_s, each, child)


def drawn_by_fit(
    scenario: Scenario, drawing: Drawing, *, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``count`` rollouts from a fitted proposal."""
    return _sampled(scenario, scenario.proposal(drawing), drawing.tau_s, count, seeds)


def _sampled(
    scenario: Scenario, proposal: Proposal, tau_s: float, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    problem = replace(scenario.problem, pem=scenario.model(tau_s))
    return sample(problem, proposal=proposal, count=count, seeds=seeds)
