"""Methods without learning: plain Monte Carlo and sampling from a constant.

With p the perception error model and c a constant detection probability, of N rollouts::

    monte-carlo  mu = F / N for F violations, with the interval of Clopper and Pearson 1934
    naive        mu = 1 / N sum_i 1[i violates] w_i, w_i = prod_t p(o_t | s_t) / q(o_t),
                 q(detected) = c
"""

from dataclasses import dataclass, replace

from pemviz.proposals.fixed import ConstantProposal, PemProposal
from pemviz.sampling.estimates.estimators import importance_sampling_estimate, monte_carlo_estimate
from pemviz.sampling.method import final_stage, sample_stage
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.large_stages import LARGEST_PART, FinalBatch, part_sizes
from pemviz.types import Estimate, StageResult


@dataclass(frozen=True)
class DirectState:
    """The repetition, and how far its rollouts are sampled."""

    repetition: int
    batch: FinalBatch


@dataclass(frozen=True, kw_only=True)
class DirectSampling:
    """Rollouts from a fixed proposal; stage k draws part k of them.

    Attributes:
        name: ``monte-carlo`` or ``naive``.
        proposal: What is sampled from.
        rollouts: How many.
        seed: Root of all randomness.
        largest_part: How many are sampled at once.
    """

    name: str
    proposal: PemProposal | ConstantProposal
    rollouts: int
    seed: int
    largest_part: int = LARGEST_PART

    @property
    def stages(self) -> int:
        """How many parts there are."""
        return len(part_sizes(self.rollouts, largest=self.largest_part))

    def init(self, problem: Problem, *, repetition: int) -> DirectState:  # noqa: ARG002
        """Nothing is sampled yet."""
        sizes = part_sizes(self.rollouts, largest=self.largest_part)
        return DirectState(repetition=repetition, batch=FinalBatch(sizes))

    def step(self, problem: Problem, state: DirectState) -> tuple[DirectState, StageResult]:
        """Draw and score the next part."""
        stage = len(state.batch.sampled)
        scored = sample_stage(
            problem,
            proposal=self.proposal,
            count=state.batch.next_size,
            seed=self.seed,
            repetition=state.repetition,
            stage=stage,
        )
        result = final_stage(
            repetition=state.repetition, stage=stage, scored=scored, sampled_from=self.proposal
        )
        return replace(state, batch=state.batch.extended(scored)), result

    def under_rule(self, state: DirectState, rule: str) -> DirectState:
        """The same rollouts with the verdict of one rule."""
        return replace(state, batch=state.batch.under_rule(rule))

    def is_done(self, state: DirectState) -> bool:
        """Whether all is sampled."""
        return state.batch.is_done

    def estimate(self, state: DirectState) -> Estimate:
        """The estimate from all rollouts.

        Raises:
            ValueError: They are not drawn yet.
        """
        rollouts = state.batch.weighed()
        if isinstance(self.proposal, PemProposal):
            return monte_carlo_estimate(rollouts, method=self.name)
        return importance_sampling_estimate(
            rollouts, method=self.name, rollouts_simulated=self.rollouts
        )
