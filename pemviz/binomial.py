"""Exact bounds of a probability from a count of events (Clopper and Pearson 1934).

The bounds are quantiles of beta distributions. They come from scipy.special: scipy.stats takes
longer to import than many a command to answer.
"""

import numpy as np
from scipy.special import betaincinv

from pemviz.arrays import FloatArray, IntArray


def exact_interval(events: int, trials: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """The two-sided interval; (0, 1) without trials.

    Example:
        >>> from pemviz.binomial import exact_interval
        >>> low, high = exact_interval(2, 1000)
        >>> print(f"{low:.2e} to {high:.2e}")
        2.42e-04 to 7.21e-03
    """
    if trials == 0:
        return 0.0, 1.0
    each = (1.0 + confidence) / 2.0
    low = float(betaincinv(events, trials - events + 1.0, 1.0 - each)) if events else 0.0
    return low, exact_upper_bound(events, trials, confidence=each)


def exact_upper_bound(events: int, trials: int, *, confidence: float = 0.95) -> float:
    """The one-sided upper bound; 1 without trials.

    Example:
        >>> from pemviz.binomial import exact_upper_bound
        >>> print(f"{exact_upper_bound(0, 3000):.1e}")  # the rule of three
        1.0e-03
    """
    return float(
        exact_upper_bounds(np.array(events), np.array(trials - events), confidence=confidence)
    )


def exact_upper_bounds(events: IntArray, others: IntArray, *, confidence: float) -> FloatArray:
    """The same for counts ``[...]`` of events and of trials without one."""
    quantile = betaincinv(events + 1.0, np.maximum(others, 1.0), confidence)
    return np.where(others > 0, quantile, 1.0)
