"""Failure probabilities from scored rollouts."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri, stdtrit

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.binomial import exact_interval
from pemviz.sampling.estimates.diagnostics import count_diagnostics, weight_diagnostics
from pemviz.sampling.estimates.importance_weights import (
    log_mean_failing_weight,
    log_mean_weight,
    log_std_error,
    log_sum,
)
from pemviz.sampling.estimates.weight_diagnostics import ROUNDING, WeightFigures, weight_figures
from pemviz.sampling.rollouts.large_stages import WeighedRollouts
from pemviz.types import Diagnostic, Estimate

CONFIDENCE = 0.95
ADAPTATION = 1.15
"""Factor on the standard error of rollouts whose proposals were fitted to one another.

The strata's own spread leaves out that the proposals are random too. Over 491 unwarned runs of
``benchmarks trust --first-seed 100 --seeds 25`` intervals held the truth in 93.1 % without a
factor, 95.9 % with 1.1, 96.5 % with 1.15, 98.2 % with sqrt(2); other seeds judge the choice.
"""
SLOTS_AND_STARTS_ADAPTATION = 1.4
"""Where several obstacles meet several random start values, and proposals have most to learn.

32 runs of preset ``cut-in``, 2,400 rollouts each, beside nine million plain ones: intervals held
the probability of any rule and of ``no-collision`` in 83 % with 1.15, 94 % with 1.4; other seeds
judge the choice.
"""
HARD_ADAPTATION = 1.4
"""Where rollouts all start alike and proposals look at more than three features in few steps.

Over 32 unwarned runs on a cart pole, at 3e-4 and 3e-6, of 1,200 rollouts each, intervals held the
truth in 27 with 1.15, in 30 with 1.4.
"""
SEARCHED_ADAPTATION = 1.25
"""Where chains have searched the latents for failure modes.

Over 127 unwarned runs of method ``auto`` on systems of 2 to 300 latents intervals held the truth in
92.9 % with 1.15, 96.1 % with 1.25, 98.4 % with 1.4; other seeds judge the choice.
"""

REPLICATES = 4
"""Sets of even points that a proposal's starts are made of, each independent of the others: more
tell the error better, and each is less even."""
LEAST_VARIANCE_SHARE = 1.0 / 16.0
"""Of a stratum's variance as if its draws were independent: four replicates may be alike by chance.
"""


@dataclass(frozen=True)
class StratifiedError:
    """How well the average weight of a stratified sample's violations is known.

    Attributes:
        log_error: Log of its standard error [nats]; -inf if it is 0.
        degrees_of_freedom: Of that, by Satterthwaite (1946), where a stratum has replicates; else
            ``None``: as many as rollouts.
    """

    log_error: float
    degrees_of_freedom: float | None = None

    @staticmethod
    def of(
        log_weight: FloatArray,
        violated: BoolArray,
        component: IntArray,
        replicate: IntArray | None = None,
    ) -> "StratifiedError":
        """For strata with fixed numbers n_k of N draws, ``component [N]``.

        sqrt(sum_k n_k s_k^2) / N, with s_k the sample deviation within stratum k; a stratum of one
        adds its square whole. Draws of a stratum with a ``replicate [N]`` from 0 on depend on each
        other within each of its R replicates and not between them: n_k s_k^2 is R times the sample
        variance of the replicates' sums then, and no less than a part of what it is otherwise. Of
        those that hold the replicate need not be known.
        """
        if not violated.any():
            return StratifiedError(-math.inf)
        largest = float(np.max(log_weight[violated]))
        relative = np.where(violated, np.exp(np.minimum(log_weight - largest, 0.0)), 0.0)
        total = by_freedom = 0.0
        for stratum in np.unique(component):
            own = component == stratum
            values = relative[own]
            spread = float(np.var(values, ddof=1)) if values.size > 1 else float(values[0] ** 2)
            spread, freedom = values.size * spread, max(values.size - 1.0, 1.0)
            if replicate is not None and replicate[own].max() >= 0:
                labels = replicate[own].clip(0, REPLICATES - 1)  # a file may hold anything
                sums = np.bincount(labels, weights=values, minlength=REPLICATES)
                freedom, of_sums = REPLICATES - 1.0, REPLICATES * float(np.var(sums, ddof=1))
                spread = max(of_sums, LEAST_VARIANCE_SHARE * spread)
            total, by_freedom = total + spread, by_freedom + spread**2 / freedom
        if total == 0.0:
            return StratifiedError(-math.inf)
        log_error = largest + 0.5 * math.log(total) - math.log(violated.size)
        return StratifiedError(log_error, None if replicate is None else total**2 / by_freedom)


def monte_carlo_estimate(rollouts: WeighedRollouts, *, method: str) -> Estimate:
    """The share of violations, with the exact binomial interval (Clopper and Pearson 1934)."""
    count, failures = rollouts.count, rollouts.failures
    probability = failures / count
    interval = exact_interval(failures, count, confidence=CONFIDENCE)
    return _estimate(
        rollouts,
        method=method,
        probability=probability,
        log10_probability=math.log10(probability) if failures else None,
        std_error=math.sqrt(probability * (1.0 - probability) / count) if failures else None,
        interval=interval,
        figures=weight_figures(rollouts.log_weight, of=count),
        diagnostics=count_diagnostics(
            failures=failures, rollouts=count, upper=interval[1], confidence=CONFIDENCE
        ),
    )


def importance_sampling_estimate(
    rollouts: WeighedRollouts, *, method: str, rollouts_simulated: int
) -> Estimate:
    """The average weight of violations, with a log-normal interval."""
    log_weight, violated = np.zeros(rollouts.count), np.zeros(rollouts.count, dtype=np.bool_)
    log_weight[rollouts.row], violated[rollouts.row] = rollouts.log_weight, True
    error = StratifiedError(log_std_error(log_weight, violated))
    found = _average(rollouts, method=method, error=error)
    return replace(found, rollouts_simulated=rollouts_simulated or rollouts.count)


def mixture_estimate(
    *,
    method: str,
    log_weight: FloatArray,
    violated: BoolArray,
    component: IntArray,
    log_p: FloatArray,
    frozen_log_weight: FloatArray,
    frozen: slice,
    adaptation: float = ADAPTATION,
    correction_error: float = 0.0,
    replicate: IntArray | None = None,
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
            fixed before it was sampled, so its average is unbiased.
        frozen: Which rollouts those are.
        adaptation: Factor on the standard error.
        correction_error: How far off it may be beside, as a share of it: the standard error is the
            root of the sum of both squares.
        replicate: Which rollouts of a proposal are drawn together, ``[N]``, see
            :meth:`StratifiedError.of`; ``None``: none are.
    """
    row = np.flatnonzero(violated)
    rollouts = WeighedRollouts(violated.size, row, log_weight[row], log_p[row])
    found = StratifiedError.of(log_weight, violated, component, replicate)
    log_error = found.log_error + math.log(adaptation)
    if correction_error > 0.0:
        beside = log_mean_weight(rollouts.log_weight, of=rollouts.count) + math.log(
            correction_error
        )
        log_error = 0.5 * float(np.logaddexp(2.0 * log_error, 2.0 * beside))
    error = replace(found, log_error=log_error)
    fails = violated[frozen]
    unbiased = log_mean_failing_weight(frozen_log_weight, fails)
    unbiased_error = StratifiedError.of(
        frozen_log_weight,
        fails,
        component[frozen],
        None if replicate is None else replicate[frozen],
    )
    return replace(
        _average(rollouts, method=method, error=error),
        unbiased_probability=math.exp(unbiased),
        unbiased_std_error=math.exp(unbiased_error.log_error) if fails.any() else None,
    )


def _average(rollouts: WeighedRollouts, *, method: str, error: StratifiedError) -> Estimate:
    """The average weight of violations, whose standard error is known."""
    failures = rollouts.failures
    figures = weight_figures(rollouts.log_weight, of=rollouts.count)
    log_probability = log_mean_weight(rollouts.log_weight, of=rollouts.count)
    log10_probability, std_error, interval = None, None, (None, None)
    if failures:
        log10_probability = log_probability / math.log(10.0)
        std_error = math.exp(error.log_error)
        interval = log_normal_interval(
            log_probability,
            relative_error=math.exp(error.log_error - log_probability),
            degrees_of_freedom=error.degrees_of_freedom,
        )
    return _estimate(
        rollouts,
        method=method,
        probability=math.exp(log_probability),
        log10_probability=log10_probability,
        std_error=std_error,
        interval=interval,
        figures=figures,
        diagnostics=weight_diagnostics(
            figures,
            failures=failures,
            rollouts=rollouts.count,
            log10_probability=log10_probability,
        ),
    )


def log_normal_interval(
    log_probability: float, *, relative_error: float, degrees_of_freedom: float | None = None
) -> tuple[float, float]:
    """Interval around exp(log_probability), symmetric on the log scale.

    The log of the estimate is taken as normal (as t with ``degrees_of_freedom``) with
    variance log(1 + relative_error^2), that of a log-normal with this relative error. No
    interval is narrower than the rounding of weights that are products over many steps.

    Example:
        >>> import math
        >>> from pemviz.sampling.estimates.estimators import log_normal_interval
        >>> low, high = log_normal_interval(math.log(1e-9), relative_error=0.1)
        >>> print(f"{low:.2e} to {high:.2e}")
        8.22e-10 to 1.22e-09
    """
    half = math.sqrt(math.log1p(max(relative_error, ROUNDING) ** 2))
    level = 0.5 + CONFIDENCE / 2.0
    quantile = (
        float(ndtri(level))
        if degrees_of_freedom is None
        else float(stdtrit(degrees_of_freedom, level))
    )
    low, high = log_probability - quantile * half, log_probability + quantile * half
    return math.exp(low), min(math.exp(min(high, 0.0)), 1.0)


def negative_log_likelihood(log_p: FloatArray) -> tuple[float | None, float | None]:
    """NLL of failing rollouts with log likelihoods ``[M]`` under the error model [nats].

    Returns:
        The mean of the negative log likelihoods, and the negative log of the mean
        likelihood: the paper states the first, its code computes the second.
    """
    if log_p.size == 0:
        return None, None
    return float(-np.mean(log_p)), float(np.log(log_p.size)) - log_sum(log_p)


def _estimate(
    rollouts: WeighedRollouts,
    *,
    method: str,
    probability: float,
    log10_probability: float | None,
    std_error: float | None,
    interval: tuple[float | None, float | None],
    figures: WeightFigures,
    diagnostics: tuple[Diagnostic, ...],
) -> Estimate:
    nll_mean, nll_log_mean = negative_log_likelihood(rollouts.log_p)
    return Estimate(
        method=method,
        probability=probability,
        log10_probability=log10_probability,
        std_error=std_error,
        ci_low=interval[0],
        ci_high=interval[1],
        rollouts_simulated=rollouts.count,
        rollouts_in_estimate=rollouts.count,
        failures=rollouts.failures,
        nll_mean=nll_mean,
        nll_log_mean=nll_log_mean,
        ess=figures.ess,
        pareto_k=figures.pareto_k,
        max_weight_share=figures.max_weight_share,
        unbiased_probability=probability,
        unbiased_std_error=std_error,
        diagnostics=diagnostics,
    )
