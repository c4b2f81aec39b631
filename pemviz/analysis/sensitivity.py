"""How the failure probability would change with a better detector, by re-weighting.

If misses in a band of distances were ``f`` times as likely, a violating rollout would be
``f^misses * product over hits of (1 - f p) / (1 - p)`` times as likely, with p the model's
probability of a miss at each step: no new rollouts are needed.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit

from pemviz.analysis.causes import Failures
from pemviz.arrays import BoolArray, FloatArray, row_sums
from pemviz.config.ranges import AtLeastZero
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.estimates.importance_weights import effective_sample_size, log_sum

SMALLEST_FACTOR = 1e-6


@dataclass(frozen=True)
class BandSensitivity:
    """What improving the detector within one band of distances would bring.

    Attributes:
        low: Lower edge of the band [m]; ``None`` for all distances together.
        high: Upper edge; ``None`` for all distances together.
        elasticity: d log(failure probability) / d log(probability of a miss in the band): ten
            per cent fewer misses bring about ``elasticity`` times ten per cent fewer failures.
            ``None`` where a failure has a detection that the model holds to be impossible.
        target_factor: Misses in the band must become this many times as likely for the failure
            probability to meet the target; ``None`` without a target, or if even a factor of
            1e-6 does not suffice. 1 where the target is met already.
        target_ess: Effective sample size of the failures under that factor: small, and the
            factor is an extrapolation.
        warning: What to keep in mind about the factor; ``None`` if nothing.
    """

    low: float | None
    high: float | None
    elasticity: float | None
    target_factor: AtLeastZero | None
    target_ess: AtLeastZero | None
    warning: str | None = None


def band_sensitivities(
    failures: Failures,
    *,
    log_probability: float,
    edges: Sequence[float],
    target: float | None = None,
    signal: str = "gap",
) -> tuple[BandSensitivity, ...]:
    """Sensitivity for all distances together, then for each band.

    Args:
        failures: Weighted violations.
        log_probability: Log of the failure probability [nats].
        edges: Of the bands, ascending [m].
        target: Failure probability to get below, above 0; ``None``: no target.
        signal: The distance.
    """
    signals = failures.rollouts.decision_states().signals
    aim = (log_probability, target)
    rows = [_sensitivity(failures, failures.deciding, (None, None), *aim)]
    for low, high in itertools.pairwise(edges):
        value = signals[signal]
        inside = failures.deciding & (value >= low) & (value < high)
        rows.append(_sensitivity(failures, inside, (low, high), *aim))
    return tuple(rows)


def log_change(failures: Failures, inside: BoolArray, *, factor: float) -> FloatArray:
    """Log likelihood ratios ``[M]`` if misses ``inside [M, T-1]`` were ``factor`` times as likely.

    ``factor`` must be in (0, 1].
    """
    miss = expit(-failures.rollouts.pem_logit)
    missed = ~failures.rollouts.detected
    with np.errstate(divide="ignore", invalid="ignore"):  # where a miss is certain
        hits = np.log1p(-factor * miss) - np.log1p(-miss)
    change = np.where(missed, math.log(factor), hits)
    return row_sums(np.where(inside, change, 0.0))


def _sensitivity(
    failures: Failures,
    inside: BoolArray,
    band: tuple[float | None, float | None],
    log_probability: float,
    target: float | None,
) -> BandSensitivity:
    elasticity = _elasticity(failures, inside)
    if target is None:
        return BandSensitivity(*band, elasticity, None, None)
    log_share = np.log(np.maximum(failures.share, np.finfo(np.float64).tiny))

    def reweighted(log_factor: float) -> FloatArray:
        return log_share + log_change(failures, inside, factor=math.exp(log_factor))

    def excess(log_factor: float) -> float:
        return log_probability + log_sum(reweighted(log_factor)) - math.log(target)

    log_factor = _root(excess)
    if log_factor is None:
        return BandSensitivity(
            *band, elasticity, None, None, "even without misses here the target is not met"
        )
    ess = effective_sample_size(reweighted(log_factor))
    warning = (
        "an extrapolation: few of the failures look like those left" if ess < SMALL_ESS else None
    )
    return BandSensitivity(*band, elasticity, math.exp(log_factor), ess, warning)


def _elasticity(failures: Failures, inside: BoolArray) -> float | None:
    """Mean over the failures of d log(likelihood) / d log(probability of a miss ``inside``)."""
    miss = expit(-failures.rollouts.pem_logit)
    with np.errstate(divide="ignore", invalid="ignore"):  # certain misses: no figure, no warning
        slope = np.where(~failures.rollouts.detected, 1.0, -miss / (1.0 - miss))
        elasticity = float(failures.share @ row_sums(np.where(inside, slope, 0.0)))
    return elasticity if math.isfinite(elasticity) else None


def _root(excess: Callable[[float], float]) -> float | None:
    """The log factor at which the excess is 0: 0 if there is none, ``None`` out of reach."""
    least = math.log(SMALLEST_FACTOR)
    if excess(0.0) <= 0.0:
        return 0.0
    if excess(least) > 0.0:
        return None
    return float(np.asarray(brentq(excess, least, 0.0, xtol=1e-9)))
