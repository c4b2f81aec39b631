"""Importance sampling with the proposal that a twin's value function gives.

An approximate zero-variance change of measure (L'Ecuyer, Tuffin 2008). With p the perception
error model, s' the state that follows s after outcome o on the twin, and d a defensive share
(Hesterberg 1995)::

    value     V(s) = 1 once violated, else sum_o p(o | s) V(s'); 0 at the end of a rollout
    proposal  q(o | s) = (1 - d) p(o | s) V(s') / V(s) + d p(o | s)
    weight    w_i  = prod_t p(o_t | s_t) / q(o_t | s_t)
    estimate  mu   = 1 / N sum_i 1[i violates] w_i

With d = 0 and a twin that is right, every violating rollout has the weight V(s_0) = mu.
"""

from dataclasses import dataclass, field, replace
from functools import partial

from pemviz.errors import InputError
from pemviz.pem.models.protocol import Pem
from pemviz.proposals.zero_variance import ZeroVarianceProposal
from pemviz.sampling.estimates.diagnostics import called_safe
from pemviz.sampling.estimates.estimators import importance_sampling_estimate
from pemviz.sampling.method import final_stage, sample_stage
from pemviz.sampling.problem import Problem
from pemviz.sampling.rollouts.large_stages import LARGEST_PART, FinalBatch, part_sizes
from pemviz.sampling.state.composed import with_component
from pemviz.sampling.state.violated import Monitored, Violated
from pemviz.sampling.zero_variance.frail import FrailModel, build_frail_proposal
from pemviz.sampling.zero_variance.proposal import (
    DEFENSIVE_STEPS,
    build_zero_variance_proposal,
    with_defence,
)
from pemviz.sampling.zero_variance.reachable_states import LARGEST_LAYER, Pause, Unsafe
from pemviz.types import Estimate, Simulator, StageResult


@dataclass(frozen=True)
class ZeroVarianceState:
    """The repetition, its proposal, and how far its rollouts are sampled."""

    repetition: int
    proposal: ZeroVarianceProposal
    batch: FinalBatch


@dataclass(frozen=True, kw_only=True)
class ZeroVarianceSampling:
    """Rollouts that are steered towards violation by the twin's values; stage k samples part k.

    Unbiased on any simulator; the closer the twin, the less the weights vary.

    Attributes:
        twin: The scenario that the value function is computed on.
        rollouts: How many.
        seed: Root of all randomness.
        largest_layer: Above so many states a step, the value function is approximate.
        defensive_steps: How many of a rollout's steps are sampled from the error model itself, on
            average.
        largest_part: How many rollouts are sampled at once.
    """

    twin: Simulator
    rollouts: int
    seed: int
    largest_layer: int = LARGEST_LAYER
    defensive_steps: float = DEFENSIVE_STEPS
    largest_part: int = LARGEST_PART
    name: str = "zero-variance"

    @property
    def stages(self) -> int:
        """How many parts there are."""
        return len(part_sizes(self.rollouts, largest=self.largest_part))

    def init(self, problem: Problem, *, repetition: int) -> ZeroVarianceState:
        """Compute the value function; repetitions share it.

        Raises:
            InputError: Single states do not decide the specification.
        """
        wanted = _Wanted(self.twin, problem.pem, require_unsafe(problem), self.largest_layer)
        proposal = _built(wanted, pause=problem.pause)
        proposal = with_defence(
            proposal, defensive_steps=self.defensive_steps, steps=self.twin.states - 1
        )
        batch = FinalBatch(part_sizes(self.rollouts, largest=self.largest_part))
        return ZeroVarianceState(repetition=repetition, proposal=proposal, batch=batch)

    def step(
        self, problem: Problem, state: ZeroVarianceState
    ) -> tuple[ZeroVarianceState, StageResult]:
        """Sample and score the next part."""
        stage = len(state.batch.sampled)
        scored = sample_stage(
            with_absorbing_violation(problem),
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

    def under_rule(self, state: ZeroVarianceState, rule: str) -> ZeroVarianceState:
        """The same rollouts with the verdict of one rule."""
        return replace(state, batch=state.batch.under_rule(rule))

    def is_done(self, state: ZeroVarianceState) -> bool:
        """Whether all is sampled."""
        return state.batch.is_done

    def estimate(self, state: ZeroVarianceState) -> Estimate:
        """The estimate from all rollouts.

        Raises:
            ValueError: They are not sampled yet.
        """
        estimate = importance_sampling_estimate(
            state.batch.weighed(), method=self.name, rollouts_simulated=self.rollouts
        )
        relative = estimate.std_error / estimate.probability if estimate.std_error else None
        doubts = called_safe(state.proposal.left_out, relative_error=relative)
        return replace(estimate, diagnostics=(*estimate.diagnostics, *doubts))


def require_unsafe(problem: Problem, *, method: str = "zero-variance") -> Unsafe:
    """What single states violate the specification; ``method`` is what wants them.

    Raises:
        InputError: There is no such answer for it.
    """
    if problem.unsafe is None:
        message = (
            f"method {method}: the specification must be 'always' over a condition on single "
            "states, such as always[0,99] (gap >= 2.0); use mixture for others"
        )
        raise InputError(message)
    return problem.unsafe


def with_absorbing_violation(problem: Problem) -> Problem:
    """The problem on a system that remembers violations, if the problem says what they are."""
    if problem.unsafe is not None:
        violated = Violated(problem.unsafe)
    elif problem.monitor is not None:
        violated = Monitored(problem.monitor)
    else:
        return problem
    return replace(problem, simulator=with_component(problem.simulator, violated))


@dataclass(frozen=True)
class _Wanted:
    """What a value function follows from."""

    twin: Simulator
    pem: Pem = field(compare=False)
    unsafe: Unsafe
    largest_layer: int


_last_built: list[tuple[_Wanted, ZeroVarianceProposal]] = []
"""At most one proposal: large, and the same for all repetitions and the reference."""


def _built(wanted: _Wanted, *, pause: Pause) -> ZeroVarianceProposal:
    """The proposal built last, where it is what is wanted; a build that is stopped leaves it."""
    for last, proposal in _last_built:
        # a model of the user's own need not know how to compare
        if last.pem is wanted.pem and last == wanted:
            return proposal
    build, frail = partial(build_zero_variance_proposal, pem=wanted.pem), FrailModel.of(wanted.pem)
    if frail is not None:
        build = partial(build_frail_proposal, model=frail)
    built = build(
        twin=wanted.twin, unsafe=wanted.unsafe, largest_layer=wanted.largest_layer, pause=pause
    )
    _last_built[:] = [(wanted, built)]
    return built
