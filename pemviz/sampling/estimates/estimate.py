"""Failure probabilities from scored rollouts."""

import math
import sys
from collections.abc import Sequence

import numpy as np
from scipy import stats

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.sampling.estimates.diagnostics import diagnose, negative_log_likelihood, weight_warnings
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight, log_std_error
from pemviz.sampling.rollouts.final_batch import WeighedRollouts
from pemviz.types import Estimate

CONFIDENCE = 0.95
ROUNDING = 1e-9
ADAPTATION = math.sqrt(2.0)
"""Factor on the standard error of rollouts whose proposals were fitted to one another.

The strata's own spread leaves out that the proposals are random too; the two are taken to
contribute alike. ``pemviz bench accuracy`` measures whether the intervals hold.
"""
SMALLEST_LOG = math.log(sys.float_info.min)


def monte_carlo_estimate(rollouts: WeighedRollouts, *, method: str) -> Estimate:
    """The share of violations, with the exact binomial interval (Clopper and Pearson 1934)."""
    count, failures = rollouts.count, int(rollouts.violated.sum())
    probability = failures / count
    interval = stats.binomtest(failures, count).proportion_ci(CONFIDENCE, method="exact")
    warnings: list[str] = []
    if failures == 0:
        warnings.append(
            f"no failure in {count} rollouts: the probability is below {interval.high:.2g} "
            f"with {CONFIDENCE:.0%} confidence, and nothing more is known"
        )
    elif failures < 10:
        warnings.append(f"only {failures} failures were seen: the interval is wide")
    return _estimate(
        rollouts,
        method=method,
        probability=probability,
        log10_probability=math.log10(probability) if failures else None,
        std_error=math.sqrt(probability * (1.0 - probability) / count) if failures else None,
        interval=(float(interval.low), float(interval.high)),
        warnings=warnings,
    )


def importance_sampling_estimate(
    rollouts: WeighedRollouts, *, method: str, rollouts_simulated: int
) -> Estimate:
    """The average weight of violations, with a log-normal interval."""
    log_weight, violated = rollouts.log_weight, rollouts.violated
    failures = int(violated.sum())
    if failures == 0:
        message = (
            f"no failure in {rollouts.count} rollouts: importance sampling then says "
            "nothing about the probability, not even an upper bound"
        )
        return _estimate(
            rollouts,
            method=method,
            probability=0.0,
            log10_probability=None,
            std_error=None,
            interval=(None, None),
            warnings=[message],
            rollouts_simulated=rollouts_simulated,
        )
    log_probability = log_mean_failing_weight(log_weight, violated)
    log_error = log_std_error(log_weight, violated)
    return _estimate(
        rollouts,
        method=method,
        probability=math.exp(log_probability),
        log10_probability=log_probability / math.log(10.0),
        std_error=math.exp(log_error),
        interval=log_normal_interval(
            log_probability, relative_error=math.exp(log_error - log_probability)
        ),
        warnings=[
            *weight_warnings(diagnose(log_weight[violated]), failures=failures),
            *magnitude_warnings(log_probability),
        ],
        rollouts_simulated=rollouts_simulated,
    )


def mixture_estimate(
    *,
    method: str,
    log_weight: FloatArray,
    violated: BoolArray,
    component: IntArray,
    log_p: FloatArray,
    frozen_log_weight: FloatArray,
    frozen: slice,
) -> Estimate:
    """The average weight of violations over rollouts from several proposals.

    Args:
        method: Name of the method.
        log_weight: By the balance heuristic, ``[N]``.
        violated: ``[N]``.
        component: Which proposal each rollout came from, ``[N]``; the standard error is that
            of a stratified sample.
        log_p: Log likelihood under the error model, ``[N]``.
        frozen_log_weight: Weights of the final batch among itself, ``[M]``: its proposals were
            fixed before it was drawn, so its average is unbiased.
        frozen: Which rollouts those are.
    """
    failures = int(violated.sum())
    final_component = component[frozen]
    unbiased = log_mean_failing_weight(frozen_log_weight, violated[frozen])
    unbiased_error = log_stratified_error(frozen_log_weight, violated[frozen], final_component)
    if failures == 0:
        message = (
            f"no failure in {violated.size} rollouts: importance sampling then says nothing about "
            "the probability, not even an upper bound"
        )
        warnings, interval, log_probability, log_error = [message], (None, None), -math.inf, None
    else:
        log_probability = log_mean_failing_weight(log_weight, violated)
        log_error = log_stratified_error(log_weight, violated, component) + math.log(ADAPTATION)
        interval = log_normal_interval(
            log_probability, relative_error=math.exp(log_error - log_probability)
        )
        warnings = [
            *weight_warnings(diagnose(log_weight[violated]), failures=failures),
            *magnitude_warnings(log_probability),
        ]
    diagnostics = diagnose(log_weight[violated])
    nll_mean, nll_log_mean = negative_log_likelihood(log_p[violated])
    return Estimate(
        method=method,
        probability=math.exp(log_probability),
        log10_probability=log_probability / math.log(10.0) if failures else None,
        std_error=None if log_error is None else math.exp(log_error),
        ci_low=interval[0],
        ci_high=interval[1],
        rollouts_simulated=int(violated.size),
        rollouts_in_estimate=int(violated.size),
        failures=failures,
        nll_mean=nll_mean,
        nll_log_mean=nll_log_mean,
        ess=diagnostics.ess,
        pareto_k=diagnostics.pareto_k,
        max_weight_share=diagnostics.max_weight_share,
        unbiased_probability=math.exp(unbiased),
        unbiased_std_error=math.exp(unbiased_error) if violated[frozen].any() else None,
        warnings=tuple(warnings),
    )


def log_stratified_error(log_weight: FloatArray, violated: BoolArray, component: IntArray) -> float:
    """Log of the standard error of the average weight of violations [nats].

    For strata with fixed numbers n_k of N draws: sqrt(sum_k n_k s_k^2) / N, with s_k the
    sample deviation within stratum k; a stratum of one adds its square whole. -inf if all 0.
    """
    if not violated.any():
        return -math.inf
    largest = float(np.max(log_weight[violated]))
    relative = np.where(violated, np.exp(np.minimum(log_weight - largest, 0.0)), 0.0)
    total = 0.0
    for stratum in np.unique(component):
        values = relative[component == stratum]
        spread = float(np.var(values, ddof=1)) if values.size > 1 else float(values[0] ** 2)
        total += values.size * spread
    return largest + 0.5 * math.log(total) - math.log(violated.size) if total > 0.0 else -math.inf


def log_normal_interval(
    log_probability: float, *, relative_error: float, degrees_of_freedom: float | None = None
) -> tuple[float, float]:
    """Interval around exp(log_probability), symmetric on the log scale.

    The log of the estimate is taken as normal (as t with ``degrees_of_freedom``) with
    variance log(1 + relative_error^2), that of a log-normal with this relative error. No
    interval is narrower than the rounding of weights that are products over many steps.
    """
    half = math.sqrt(math.log1p(max(relative_error, ROUNDING) ** 2))
    level = 0.5 + CONFIDENCE / 2.0
    quantile = (
        float(stats.norm.ppf(level))
        if degrees_of_freedom is None
        else float(stats.t.ppf(level, degrees_of_freedom))
    )
    low, high = log_probability - quantile * half, log_probability + quantile * half
    return math.exp(low), min(math.exp(min(high, 0.0)), 1.0)


def magnitude_warnings(log_probability: float) -> Sequence[str]:
    """What to say of a probability that no double can hold; nothing otherwise."""
    if log_probability >= SMALLEST_LOG:
        return ()
    exponent = log_probability / math.log(10.0)
    return (
        f"the probability, 10^{exponent:.2f}, is too small for a floating-point number and shows "
        "as 0: read log10_probability",
    )


def _estimate(
    rollouts: WeighedRollouts,
    *,
    method: str,
    probability: float,
    log10_probability: float | None,
    std_error: float | None,
    interval: tuple[float | None, float | None],
    warnings: Sequence[str],
    rollouts_simulated: int | None = None,
) -> Estimate:
    violated = rollouts.violated
    diagnostics = diagnose(rollouts.log_weight[violated])
    nll_mean, nll_log_mean = negative_log_likelihood(rollouts.log_p[violated])
    return Estimate(
        method=method,
        probability=probability,
        log10_probability=log10_probability,
        std_error=std_error,
        ci_low=interval[0],
        ci_high=interval[1],
        rollouts_simulated=rollouts_simulated or rollouts.count,
        rollouts_in_estimate=rollouts.count,
        failures=int(violated.sum()),
        nll_mean=nll_mean,
        nll_log_mean=nll_log_mean,
        ess=diagnostics.ess,
        pareto_k=diagnostics.pareto_k,
        max_weight_share=diagnostics.max_weight_share,
        unbiased_probability=probability,
        unbiased_std_error=std_error,
        warnings=tuple(warnings),
    )
