"""Importance sampling with the proposal that a twin's value function gives."""

from dataclasses import dataclass, replace

from pemviz.errors import InputError
from pemviz.proposals.twisted import TwistedProposal
from pemviz.sampling.estimates import importance_sampling_estimate
from pemviz.sampling.method import final_stage, stage_seeds
from pemviz.sampling.problem import Problem, sample
from pemviz.sampling.rollout import LogitFunction
from pemviz.sampling.value_reachable import Pause, Unsafe
from pemviz.sampling.value_tables import (
    DEFENSIVE_STEPS,
    LARGEST_LAYER,
    build_twisted_proposal,
    with_defence,
)
from pemviz.simulators.latched import LatchedSimulator, MonitoredSimulator
from pemviz.types import Estimate, ScoredRollouts, Simulator, StageResult


@dataclass(frozen=True)
class ValueTwistedState:
    """The repetition, its proposal, and its rollouts once they are drawn."""

    repetition: int
    proposal: TwistedProposal
    scored: ScoredRollouts | None = None


@dataclass(frozen=True, kw_only=True)
class ValueTwistedSampling:
    """One batch of rollouts that are steered towards violation by the twin's values.

    Unbiased on any simulator; the closer the twin, the less the weights vary.

    Attributes:
        twin: The scenario that the value function is computed on.
        rollouts: How many.
        seed: Root of all randomness.
        largest_layer: Above so many states a step, the value function is approximate.
        defensive_steps: How many of a rollout's steps are drawn from the error model itself, on
            average.
    """

    twin: Simulator
    rollouts: int
    seed: int
    largest_layer: int = LARGEST_LAYER
    defensive_steps: float = DEFENSIVE_STEPS
    name: str = "value-twisted"
    stages: int = 1

    def init(self, problem: Problem, *, repetition: int) -> ValueTwistedState:
        """Compute the value function; repetitions share it.

        Raises:
            InputError: Single states do not decide the specification.
        """
        wanted = _Wanted(self.twin, problem.pem_logit, require_unsafe(problem), self.largest_layer)
        proposal = _last_built.get(wanted, pause=problem.pause)
        proposal = with_defence(
            proposal, defensive_steps=self.defensive_steps, steps=self.twin.states - 1
        )
        return ValueTwistedState(repetition=repetition, proposal=proposal)

    def step(
        self, problem: Problem, state: ValueTwistedState
    ) -> tuple[ValueTwistedState, StageResult]:
        """Draw and score all rollouts."""
        scored = sample(
            with_latch(problem),
            proposal=state.proposal,
            count=self.rollouts,
            seeds=stage_seeds(seed=self.seed, repetition=state.repetition, stage=0),
        )
        result = final_stage(
            repetition=state.repetition, stage=0, scored=scored, sampled_from=state.proposal
        )
        return replace(state, scored=scored), result

    def is_done(self, state: ValueTwistedState) -> bool:
        """Whether the batch is drawn."""
        return state.scored is not None

    def estimate(self, state: ValueTwistedState) -> Estimate:
        """The batch's estimate.

        Raises:
            ValueError: The batch is not drawn yet.
        """
        if state.scored is None:
            message = "no rollouts have been drawn yet"
            raise ValueError(message)
        return importance_sampling_estimate(
            state.scored, method=self.name, rollouts_simulated=self.rollouts
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
    """The problem on a simulator that remembers violations, if the problem says what they are."""
    if problem.unsafe is not None:
        return replace(problem, simulator=LatchedSimulator(problem.simulator, problem.unsafe))
    if problem.monitor is not None:
        return replace(problem, simulator=MonitoredSimulator(problem.simulator, problem.monitor))
    return problem


@dataclass(frozen=True)
class _Wanted:
    """What a value function follows from.

    Two that are equal give the same one.
    """

    twin: Simulator
    pem_logit: LogitFunction
    unsafe: Unsafe
    largest_layer: int


class _LastBuilt:
    """Holds the proposal built last: large, and the same for all repetitions and the reference.

    A build that is stopped leaves what was there before.
    """

    def __init__(self) -> None:
        self._held: tuple[_Wanted, TwistedProposal] | None = None

    def get(self, wanted: _Wanted, *, pause: Pause) -> TwistedProposal:
        held = self._held
        if held is not None and held[0] == wanted:
            return held[1]
        built = build_twisted_proposal(
            twin=wanted.twin,
            pem_logit=wanted.pem_logit,
            unsafe=wanted.unsafe,
            largest_layer=wanted.largest_layer,
            pause=pause,
        )
        self._held = (wanted, built)
        return built


_last_built = _LastBuilt()
