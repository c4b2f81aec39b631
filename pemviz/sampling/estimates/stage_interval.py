"""The interval of a stage's own estimate, of the kind that its method's description names."""

import math
from dataclasses import dataclass

from pemviz.drawn import Drawn
from pemviz.sampling.description import StageInterval
from pemviz.sampling.estimates.diagnostics import weight_diagnostics
from pemviz.sampling.estimates.estimate import log_normal_interval, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import (
    log_mean_failing_weight,
    log_std_error,
    weight_figures,
)
from pemviz.sampling.estimates.trust import caveats, interval_caveats
from pemviz.sampling.rollouts.final_batch import weighed
from pemviz.types import ScoredRollouts


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
    scored: ScoredRollouts, *, interval: StageInterval, method: str, drawn: Drawn | None = None
) -> StageBounds:
    """Interval of P(violation) from one stage's rollouts, at 95 % unless it has caveats.

    Args:
        scored: The stage's rollouts.
        interval: ``binomial`` (Clopper and Pearson 1934), ``log-normal`` (from the weights of
            the violations), or another: the stage tells none.
        method: Name of the method, for the estimate.
        drawn: All of them, where ``scored`` holds some alone and the method weighs them.
    """
    if interval == "binomial":
        estimate = monte_carlo_estimate(weighed(scored), method=method)
        return StageBounds(estimate.ci_low, estimate.ci_high, interval_caveats(estimate))
    violated = scored.violated if drawn is None else drawn.violated
    if interval != "log-normal" or not violated.any():
        return StageBounds()
    log_weight = scored.rollouts.log_weight if drawn is None else drawn.log_weight
    log_probability = log_mean_failing_weight(log_weight, violated)
    log_error = log_std_error(log_weight, violated)
    relative_error = math.exp(log_error - log_probability)
    low, high = log_normal_interval(log_probability, relative_error=relative_error)
    diagnostics = weight_diagnostics(
        weight_figures(log_weight[violated]),
        failures=int(violated.sum()),
        rollouts=violated.size,
        log10_probability=log_probability / math.log(10.0),
    )
    return StageBounds(low, high, caveats(diagnostics, method=method))
