"""What rollouts for all memory times are drawn on, and what they are drawn from."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
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
from pemviz.types import Proposal, ScoredRollouts

DEFENSIVE_STEPS = 2.0
PILOTED_S = (0.0, 0.1, 1.0)
"""Memory times whose models a family of pilots is around, each [s]."""


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

    def features(self, tau_s: float) -> RememberingFeatures:
        """What proposals around the model with a memory time look at, and where they act."""
        return RememberingFeatures(self.own_features, self.model(tau_s).rho).for_proposals()

    def proposal(self, drawing: Drawing) -> OffsetLogisticProposal:
        """What rollouts are drawn from."""
        assert self.basis is not None  # noqa: S101  chosen from the pilots' rollouts
        return OffsetLogisticProposal(
            features=self.features(drawing.tau_s),
            basis=self.basis,
            coefficients=drawing.coefficients,
            violated=VIOLATED,
            defensive=self.defensive,
        )


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
            features=scenario.features(tau_s),
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
