"""Whether an interval may be read as a 95 % interval, and so whether it may decide anything.

Decided here, for all that show one and for the gate.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pemviz.errors import ConfigError
from pemviz.sampling.description import MethodDescription, StageInterval
from pemviz.sampling.estimates.diagnostics import (
    MEANINGS,
    IntervalBasis,
    reason,
    undermining,
    weight_diagnostics,
)
from pemviz.sampling.estimates.estimators import log_normal_interval, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight, log_std_error
from pemviz.sampling.estimates.weight_diagnostics import weight_figures
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.large_stages import weighed
from pemviz.types import Diagnostic, Estimate, SampledRollouts, ScoredRollouts

STRICTEST: IntervalBasis = "weights"
"""What the interval of a method is taken to rest on that is not known here."""


def interval_caveats(
    estimate: Estimate, diagnostics: Iterable[Diagnostic] | None = None
) -> tuple[str, ...]:
    """Why ``ci_low`` and ``ci_high`` are no interval at ``confidence``; empty if they are one.

    An estimate whose interval is none decides nothing: the gate, claims and all that call an answer
    reliable go by this too. ``diagnostics`` are all that is known to be wrong; ``None``: the
    estimate's own.
    """
    wrong = estimate.diagnostics if diagnostics is None else diagnostics
    return caveats(wrong, method=estimate.method)


def remedy(
    method: str, *, checks: Sequence[str] = (), diagnostics: Iterable[Diagnostic] = ()
) -> str:
    """What to try where an answer of ``method`` is not to be trusted, in words.

    What one of its ``diagnostics`` says comes before what the method does; ``checks`` are methods
    that can be had for the same.
    """
    for one in diagnostics:
        if (known := MEANINGS[one.kind].remedy) is not None:
            return known
    described = _description(method)
    if described is None:
        return "another method"
    beside = (
        f"; --method {' or '.join(checks)} beside it" if described.is_checked and checks else ""
    )
    return f"{described.remedy}{beside}"


def rests_on_weights(method: str) -> bool:
    """Whether estimates of ``method`` average weights; not of one that is not installed here."""
    described = _description(method)
    return described is not None and described.rests_on_weights


def caveats(diagnostics: Iterable[Diagnostic], *, method: str) -> tuple[str, ...]:
    """Why an interval of ``method`` with these diagnostics does not hold at its level.

    What the method's description says of its intervals comes last: it holds of all of them.
    """
    described = _description(method)
    basis = STRICTEST if described is None else described.interval_basis
    reasons = tuple(map(reason, undermining(diagnostics, basis=basis)))
    of_method = None if described is None else described.interval_caveat
    return reasons if of_method is None else (*reasons, of_method)


def _description(method: str) -> MethodDescription | None:
    """``None`` for a method that is not installed here: a recording may come from elsewhere."""
    try:
        return by_name(method)
    except ConfigError:
        return None


@dataclass(frozen=True)
class StageBounds:
    """The interval of a stage's own estimate.

    Attributes:
        low: Lower end; ``None`` where the stage tells none.
        high: Upper end; ``None`` likewise.
        caveats: Why they are no 95 % interval; empty if they are one.
    """

    low: float | None = None
    high: float | None = None
    caveats: tuple[str, ...] = ()


def stage_interval(
    scored: ScoredRollouts,
    *,
    interval: StageInterval,
    method: str,
    sampled: SampledRollouts | None = None,
) -> StageBounds:
    """Interval of P(violation) from one stage's rollouts, at 95 % unless it has caveats.

    ``binomial`` (Clopper and Pearson 1934), ``log-normal`` from the weights of the violations, or
    another: the stage tells none. ``sampled`` are all rollouts, where ``scored`` holds some alone
    and the method weighs them.
    """
    if interval == "binomial":
        estimate = monte_carlo_estimate(weighed(scored), method=method)
        return StageBounds(estimate.ci_low, estimate.ci_high, interval_caveats(estimate))
    violated = scored.violated if sampled is None else sampled.violated
    if interval != "log-normal" or not violated.any():
        return StageBounds()
    log_weight = scored.rollouts.log_weight if sampled is None else sampled.log_weight
    log_probability = log_mean_failing_weight(log_weight, violated)
    log_error = log_std_error(log_weight, violated)
    relative_error = math.exp(log_error - log_probability)
    low, high = log_normal_interval(log_probability, relative_error=relative_error)
    diagnostics = weight_diagnostics(
        weight_figures(log_weight[violated], of=violated.size),
        failures=int(violated.sum()),
        rollouts=violated.size,
        log10_probability=log_probability / math.log(10.0),
    )
    return StageBounds(low, high, caveats(diagnostics, method=method))
