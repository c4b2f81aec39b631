"""Methods without learning: plain Monte Carlo and sampling from a constant."""

from dataclasses import dataclass

from pemviz.proposals.simple import ConstantProposal, PemProposal
from pemviz.sampling.estimates import importance_sampling_estimate, monte_carlo_estimate
from pemviz.sampling.method import final_stage, stage_seeds
from pemviz.sampling.problem import Problem, sample
from pemviz.types import Estimate, ScoredRollouts, StageResult


@dataclass(frozen=True)
class DirectState:
    """The repetition, and its rollouts once they are drawn."""

    repetition: int
    scored: ScoredRollouts | None = None


@dataclass(frozen=True, kw_only=True)
class DirectSampling:
    """One batch of rollouts from a fixed proposal.

    Attributes:
        name: ``monte-carlo`` or ``naive``.
        proposal: What is sampled from.
        rollouts: How many.
        seed: Root of all randomness.
    """

    name: str
    proposal: PemProposal | ConstantProposal
    rollouts: int
    seed: int
    stages: int = 1

    def init(self, problem: Problem, *, repetition: int) -> DirectState:  # noqa: ARG002
        """Nothing is drawn yet."""
        return DirectState(repetition=repetition)

    def step(self, problem: Problem, state: DirectState) -> tuple[DirectState, StageResult]:
        """Draw and score all rollouts."""
        scored = sample(
            problem,
            proposal=self.proposal,
            count=self.rollouts,
            seeds=stage_seeds(seed=self.seed, repetition=state.repetition, stage=0),
        )
        result = final_stage(
            repetition=state.repetition, stage=0, scored=scored, sampled_from=self.proposal
        )
        return DirectState(repetition=state.repetition, scored=scored), result

    def is_done(self, state: DirectState) -> bool:
        """Whether the batch is drawn."""
        return state.scored is not None

    def estimate(self, state: DirectState) -> Estimate:
        """The batch's estimate.

        Raises:
            ValueError: The batch is not drawn yet.
        """
        if state.scored is None:
            message = "no rollouts have been drawn yet"
            raise ValueError(message)
        if isinstance(self.proposal, PemProposal):
            return monte_carlo_estimate(state.scored, method=self.name)
        return importance_sampling_estimate(
            state.scored, method=self.name, rollouts_simulated=self.rollouts
        )
