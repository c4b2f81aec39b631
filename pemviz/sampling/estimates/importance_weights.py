"""Importance weights in log space; a weight that underflows stays in every average as 0."""

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, log_sum_exp


def log_sum(log_values: FloatArray) -> float:
    """Log of the sum of exp of values ``[M]``, M at least 1, without overflow."""
    return float(log_sum_exp(log_values))


def smoothed_weights(log_weight: FloatArray, *, alpha: float) -> FloatArray:
    """Training weights ``[N]``: w^alpha divided by their sum (the paper's weight smoothing)."""
    scaled = alpha * log_weight
    return np.exp(scaled - log_sum(scaled))


def log_mean_failing_weight(log_weight: FloatArray, violated: BoolArray) -> float:
    """Log of the average over all N rollouts of weight times violation; -inf without one.

    The importance sampling estimate of the failure probability (the paper's equation for
    mu-hat), as a logarithm [nats].

    Example:
        >>> import numpy as np
        >>> from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight
        >>> log_weight = np.log([0.02, 0.01, 3.0, 2.0])
        >>> violated = np.array([True, True, False, False])
        >>> print(round(np.exp(log_mean_failing_weight(log_weight, violated)), 6))  # 0.03 / 4
        0.0075
    """
    return log_mean_weight(log_weight[violated], of=log_weight.size)


def log_mean_weight(failing_log_weight: FloatArray, *, of: int) -> float:
    """The same from the log weights ``[F]`` of those that violate among ``of`` rollouts."""
    if failing_log_weight.size == 0:
        return -np.inf
    return log_sum(failing_log_weight) - float(np.log(of))


def log_std_error(log_weight: FloatArray, violated: BoolArray) -> float:
    """Log of the standard error of that average [nats]; -inf without a violation.

    The sample standard deviation (divisor N - 1) over the square root of N, computed
    relative to the largest weight so that nothing underflows.
    """
    if not violated.any() or log_weight.size < 2:
        return -np.inf
    largest = float(np.max(log_weight[violated]))
    relative = np.where(violated, np.exp(np.minimum(log_weight - largest, 0.0)), 0.0)
    deviation = float(np.std(relative, ddof=1)) / np.sqrt(log_weight.size)
    return largest + float(np.log(deviation)) if deviation > 0.0 else -np.inf
