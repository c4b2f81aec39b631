"""What tells whether an estimate can be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.sampling.estimates.importance_weights import (
    effective_sample_size,
    largest_share,
    log_sum,
)
from pemviz.types import Estimate

MINIMUM_TAIL = 5
RELIABLE_PARETO_K = 0.7
LARGE_SHARE = 0.2
SMALL_ESS = 10.0


@dataclass(frozen=True)
class WeightDiagnostics:
    """Diagnostics of the failing rollouts' weights; ``None`` where undefined."""

    ess: float | None
    pareto_k: float | None
    max_weight_share: float | None


def diagnose(failing_log_weight: FloatArray) -> WeightDiagnostics:
    """Diagnose the log weights ``[M]`` of the failing rollouts; M may be 0."""
    if failing_log_weight.size == 0:
        return WeightDiagnostics(ess=None, pareto_k=None, max_weight_share=None)
    return WeightDiagnostics(
        ess=effective_sample_size(failing_log_weight),
        pareto_k=pareto_k_hat(failing_log_weight),
        max_weight_share=largest_share(failing_log_weight),
    )


def pareto_k_hat(log_weight: FloatArray) -> float | None:
    """Shape of the generalised Pareto fitted to the largest weights of ``[M]``.

    Pareto smoothed importance sampling (Vehtari, Simpson, Gelman, Yao, Gabry 2024), by
    arviz-stats. Above 0.7 an average of the weights is not to be trusted. ``None`` where
    the tail has fewer than five weights, no spread, or more spread than doubles hold.
    """
    tail = int(min(log_weight.size // 5, np.ceil(3 * np.sqrt(log_weight.size))))
    if tail < MINIMUM_TAIL or np.ptp(np.sort(log_weight)[-tail:]) == 0.0:
        return None
    from arviz_stats.base.array import array_stats  # noqa: PLC0415  slow to import

    # weights that span more than double precision break the fit: no figure, no warning
    with np.errstate(all="ignore"):
        # psislw takes log likelihoods, whose negatives are its log weights
        try:
            _, k_hat = array_stats.psislw(-log_weight)
        except ValueError:  # it finds no spread in a tail that it cuts off elsewhere
            return None
    value = float(np.asarray(k_hat))
    return value if np.isfinite(value) else None


def negative_log_likelihood(log_p: FloatArray) -> tuple[float | None, float | None]:
    """NLL of failing rollouts with log likelihoods ``[M]`` under the error model [nats].

    Returns:
        The mean of the negative log likelihoods, and the negative log of the mean
        likelihood: the paper states the first, its code computes the second.
    """
    if log_p.size == 0:
        return None, None
    return float(-np.mean(log_p)), float(np.log(log_p.size)) - log_sum(log_p)


def weight_warnings(diagnostics: WeightDiagnostics, *, failures: int) -> Sequence[str]:
    """Warnings in words about an importance sampling estimate with at least one failure."""
    warnings: list[str] = []
    share, ess, k_hat = diagnostics.max_weight_share, diagnostics.ess, diagnostics.pareto_k
    if share is not None and share > LARGE_SHARE:
        warnings.append(f"one rollout carries {share:.0%} of the weight: do not quote this number")
    if ess is not None and ess < SMALL_ESS:
        warnings.append(
            f"a few weights carry the estimate: the {failures} failures count as {ess:.1f} "
            f"(effective sample size)"
        )
    if k_hat is not None and k_hat > RELIABLE_PARETO_K:
        warnings.append(
            f"the weights' tail is too heavy (Pareto k-hat {k_hat:.2f}, reliable up to "
            f"{RELIABLE_PARETO_K}): the true value may lie outside the interval"
        )
    return warnings


def unreliable_because(estimate: Estimate) -> Sequence[str]:
    """Why an estimate must not decide anything; empty if nothing speaks against it."""
    if estimate.method == "monte-carlo":
        return ()
    reasons: list[str] = []
    if estimate.failures == 0:
        reasons.append("no failure was seen")
    if (estimate.max_weight_share or 0.0) > LARGE_SHARE:
        reasons.append(f"one rollout carries {estimate.max_weight_share:.0%} of the weight")
    if estimate.ess is not None and estimate.ess < SMALL_ESS:
        reasons.append(f"the effective sample size is {estimate.ess:.1f}")
    if (estimate.pareto_k or 0.0) > RELIABLE_PARETO_K:
        reasons.append(f"Pareto k-hat is {estimate.pareto_k:.2f}")
    return reasons
