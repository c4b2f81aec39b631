"""The interval between independent runs of splitting, whose estimates are near log-normal.

As levels and particles grow together, the logarithm of an unbiased particle estimate of p tends
to a normal with mean log p - s^2 / 2 and variance s^2 (Berard, Del Moral, Doucet 2014). Most runs
then find too little and a few very much: an interval around the runs' mean by its own standard
error misses p whenever those few are not among them. Here both parts of log p = E log + s^2 / 2
have intervals of their own, which the method of variance estimates recovery puts together
(Zou, Taleban, Huo 2009).
"""

import math

import numpy as np
from scipy.special import chdtri, ndtri, stdtrit

from pemviz.arrays import FloatArray
from pemviz.sampling.estimates.estimate import CONFIDENCE


def interval_between_runs(
    log_probability: FloatArray, *, least_variance: float
) -> tuple[float, float]:
    """Interval of the probability that independent runs estimate without bias.

    Args:
        log_probability: Logarithms of the runs' estimates, ``[R]``, R at least 2, all finite.
        least_variance: The variance of such a logarithm is at least this, above 0: the
            spread of few runs may be smaller by chance.

    Returns:
        Lower and upper end at 95 % confidence; the upper is at most 1.
    """
    runs, freedom = log_probability.size, log_probability.size - 1
    level = 0.5 + CONFIDENCE / 2.0
    seen = float(np.var(log_probability, ddof=1))
    half = max(
        float(stdtrit(freedom, level)) * math.sqrt(seen),
        float(ndtri(level)) * math.sqrt(least_variance),
    ) / math.sqrt(runs)
    least, most = (
        max(seen * freedom / float(chdtri(freedom, above)), least_variance)
        for above in (1.0 - level, level)
    )
    variance = max(seen, least_variance)
    centre = float(np.mean(log_probability)) + variance / 2.0
    low = centre - math.hypot(half, (variance - least) / 2.0)
    high = centre + math.hypot(half, (most - variance) / 2.0)
    return math.exp(low), math.exp(min(high, 0.0))
