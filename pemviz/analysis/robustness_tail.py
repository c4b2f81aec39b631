"""Robustness of a rollout under the error model: expected, and in the worst hundredth.

The expected shortfall (conditional value at risk) by its form as an expectation (Rockafellar &
Uryasev, 2000, theorem 1): with ``r`` the quantile at level ``a``, it is
``r + E[min(rho - r, 0)] / a``. Both are averages over rollouts with importance weights, normalised
by their sum: what all weights together are short of N, as rollouts of rare proposals are missing,
would be taken for robustness otherwise. The standard error is that of a ratio of two averages.
"""

from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero, Count, Share
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size

WORST = 0.01
FEWEST = 100.0
"""Effective sample size of all weights from which on the expected robustness is shown."""
FEWEST_OF_WORST = 10.0
"""The same of those of the worst."""
FAR_FROM_ONE = 0.1
"""By how much the mean weight may differ from its expectation, 1."""


@dataclass(frozen=True, kw_only=True)
class RobustnessTail:
    """Under the run's metric, over what the error model makes of the scenario.

    Attributes:
        rollouts: That were weighed.
        expected: The mean.
        expected_std_error: Of that.
        worst_share: Of all, the least robust.
        worst: Their mean; ``None`` where too few of them were sampled.
        worst_std_error: Of that.
        quantile: What their robustness is at most.
    """

    rollouts: Count
    expected: float
    expected_std_error: AtLeastZero
    worst_share: Share = WORST
    worst: float | None = None
    worst_std_error: AtLeastZero | None = None
    quantile: float | None = None


def robustness_tail(robustness: FloatArray, log_weight: FloatArray) -> RobustnessTail | None:
    """Of N rollouts; ``None`` where their weights tell too little of what usually happens.

    Rollouts are often drawn where violations are: what they say of all others then is
    nothing, however many there are.

    Args:
        robustness: ``[N]``.
        log_weight: Log importance weights ``[N]`` [nats].
    """
    weight = np.exp(log_weight)
    if not np.isfinite(robustness).all() or effective_sample_size(log_weight) < FEWEST:
        return None
    if abs(float(np.mean(weight)) - 1.0) > FAR_FROM_ONE:
        return None
    expected, error = _mean(robustness, weight)
    found = RobustnessTail(rollouts=weight.size, expected=expected, expected_std_error=error)
    order = np.argsort(robustness, kind="stable")
    reached = np.cumsum(weight[order]) / weight.sum()
    last = int(np.searchsorted(reached, WORST))
    worst = order[: last + 1]
    if last == weight.size or effective_sample_size(log_weight[worst]) < FEWEST_OF_WORST:
        return found
    quantile = float(robustness[order[last]])
    below, error = _mean(np.minimum(robustness - quantile, 0.0), weight)
    return replace(
        found, worst=quantile + below / WORST, worst_std_error=error / WORST, quantile=quantile
    )


def _mean(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Weighted mean of ``values [N]`` and its standard error."""
    mean = float(np.average(values, weights=weight))
    apart = weight * (values - mean) / np.mean(weight)
    return mean, float(np.std(apart, ddof=1) / np.sqrt(values.size))
