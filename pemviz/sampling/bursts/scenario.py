"""What rollouts for many memories are drawn on, and what they are drawn from."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.pem import Pem
from pemviz.pem.models.memory import Memory
from pemviz.proposals.defensive_share import share_for
from pemviz.proposals.exploration import ExplorationFamily
from pemviz.proposals.offset_logistic import (
    OffsetLogisticProposal,
    PolynomialBasis,
    StateFeatures,
)
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.state.composed import ComposedFeatures, ComposedPem
from pemviz.sampling.state.hidden import HiddenProperty
from pemviz.sampling.state.last_outcome import LastOutcome
from pemviz.sampling.state.visibility import GivenVisibility
from pemviz.simulators.absorbing import VIOLATED
from pemviz.types import Proposal, ScoredRollouts

DEFENSIVE_STEPS = 2.0


@dataclass(frozen=True)
class Given:
    """How misses hang together, and the visibility of the obstacle at hand."""

    memory: Memory
    u: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """A fitted proposal: coefficients ``[B]``, around a model."""

    around: Given
    coefficients: FloatArray


@dataclass(frozen=True)
class Scenario:
    """What rollouts are drawn on, and what is looked at.

    Attributes:
        problem: With the last outcome as a signal, and an absorbing violation.
        pem: The model of single outcomes.
        own_features: What the scenario itself offers to look at.
        asked: How misses may hang together, each.
        explored: The models that a family of exploration proposals is around, each.
        forgetful: Whether no memory that is asked about has a memory time. Outcomes to which the
            scenario does not react then change nothing that comes after, neither states nor what
            proposals do: summed over them a likelihood is that of the other outcomes. They are
            left out of all, unless the exploration proposals' rollouts show that the scenario does
            react.
        basis: Of the proposals; chosen from the exploration proposals' rollouts.
    """

    problem: Problem
    pem: Pem
    own_features: StateFeatures
    asked: tuple[Memory, ...]
    explored: tuple[Given, ...]
    forgetful: bool = False
    basis: PolynomialBasis | None = None

    @property
    def steps(self) -> int:
        """Outcomes of a rollout."""
        return self.problem.simulator.states - 1

    @property
    def defensive(self) -> float:
        """Share of the model in every outcome's probability."""
        return share_for(drawn_steps=DEFENSIVE_STEPS, steps=self.steps)

    def model(self, given: Given) -> ComposedPem:
        """The error model given an obstacle's visibility, and the outcome before."""
        properties: tuple[HiddenProperty, ...] = (self._last_outcome(given),)
        if given.memory.frailty > 0.0:
            properties = (GivenVisibility(given.memory.frailty, given.u), *properties)
        return ComposedPem(self.pem, properties)

    def ignores(self, given: Given) -> bool:
        """Whether proposals around a model leave it only where the scenario itself reacts."""
        return self.forgetful or self._last_outcome(given).for_proposals().ignores

    def features(self, given: Given) -> StateFeatures:
        """What proposals around a model look at, and where they act."""
        if self.forgetful:
            return self.own_features
        return ComposedFeatures(self.own_features, (self._last_outcome(given).for_proposals(),))

    def _last_outcome(self, given: Given) -> LastOutcome:
        return LastOutcome(given.memory.tau_s, self.problem.simulator.dt_s)

    def proposal(self, drawing: Drawing) -> OffsetLogisticProposal:
        """What rollouts are drawn from."""
        assert self.basis is not None  # noqa: S101  chosen from the exploration proposals' rollouts
        return OffsetLogisticProposal(
            features=self.features(drawing.around),
            basis=self.basis,
            coefficients=drawing.coefficients,
            violated=VIOLATED,
            defensive=self.defensive,
        )


def sampled_by_exploration(
    scenario: Scenario, *, each: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``each`` rollouts from every family of exploration proposals."""
    return ScoredRollouts.concatenate(list(_by_family(scenario, each, seeds)))


def _by_family(
    scenario: Scenario, each: int, seeds: np.random.SeedSequence
) -> Iterator[ScoredRollouts]:
    families = len(scenario.explored)
    for given, child in zip(scenario.explored, seeds.spawn(families), strict=True):
        exploration = ExplorationFamily.over(scenario.steps).drawn(
            each,
            np.random.default_rng(child.spawn(1)[0]),
            features=scenario.features(given),
            violated=VIOLATED,
        )
        yield _sampled(scenario, exploration, given, each, child)


def sampled_by_fit(
    scenario: Scenario, drawing: Drawing, *, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    """``count`` rollouts from a fitted proposal."""
    return _sampled(scenario, scenario.proposal(drawing), drawing.around, count, seeds)


def _sampled(
    scenario: Scenario, proposal: Proposal, given: Given, count: int, seeds: np.random.SeedSequence
) -> ScoredRollouts:
    problem = replace(scenario.problem, pem=scenario.model(given))
    return sample(problem, proposal=proposal, count=count, seeds=seeds)
