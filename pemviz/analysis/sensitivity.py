"""How the failure probability would change with a better detector, by re-weighting.

If misses in a band of distances were ``f`` times as likely, a violating rollout would be
``f^misses * product over hits of (1 - f p) / (1 - p)`` times as likely, with p the model's
probability of a miss at each step: no new rollouts are needed. With a memory the factors are those
of :mod:`pemviz.analysis.outcome_likelihood`, p stays the model's own, in the state alone, and the
memory time has a sensitivity too. The derivative of the log of the failure probability is the mean
over violations of the derivative of their log likelihood (the score function; Rubinstein 1989,
Operations Research 37:72).
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.analysis.causes import Failures
from pemviz.analysis.outcome_likelihood import (
    IndependentOutcomes,
    MemoryLikelihood,
    OutcomeLikelihood,
)
from pemviz.arrays import BoolArray, FloatArray, row_sums
from pemviz.config.ranges import AtLeastZero
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.estimates.weight_diagnostics import effective_sample_size

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
        std_error: Of the elasticity; ``None`` without one, with fewer than ten effective
            failures, and in results of versions that did not tell it.
    """

    low: float | None
    high: float | None
    elasticity: float | None
    target_factor: AtLeastZero | None
    target_ess: AtLeastZero | None
    warning: str | None = None
    std_error: AtLeastZero | None = None


@dataclass(frozen=True)
class MemorySensitivity:
    """What a shorter memory, and so shorter bursts of misses, would bring.

    Attributes:
        tau_s: The memory time that the answer is for [s].
        elasticity: d log(failure probability) / d log(tau), with P(missed | state) as it is: a
            memory ten per cent shorter brings about ``elasticity`` times ten per cent fewer
            failures. ``None`` as in :class:`BandSensitivity`.
        target_tau_s: Memory time at which the failure probability meets the target [s]; ``None``
            without a target, or if even 1e-6 of ``tau_s`` does not suffice. ``tau_s`` where the
            target is met already.
        target_ess: As in :class:`BandSensitivity`.
        warning: As in :class:`BandSensitivity`.
        std_error: As in :class:`BandSensitivity`.
    """

    tau_s: AtLeastZero
    elasticity: float | None
    target_tau_s: AtLeastZero | None
    target_ess: AtLeastZero | None
    warning: str | None = None
    std_error: AtLeastZero | None = None


def band_sensitivities(
    failures: Failures,
    *,
    log_probability: float,
    edges: Sequence[float],
    target: float | None = None,
    likelihood: OutcomeLikelihood | None = None,
    unknown_because: str | None = None,
) -> tuple[BandSensitivity, ...]:
    """Sensitivity for all distances together, then for each band.

    Args:
        failures: Weighted violations.
        log_probability: Log of the failure probability [nats].
        edges: Of the bands, ascending [m].
        target: Failure probability to get below, above 0; ``None``: no target.
        likelihood: That of the violations' outcomes; ``None``: they are independent.
        unknown_because: Why nothing is known of it; ``None``: it is.
    """
    bands = list(itertools.pairwise(edges))
    if unknown_because is not None:
        return tuple(
            BandSensitivity(low, high, None, None, None, unknown_because)
            for low, high in [(None, None), *bands]
        )
    likelihood = likelihood or IndependentOutcomes.of(failures.rollouts)
    slope = likelihood.slope()

    def of_band(low: float | None, high: float | None, inside: BoolArray) -> BandSensitivity:
        elasticity, error = mean_sum(failures, slope, inside)
        if target is None:
            return BandSensitivity(low, high, elasticity, None, None, std_error=error)

        def log_change(factor: float) -> FloatArray:
            return likelihood.log_change_within(inside, factor=factor)

        factor, ess, warning = _meeting(failures, log_change, log_probability, target)
        if factor is None:
            warning = "even without misses here the target is not met"
        return BandSensitivity(low, high, elasticity, factor, ess, warning, error)

    rows = [of_band(None, None, failures.deciding)]
    for low, high in bands:
        value = failures.rollouts.decision_states().signals["gap"]
        rows.append(of_band(low, high, failures.deciding & (value >= low) & (value < high)))
    return tuple(rows)


def memory_sensitivity(
    failures: Failures,
    likelihood: MemoryLikelihood,
    *,
    log_probability: float,
    target: float | None = None,
) -> MemorySensitivity:
    """Sensitivity to the memory time.

    Args:
        failures: Weighted violations; steps that do not decide do not count.
        likelihood: That of their outcomes.
        log_probability: Log of the failure probability [nats].
        target: Failure probability to get below, above 0; ``None``: no target.
    """
    tau_s = likelihood.tau_s
    elasticity, error = mean_sum(failures, likelihood.slope_of_tau(), failures.deciding)
    if target is None:
        return MemorySensitivity(tau_s, elasticity, None, None, std_error=error)

    def log_change(factor: float) -> FloatArray:
        return likelihood.log_change_of_tau_within(failures.deciding, factor=factor)

    factor, ess, warning = _meeting(failures, log_change, log_probability, target)
    if factor is None:
        warning = "even without a memory the target is not met"
    target_tau_s = None if factor is None else factor * tau_s
    return MemorySensitivity(tau_s, elasticity, target_tau_s, ess, warning, error)


def mean_sum(
    failures: Failures, slope: FloatArray, inside: BoolArray
) -> tuple[float | None, float | None]:
    """Mean over the failures of the sum of ``slope [M, T-1]`` over the steps ``inside``.

    With its standard error, that of a ratio of means: ``None`` where the failures' effective sample
    size is below SMALL_ESS, which says nothing of it. Both ``None`` where the mean is
    not finite.
    """
    with np.errstate(invalid="ignore"):  # a failure that the model holds to be impossible
        sums = row_sums(np.where(inside, slope, 0.0))
        mean = float(failures.share @ sums)
    if not math.isfinite(mean):
        return None, None
    error = float(np.linalg.norm(failures.share * (sums - mean)))
    few = SMALL_ESS * float(failures.share @ failures.share) > 1.0
    return mean, None if few or not math.isfinite(error) else error


def _meeting(
    failures: Failures,
    log_change: Callable[[float], FloatArray],
    log_probability: float,
    target: float,
) -> tuple[float | None, float | None, str | None]:
    """The factor that meets the target, the failures' effective sample size there, a warning."""
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    log_share = np.log(np.maximum(failures.share, np.finfo(np.float64).tiny))

    def reweighted(log_factor: float) -> FloatArray:
        return log_share + log_change(math.exp(log_factor))

    def excess(log_factor: float) -> float:
        return log_probability + log_sum(reweighted(log_factor)) - math.log(target)

    least = math.log(SMALLEST_FACTOR)
    if excess(0.0) <= 0.0:
        log_factor = 0.0
    elif excess(least) > 0.0:
        return None, None, None
    else:
        log_factor = float(np.asarray(brentq(excess, least, 0.0, xtol=1e-9)))
    ess = effective_sample_size(reweighted(log_factor))
    few = ess < SMALL_ESS
    warning = "an extrapolation: few of the failures look like those left" if few else None
    return math.exp(log_factor), ess, warning
