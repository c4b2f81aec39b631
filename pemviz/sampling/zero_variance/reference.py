"""The reference: the answer to compare other estimates with."""

import math
from dataclasses import dataclass, replace

from pemviz.config.ranges import AtLeastZero, Log10
from pemviz.sampling.estimates.diagnostics import reason, undermining
from pemviz.sampling.problem import Problem, nothing_finished
from pemviz.sampling.rollouts.large_stages import largest_part
from pemviz.sampling.state.composed import without_following
from pemviz.sampling.zero_variance.frail import FrailModel, frail_log_probability
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling, require_unsafe
from pemviz.sampling.zero_variance.reachable_states import TooManyStates, explore
from pemviz.sampling.zero_variance.values import solve
from pemviz.simulators.quantised import start_cells
from pemviz.types import Simulator

REFERENCE_ROLLOUTS = 20_000
REFERENCE_SEED = 2**62 + 5
REFERENCE_DEFENSIVE_STEPS = 0.2
FEW_STATES = 200_000
"""So few states are looked at in any case: the recursion over them takes a tenth of a second."""
FRAIL_COST = 20
"""Where obstacles differ, how many times fewer are."""


@dataclass(frozen=True)
class Reference:
    """The failure probability, as near as it can be had.

    Attributes:
        probability: The failure probability.
        std_error: Its standard error; 0 where it is a recursion over all states.
        log10_probability: Its decimal logarithm; ``None`` if it is 0.
        warnings: Why it is unreliable itself; empty as a rule.
    """

    probability: AtLeastZero
    std_error: AtLeastZero
    log10_probability: Log10 | None
    warnings: tuple[str, ...] = ()


def reference(
    problem: Problem, *, twin: Simulator, rollouts: int = REFERENCE_ROLLOUTS
) -> Reference:
    """Importance sampling with the twin's value function, on the problem's own simulator.

    Unbiased even where the twin is wrong, which a recursion on the twin would not notice;
    where the twin is right its standard error is some thousandths of a per cent. The seed
    is its own, so that nothing else depends on whether a reference was wanted.

    Raises:
        InputError: Single states do not decide the specification.
    """
    method = ZeroVarianceSampling(
        twin=twin,
        rollouts=rollouts,
        seed=REFERENCE_SEED,
        defensive_steps=REFERENCE_DEFENSIVE_STEPS,
    )
    # what an interrupted run left is its own method's, not the reference's
    problem = replace(problem.without_rules(), finished=nothing_finished)
    try:
        is_twin = problem.simulator is twin or bool(problem.simulator == twin)
    except ValueError:  # arrays among their parts
        is_twin = False
    if is_twin:
        # as cheap as a twin is, rollouts sampled together evaluate the model less often
        together = max(problem.batch_rollouts, largest_part(states=twin.states))
        problem = replace(problem, batch_rollouts=together)
    state = method.init(problem, repetition=0)
    while not method.is_done(state):
        state, _ = method.step(problem, state)
    estimate = method.estimate(state)
    return Reference(
        probability=estimate.probability,
        std_error=estimate.std_error or 0.0,
        log10_probability=estimate.log10_probability,
        warnings=tuple(map(reason, undermining(estimate.diagnostics, basis="weights"))),
    )


def reference_of_few_states(
    problem: Problem, *, twin: Simulator, most_states: int | None = None
) -> Reference | None:
    """The answer by recursion where that costs next to nothing.

    A check that shares no blind spot with sampling: it goes through every sequence of outcomes,
    also where no signal and no rollout points at the one that fails. ``None`` where the twin has
    more than ``most_states``, or :data:`FEW_STATES`, where single states do not decide the
    specification, or where the twin's start alone is quantised.
    """
    if problem.unsafe is None or start_cells(twin) != start_cells(problem.simulator):
        return None
    most_states = FEW_STATES if most_states is None else most_states
    try:
        log_probability = exact_log_probability(problem, twin=twin, most_states=most_states)
    except TooManyStates:
        return None
    if log_probability is None:
        return None
    possible = not math.isinf(log_probability)
    return Reference(
        probability=math.exp(log_probability),
        std_error=0.0,
        log10_probability=log_probability / math.log(10.0) if possible else None,
    )


def exact_log_probability(
    problem: Problem, *, twin: Simulator, most_states: int | None = None
) -> float | None:
    """Log of the twin's failure probability by recursion; ``None`` if it has too many states.

    Exact up to rounding, over all sequences of outcomes; -inf if none of them violates.

    Raises:
        InputError: Single states do not decide the specification.
        TooManyStates: The twin has more than ``most_states``.
    """
    frail = FrailModel.of(problem.pem)
    if frail is not None and most_states is not None:
        most_states //= FRAIL_COST
    graph = explore(
        twin=twin if frail is None else without_following(twin),
        pem=problem.pem if frail is None else frail,
        unsafe=require_unsafe(problem),
        most_states=most_states,
        pause=problem.pause,
    )
    if not graph.exact:
        return None
    if frail is not None:
        return frail_log_probability(graph, frail, pause=problem.pause)
    return solve(graph, pause=problem.pause).log_probability
