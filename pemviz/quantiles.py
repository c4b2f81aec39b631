"""From standard normals to other distributions, by their quantile functions.

For scenarios with latents (:class:`pemviz.LatentCounts`): each function turns standard normals
``z [...]`` into values ``[...]`` that increase with z. Both tails keep all their digits: beyond
the median the survival function is used, so that z = 8 is as exact as z = -8.

    from pemviz import quantiles
    gap_m = quantiles.log_normal(start[:, 0], median=30.0, spread=0.3)
"""

from typing import Any

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri_exp

from pemviz.arrays import FloatArray
from pemviz.errors import ConfigError

Numbers = FloatArray | float
LARGEST_SEED = 2**31 - 1


def seed_of(z: float) -> int:
    """A generator's seed: all from 0 to below 2^31 - 1 are as likely."""
    return min(int(ndtr(float(z)) * LARGEST_SEED), LARGEST_SEED - 1)


def normal(z: FloatArray, *, mean: Numbers, sd: Numbers) -> FloatArray:
    """Normal with ``mean`` and standard deviation ``sd``, above 0, each one for all or ``[...]``.

    Raises:
        ConfigError: ``sd`` is not above 0.
    """
    _require_above_0("normal: sd", sd)
    return np.asarray(mean + sd * np.asarray(z))


def log_normal(z: FloatArray, *, median: Numbers, spread: Numbers) -> FloatArray:
    """Log-normal: its logarithm is normal around log ``median``.

    Args:
        z: Standard normals, ``[...]``.
        median: Above 0, one for all or ``[...]``.
        spread: Standard deviation of the logarithm, likewise.

    Raises:
        ConfigError: One of them is not above 0.

    Example:
        >>> import numpy as np
        >>> from pemviz import quantiles
        >>> z = np.array([-1.0, 0.0, 1.0])
        >>> print(quantiles.log_normal(z, median=30.0, spread=0.4).round(1))
        [20.1 30.  44.8]
    """
    _require_above_0("log_normal: median", median)
    _require_above_0("log_normal: spread", spread)
    return np.asarray(median * np.exp(spread * np.asarray(z)))


def uniform(z: FloatArray, *, low: Numbers, high: Numbers) -> FloatArray:
    """Uniform between ``low`` and ``high``, each one for all or ``[...]``.

    Raises:
        ConfigError: ``low`` is not below ``high``.
    """
    _require_above_0("uniform: high - low", np.subtract(high, low))
    z = np.asarray(z)
    share = np.subtract(high, low) * ndtr(-np.abs(z))
    return np.where(z < 0.0, low + share, high - share)


def truncated(z: FloatArray, *, low: float, high: float) -> FloatArray:
    """Standard normals cut to ``[low, high]``, for the functions above to map.

    With u the latent's probability, the quantile of (1 - u) Phi(low) + u Phi(high), by logarithms
    and in whichever tail is the smaller: an interval from 20 to 21 keeps its digits too.

    Args:
        z: Standard normals, ``[...]``; values increase with them.
        low: Finite or minus infinity.
        high: Finite or infinity.

    Raises:
        ConfigError: ``low`` is not below ``high``.

    Example:
        >>> import numpy as np
        >>> from pemviz import quantiles
        >>> z = quantiles.truncated(np.array([-9.0, 0.0, 9.0]), low=-1.0, high=2.0)
        >>> print(quantiles.normal(z, mean=28.0, sd=4.0).round(1))  # within 24 to 36
        [24.  28.7 36. ]
    """
    if not low < high:
        message = f"truncated: low = {low:g}: must be below high = {high:g}"
        raise ConfigError(message)
    z = np.asarray(z)
    below = np.logaddexp(log_ndtr(low) + log_ndtr(-z), log_ndtr(high) + log_ndtr(z))
    above = np.logaddexp(log_ndtr(-low) + log_ndtr(-z), log_ndtr(-high) + log_ndtr(z))
    values = np.where(below < above, ndtri_exp(below), -ndtri_exp(above))
    return np.clip(values, low, high)


def empirical(
    z: FloatArray, *, sample: FloatArray, low: float = -np.inf, high: float = np.inf
) -> FloatArray:
    """As a ``sample [n]``, linear between its sorted values (Hyndman, Fan 1996, type 7).

    Nothing lies beyond the sample's ends: what it did not show does not happen. Nor beyond ``low``
    and ``high``: what lies between them is scaled up to the whole.

    Raises:
        ConfigError: Fewer than two values, one that is no finite number, or nothing between
            ``low`` and ``high``.

    Example:
        >>> import numpy as np
        >>> from pemviz import quantiles
        >>> print(quantiles.empirical(np.array([-9.0, 0.0, 9.0]), sample=np.array([3.0, 1.0, 8.0])))
        [1. 3. 8.]
    """
    ordered = np.sort(np.asarray(sample, dtype=np.float64), axis=None)
    if ordered.size < 2 or not np.isfinite(ordered).all():
        message = f"empirical: {ordered.size} values: must be two finite numbers at least"
        raise ConfigError(message)
    z = np.asarray(z)
    begin, end = _place(ordered, low), ordered.size - 1 - _place(-ordered[::-1], -high)
    if not begin < end:
        message = f"empirical: nothing of the sample lies in [{low:g}, {high:g}]"
        raise ConfigError(message)
    inner = np.arange(np.floor(begin) + 1.0, np.ceil(end))
    ranks = np.concatenate([[begin], inner, [end]])
    values = np.interp(ranks, np.arange(ordered.size), ordered)
    place = (end - begin) * ndtr(-np.abs(z))
    from_low = np.interp(place, ranks - begin, values)
    from_high = np.interp(place, end - ranks[::-1], values[::-1])
    return np.where(z < 0.0, from_low, from_high)


def _place(ordered: FloatArray, bound: float) -> float:
    """The first rank, between the values' own ranks too, that is not below ``bound``."""
    rank = int(np.searchsorted(ordered, bound, side="left"))
    if rank == 0:
        return 0.0
    if rank == ordered.size:
        return float(rank)
    before, after = ordered[rank - 1], ordered[rank]
    return rank - 1 + float((bound - before) / (after - before))


def distribution(z: FloatArray, of: Any) -> FloatArray:
    """Any continuous distribution of scipy's with its parameters, such as ``stats.gamma(2.0)``.

    Args:
        z: Standard normals, ``[...]``.
        of: With ``ppf`` and ``isf``, the inverses of its distribution and survival functions.
    """
    z = np.asarray(z)
    tail = ndtr(-np.abs(z))
    return np.where(z < 0.0, of.ppf(tail), of.isf(tail))


def _require_above_0(what: str, values: Numbers) -> None:
    above = np.asarray(values) > 0.0
    if not np.all(above):  # nor is what is no number
        worst = np.asarray(values, dtype=np.float64)[~above].flat[0]
        message = f"{what} = {worst:g}: must be above 0"
        raise ConfigError(message)
