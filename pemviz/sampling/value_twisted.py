"""Importance sampling with the proposal that a twin's value function gives."""

from dataclasses import dataclass, replace
from functools import lru_cache

from pemviz.errors import InputError
from pemviz.proposals.twisted import TwistedProposal
from pemviz.sampling.estimates import importance_sampling_estimate
from pemviz.sampling.final_batch import LARGEST_PART, FinalBatch, part_sizes
from pemviz.sampling.method import final_stage, sample_stage
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollout import LogitFunction
from pemviz.sampling.value_reachable import Unsafe
from pemviz.sampling.value_tables import (
    DEFENSIVE_STEPS,
    LARGEST_LAYER,
    build_twisted_proposal,
    with_defence,
)
from pemviz.simulators.latched import LatchedSimulator
from pemviz.types import Estimate, Simulator, StageResult


@dataclass(frozen=True)
class ValueTwistedState:
    """The repetition, its proposal, and how far its rollouts are drawn."""

    repetition: int
    proposal: TwistedProposal
    batch: FinalBatch


@dataclass(frozen=True, kw_only=True)
class ValueTwistedSampling:
    """Rollouts that are steered towards violation by the twin's values; stage k draws part k.

    Unbiased on any simulator; the closer the twin, the less the weights vary.

    Attributes:
        twin: The scenario that the value function is computed on.
        rollouts: How many.
        seed: Root of all randomness.
        largest_layer: Above so many states a step, the value function is approximate.
        defensive_steps: How many of a rollout's steps are drawn from the error model itself, on
            average.
        largest_part: How many rollouts are drawn at once.
    """

    twin: Simulator
    rollouts: int
    seed: int
    largest_layer: int = LARGEST_LAYER
    defensive_steps: float = DEFENSIVE_STEPS
    largest_part: int = LARGEST_PART
    name: str = "value-twisted"

    @property
    def stages(self) -> int:
        """How many parts there are."""
        return len(part_sizes(self.rollouts, largest=self.largest_part))

    def init(self, problem: Problem, *, repetition: int) -> ValueTwistedState:
        """Compute the value function; repetitions share it.

        Raises:
            InputError: Single states do not decide the specification.
        """
        proposal = _proposal(
            self.twin,
            problem.pem_logit,
            require_unsafe(problem),
            self.largest_layer,
        )
        proposal = with_defence(
            proposal, defensive_steps=self.defensive_steps, steps=self.twin.states - 1
        )
        batch = FinalBatch(part_sizes(self.rollouts, largest=self.largest_part))
        return ValueTwistedState(repetition=repetition, proposal=proposal, batch=batch)

    def step(
        self, problem: Problem, state: ValueTwistedState
    ) -> tuple[ValueTwistedState, StageResult]:
        """Draw and score the next part."""
        stage = len(state.batch.drawn)
        scored = sample_stage(
            with_latch(problem),
            proposal=state.proposal,
            count=state.batch.next_size,
            seed=self.seed,
            repetition=state.repetition,
            stage=stage,
        )
        result = final_stage(
            repetition=state.repetition, stage=stage, scored=scored, sampled_from=state.proposal
        )
        return replace(state, batch=state.batch.extended(scored)), result

    def is_done(self, state: ValueTwistedState) -> bool:
        """Whether all is drawn."""
        return state.batch.is_done

    def estimate(self, state: ValueTwistedState) -> Estimate:
        """The estimate from all rollouts.

        Raises:
            ValueError: They are not drawn yet.
        """
        return importance_sampling_estimate(
            state.batch.weighed(), method=self.name, rollouts_simulated=self.rollouts
        )


def require_unsafe(problem: Problem) -> Unsafe:
    """What single states violate the specification.

    Raises:
        InputError: There is no such answer for it.
    """
    if problem.unsafe is None:
        message = (
            "method value-twisted: the specification must be 'always' over a condition on single "
            "states, such as always[0,99] (gap >= 2.0); use mixture or adaptive for others"
        )
        raise InputError(message)
    return problem.unsafe


def with_latch(problem: Problem) -> Problem:
    """The problem on a simulator that remembers violations, where single states decide them."""
    if problem.unsafe is None:
        return problem
    return replace(problem, simulator=LatchedSimulator(problem.simulator, problem.unsafe))


@lru_cache(maxsize=1)  # large, and the same for all repetitions and for the reference
def _proposal(
    twin: Simulator,
    pem_logit: LogitFunction,
    unsafe: Unsafe,
    largest_layer: int,
) -> TwistedProposal:
    return build_twisted_proposal(
        twin=twin,
        pem_logit=pem_logit,
        unsafe=unsafe,
        largest_layer=largest_layer,
    )
