"""Several independent repetitions, summarised as one estimate."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from pemviz.binomial import exact_interval
from pemviz.sampling.estimates.diagnostics import (
    IntervalBasis,
    count_diagnostics,
    repetition_diagnostics,
)
from pemviz.sampling.estimates.estimators import CONFIDENCE, log_normal_interval
from pemviz.sampling.registry import by_name
from pemviz.types import Diagnostic, Estimate


def summarise_repetitions(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of independent repetitions, and how far it may be off by their spread.

    Where that happens to be small, by what each repetition knows of its own error.

    With one repetition this is that repetition's estimate. With several, diagnostics that
    belong to a set of weights are the least favourable among the repetitions.
    """
    if len(estimates) == 1:
        return estimates[0]
    probabilities = np.array([estimate.probability for estimate in estimates])
    count = len(estimates)
    mean = float(np.mean(probabilities))
    error = float(np.std(probabilities, ddof=1)) / math.sqrt(count)
    unbiased, unbiased_error = _unbiased(estimates)
    failures = sum(estimate.failures for estimate in estimates)
    log10_probability = _mean_log10(estimates)
    low, high = _repetition_interval(estimates, mean=mean, error=error)
    return Estimate(
        method=estimates[0].method,
        probability=mean,
        log10_probability=log10_probability,
        std_error=error if failures else None,
        ci_low=low,
        ci_high=high,
        rollouts_simulated=sum(e.rollouts_simulated for e in estimates),
        rollouts_in_estimate=sum(e.rollouts_in_estimate for e in estimates),
        failures=failures,
        nll_mean=_weighted_mean([(e.nll_mean, e.failures) for e in estimates]),
        nll_log_mean=_pooled_nll_log_mean(estimates),
        ess=_extreme(min, [e.ess for e in estimates]),
        pareto_k=_extreme(max, [e.pareto_k for e in estimates]),
        max_weight_share=_extreme(max, [e.max_weight_share for e in estimates]),
        unbiased_probability=unbiased,
        unbiased_std_error=unbiased_error if failures else None,
        diagnostics=_diagnostics(estimates, upper=high, log10_probability=log10_probability),
    )


def _diagnostics(
    estimates: Sequence[Estimate], *, upper: float | None, log10_probability: float | None
) -> tuple[Diagnostic, ...]:
    """Counts are pooled and judged as one; weights and runs are judged repetition by repetition."""
    if upper is None or not _all_rest_on("counts", estimates):
        return repetition_diagnostics(estimates, log10_probability=log10_probability)
    pooled = count_diagnostics(
        failures=sum(estimate.failures for estimate in estimates),
        rollouts=sum(estimate.rollouts_in_estimate for estimate in estimates),
        upper=upper,
        confidence=CONFIDENCE,
    )
    each = repetition_diagnostics(estimates, log10_probability=log10_probability)
    return (*(one for one in each if one.kind == "not-repeatable"), *pooled)


def _all_rest_on(basis: IntervalBasis, estimates: Sequence[Estimate]) -> bool:
    return all(by_name(estimate.method).interval_basis == basis for estimate in estimates)


def _unbiased(estimates: Sequence[Estimate]) -> tuple[float | None, float | None]:
    """Mean of the repetitions' unbiased figures and its standard error; ``None`` without any."""
    unbiased = [e.unbiased_probability for e in estimates if e.unbiased_probability is not None]
    if len(unbiased) < len(estimates):
        return None, None
    return float(np.mean(unbiased)), float(np.std(unbiased, ddof=1)) / math.sqrt(len(unbiased))


def _repetition_interval(
    estimates: Sequence[Estimate], *, mean: float, error: float
) -> tuple[float | None, float | None]:
    if _all_rest_on("counts", estimates):
        count = sum(estimate.rollouts_in_estimate for estimate in estimates)
        failures = sum(estimate.failures for estimate in estimates)
        return exact_interval(failures, count, confidence=CONFIDENCE)
    if mean <= 0.0:
        return None, None
    if _all_rest_on("runs", estimates):
        return _interval_of_mean(estimates, mean=mean)
    return _interval_by_weights(estimates, mean=mean, error=error)


def _interval_by_weights(
    estimates: Sequence[Estimate], *, mean: float, error: float
) -> tuple[float, float]:
    """By the spread between repetitions, but as wide as what each knows of its own error.

    Two that happen to agree tell nothing of how far both are off.
    """
    low, high = log_normal_interval(
        math.log(mean), relative_error=error / mean, degrees_of_freedom=len(estimates) - 1
    )
    own = [estimate.std_error for estimate in estimates]
    known = [each for each in own if each is not None]
    if len(known) < len(own):
        return low, high
    within = math.hypot(*known) / len(own)
    lower, higher = log_normal_interval(math.log(mean), relative_error=within / mean)
    return min(low, lower), max(high, higher)


def _interval_of_mean(
    estimates: Sequence[Estimate], *, mean: float
) -> tuple[float | None, float | None]:
    """From the repetitions' own intervals, if all have one: they know of the runs within them.

    Distances from the estimates are added as standard errors are (Zou, Donner 2008), each side
    for itself.
    """
    known = [
        (estimate.probability, estimate.ci_low, estimate.ci_high)
        for estimate in estimates
        if estimate.ci_low is not None and estimate.ci_high is not None
    ]
    if len(known) < len(estimates):
        return None, None
    below = math.hypot(*(middle - low for middle, low, _ in known)) / len(known)
    above = math.hypot(*(high - middle for middle, _, high in known)) / len(known)
    return max(mean - below, 0.0), min(mean + above, 1.0)


def _mean_log10(estimates: Sequence[Estimate]) -> float | None:
    """log10 of the mean, formed from the logs so that no repetition underflows."""
    logs = [e.log10_probability for e in estimates if e.log10_probability is not None]
    if not logs:
        return None
    largest = max(logs)
    total = sum(10.0 ** (value - largest) for value in logs)
    return largest + math.log10(total / len(estimates))


def _pooled_nll_log_mean(estimates: Sequence[Estimate]) -> float | None:
    """-log of the mean likelihood over the failures of all repetitions."""
    nlls = [(e.nll_log_mean, e.failures) for e in estimates]
    known = [(nll, failures) for nll, failures in nlls if nll is not None and failures]
    if not known:
        return None
    smallest = min(nll for nll, _ in known)
    total = sum(failures * math.exp(smallest - nll) for nll, failures in known)
    return smallest - math.log(total / sum(failures for _, failures in known))


def _weighted_mean(values: Sequence[tuple[float | None, int]]) -> float | None:
    weighted = [(value, weight) for value, weight in values if value is not None]
    total = sum(weight for _, weight in weighted)
    return sum(value * weight for value, weight in weighted) / total if total else None


def _extreme(
    choose: Callable[[Sequence[float]], float], values: Sequence[float | None]
) -> float | None:
    defined = [value for value in values if value is not None]
    return choose(defined) if defined else None
