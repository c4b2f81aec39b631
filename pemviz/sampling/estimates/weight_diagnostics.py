"""Diagnostics of failing rollouts' weights: effective sample size, largest share, Pareto k-hat.

Their tail is judged by the generalised Pareto distribution that fits the largest: Zhang & Stephens,
'A new and efficient estimation method for the generalized Pareto distribution', Technometrics 2009,
with the prior for the shape of Vehtari, Simpson, Gelman, Yao & Gabry, 'Pareto smoothed importance
sampling', JMLR 2024, appendix C. To the last bit what arviz-stats gives, whose import takes more
than half a second.

The shape is the same whatever is added to all weights, and the average is not: of weights that are
all but equal, or tied as those of few chains of outcomes are, a tail of any shape may carry next to
nothing. So beside its shape stands how much it carries.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, log_sum_exp
from pemviz.sampling.estimates.importance_weights import log_sum

MINIMUM_TAIL = 5
ROUNDING = 1e-9
"""Relative, of weights that are products over many steps."""


@dataclass(frozen=True)
class WeightFigures:
    """How evenly the failing rollouts' weights are spread; ``None`` where undefined.

    See :func:`effective_sample_size`, :func:`pareto_k_hat`, :func:`largest_share` and
    :func:`tail_load`.
    """

    ess: float | None
    pareto_k: float | None
    max_weight_share: float | None
    tail_load: float | None


def effective_sample_size(log_weight: FloatArray) -> float:
    """Kish's effective sample size (sum w)^2 / sum w^2 of weights ``[M]``, M at least 1.

    Example:
        >>> import numpy as np
        >>> from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size
        >>> round(effective_sample_size(np.log([1.0, 1.0, 1.0, 1.0])), 6)
        4.0
        >>> round(effective_sample_size(np.log([1.0, 1.0, 1.0, 100.0])), 2)
        1.06
    """
    return float(np.exp(2.0 * log_sum(log_weight) - log_sum(2.0 * log_weight)))


def largest_share(log_weight: FloatArray) -> float:
    """Share of the total weight that the largest of ``[M]`` carries, M at least 1.

    Example:
        >>> import numpy as np
        >>> from pemviz.sampling.estimates.weight_diagnostics import largest_share
        >>> round(largest_share(np.log([1.0, 1.0, 2.0])), 6)
        0.5
    """
    return float(np.exp(np.max(log_weight) - log_sum(log_weight)))


def weight_figures(failing_log_weight: FloatArray, *, of: int) -> WeightFigures:
    """Figures of the log weights ``[M]`` of those that fail ``of`` N rollouts; M may be 0."""
    if failing_log_weight.size == 0:
        return WeightFigures(ess=None, pareto_k=None, max_weight_share=None, tail_load=None)
    pareto_k = pareto_k_hat(failing_log_weight)
    return WeightFigures(
        ess=effective_sample_size(failing_log_weight),
        pareto_k=pareto_k,
        max_weight_share=largest_share(failing_log_weight),
        tail_load=None if pareto_k is None else tail_load(failing_log_weight, of=of),
    )


def pareto_k_hat(log_weight: FloatArray) -> float | None:
    """Shape of the generalised Pareto fitted to the largest weights of ``[M]``.

    ``None`` where the tail has fewer than five weights, no spread, or more than doubles hold.

    Example:
        >>> import numpy as np
        >>> from pemviz.sampling.estimates.weight_diagnostics import pareto_k_hat
        >>> exceeds = np.arange(0.5, 1000.0) / 1000.0  # P(weight > w) of each of a thousand
        >>> [round(pareto_k_hat(-k * np.log(exceeds)), 1) for k in (0.3, 0.5)]  # w^(-1 / k)
        [0.3, 0.5]
        >>> pareto_k_hat(np.zeros(1000)) is None  # equal weights have no tail
        True
    """
    tail = int(min(log_weight.size // 5, np.ceil(3 * np.sqrt(log_weight.size))))
    if tail < MINIMUM_TAIL or np.ptp(np.sort(log_weight)[-tail:]) == 0.0:
        return None
    # weights that span more than double precision break the fit: no figure, no warning
    with np.errstate(all="ignore"):
        try:
            value = tail_shape(log_weight)
        except ValueError:  # no spread in a tail that is cut off elsewhere
            return None
    return value if np.isfinite(value) else None


def tail_load(log_weight: FloatArray, *, of: int) -> float:
    """What the tail carries beyond its cutoff, in standard errors of all that is below it.

    With u the cutoff, the sum of M weights, M at least 25, of ``of`` N rollouts is the sum of
    min(w, u), numbers that are bounded, so that their standard error holds, and of max(w - u, 0),
    which is all that the tail's shape can make wrong. Truncation at u leaves the second out, which
    is then the bias (Ionides, 'Truncated importance sampling', JCGS 2008). While it is within the
    error of the first, a tail that is wrong by all it carries moves the average no further than
    chance does.
    """
    relative = np.exp(log_weight - np.max(log_weight))
    place = relative.size - _tail_size(relative.size) - 1
    below = np.minimum(relative, np.partition(relative, place)[place])
    mean = float(below.sum()) / of
    squares = float(np.sum((below - mean) ** 2)) + (of - relative.size) * mean**2
    error = max(squares**0.5, ROUNDING * float(relative.sum()))
    return float(np.sum(relative - below)) / error


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
    size = _tail_size(count)
    tail, cutoff = relative[-size:], relative[-size - 1]
    if tail[-1] - tail[0] < np.finfo(np.float64).tiny:
        message = "the tail's weights are all the same"
        raise ValueError(message)
    return fitted_shape(np.exp(tail) - np.exp(cutoff))


def _tail_size(count: int) -> int:
    """How many of so many weights are the tail."""
    return int(3 * count**0.5 if count > SMALL_SAMPLE else count / 5)


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
