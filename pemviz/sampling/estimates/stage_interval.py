"""The interval of a stage's own estimate, of the kind that its method's description names."""

import math

from pemviz.sampling.description import StageInterval
from pemviz.sampling.estimates.estimate import log_normal_interval, monte_carlo_estimate
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight, log_std_error
from pemviz.sampling.rollouts.final_batch import weighed
from pemviz.types import ScoredRollouts


def stage_interval(
    scored: ScoredRollouts, *, interval: StageInterval, method: str
) -> tuple[float | None, float | None]:
    """95 % interval of P(violation) from one stage's rollouts, ``None`` where they tell none.

    Args:
        scored: The stage's rollouts.
        interval: ``binomial`` (Clopper and Pearson 1934), ``log-normal`` (from the weights of
            the violations), or another: the stage tells none.
        method: Name of the method, for the estimate.
    """
    if interval == "binomial":
        estimate = monte_carlo_estimate(weighed(scored), method=method)
        return estimate.ci_low, estimate.ci_high
    if interval != "log-normal" or not scored.violated.any():
        return None, None
    log_weight = scored.rollouts.log_weight
    log_probability = log_mean_failing_weight(log_weight, scored.violated)
    log_error = log_std_error(log_weight, scored.violated)
    relative_error = math.exp(log_error - log_probability)
    return log_normal_interval(log_probability, relative_error=relative_error)
