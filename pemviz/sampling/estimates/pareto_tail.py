"""The generalised Pareto distribution that fits the largest of importance weights.

Zhang & Stephens, 'A new and efficient estimation method for the generalized Pareto distribution',
Technometrics 2009, with the prior for the shape of Vehtari, Simpson, Gelman, Yao & Gabry, 'Pareto
smoothed importance sampling', JMLR 2024, appendix C. To the last bit what arviz-stats gives, whose
import takes more than half a second.
"""

import numpy as np

from pemviz.arrays import FloatArray, log_sum_exp

PRIOR_SHAPE, PRIOR_COUNT = 0.5, 10
"""The shape is drawn towards the first as if so many observations had it."""
PRIOR_QUARTILE = 3
"""Of the grid of rates: how many times the first quartile its prior's scale is."""
FEWEST_RATES = 30
SMALL_SAMPLE = 225
"""Up to so many weights a fifth is the tail, beyond it 3 sqrt(M)."""


def tail_shape(log_weight: FloatArray) -> float:
    """Shape k of the tail of weights ``[M]``, M at least 25; the largest is 1, or any scale.

    Raises:
        ValueError: The tail has no spread.
    """
    relative = np.sort(log_weight - np.max(log_weight))
    count = relative.size
    size = int(3 * count**0.5 if count > SMALL_SAMPLE else count / 5)
    tail, cutoff = relative[-size:], relative[-size - 1]
    if tail[-1] - tail[0] < np.finfo(np.float64).tiny:
        message = "the tail's weights are all the same"
        raise ValueError(message)
    return fitted_shape(np.exp(tail) - np.exp(cutoff))


def fitted_shape(excess: FloatArray) -> float:
    """Shape k of a generalised Pareto distribution that fits ``excess [n]``, ascending, above 0.

    The posterior mean of the rate b = -k / scale over a grid gives the shape, which is then drawn
    towards the prior's. NaN or infinite where doubles do not hold what is needed.
    """
    count = excess.size
    rates = FEWEST_RATES + int(count**0.5)
    rate = 1 - np.sqrt(rates / (np.arange(1, rates + 1, dtype=np.float64) - 0.5))
    rate /= PRIOR_QUARTILE * excess[int(count / 4 + 0.5) - 1]
    rate += 1 / excess[-1]
    shape = np.mean(np.log1p(-rate[:, None] * excess), axis=1)
    log_profile = count * (np.log(-rate / shape) - shape - 1)
    weight = np.exp(log_profile - log_sum_exp(log_profile))
    kept = weight >= 10 * np.finfo(np.float64).eps
    weight, rate = weight[kept], rate[kept]
    weight = weight / weight.sum()
    fitted = np.mean(np.log1p(-np.sum(rate * weight) * excess))
    return float((count * fitted + PRIOR_COUNT * PRIOR_SHAPE) / (count + PRIOR_COUNT))
