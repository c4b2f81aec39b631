"""What independent runs of splitting say together."""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.binomial import exact_interval
from pemviz.sampling.estimates.diagnostics import count_diagnostics, undermining
from pemviz.sampling.estimates.estimate import CONFIDENCE, negative_log_likelihood
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.splitting.diagnostics import (
    died_out,
    spread_diagnostics,
    width_diagnostics,
)
from pemviz.sampling.splitting.interval import interval_between_runs
from pemviz.sampling.splitting.run import RunFigures
from pemviz.types import Diagnostic, Estimate

Error = tuple[float | None, float | None, float | None]
"""Standard error, lower and upper end of the interval."""
WITHHELD: Error = (None, None, None)


def estimate_of_runs(runs: Sequence[RunFigures], *, method: str) -> Estimate:
    """The mean of at least one run; standard error and interval where the runs bear them out.

    Where particles died out in a run, where there are few runs, where they differ too much or
    descend from too few ancestors, what the runs show of their own error is not to be trusted:
    error and interval are withheld, and diagnostics say why.
    """
    logs = np.array([run.log_probability for run in runs])
    log_mean = log_sum(logs) - math.log(logs.size) if np.isfinite(logs).any() else -math.inf
    probability = math.exp(log_mean)
    (std_error, low, high), diagnostics = _error(runs, logs, probability=probability)
    log_p = np.concatenate([run.log_p for run in runs])
    nll_mean, nll_log_mean = negative_log_likelihood(log_p)
    return Estimate(
        method=method,
        probability=probability,
        log10_probability=log_mean / math.log(10.0) if log_mean > -math.inf else None,
        std_error=std_error,
        ci_low=low,
        ci_high=high,
        rollouts_simulated=sum(run.simulated for run in runs),
        rollouts_in_estimate=sum(run.count for run in runs),
        failures=int(log_p.size),
        nll_mean=nll_mean,
        nll_log_mean=nll_log_mean,
        ess=None,
        pareto_k=None,
        max_weight_share=None,
        unbiased_probability=probability,
        unbiased_std_error=std_error,
        diagnostics=diagnostics,
    )


def _error(
    runs: Sequence[RunFigures], logs: FloatArray, *, probability: float
) -> tuple[Error, tuple[Diagnostic, ...]]:
    died = int(np.isneginf(logs).sum())
    if died:
        return WITHHELD, (died_out(died=died, runs=len(runs)),)
    if all(run.levels == 0 for run in runs):
        return _of_count(runs)
    against = spread_diagnostics(
        runs=len(runs),
        spread_nats=float(np.std(logs, ddof=1)) if logs.size > 1 else None,
        common_ancestry=float(np.mean([run.common_ancestry for run in runs])),
    )
    if undermining(against, basis="runs"):
        return WITHHELD, against
    least = float(np.mean([run.least_variance for run in runs]))
    low, high = interval_between_runs(logs, least_variance=least)
    std_error = float(np.std(np.exp(logs), ddof=1)) / math.sqrt(logs.size)
    width = width_diagnostics(probability=probability, low=low, high=high)
    return (std_error, low, high), (*against, *width)


def _of_count(runs: Sequence[RunFigures]) -> tuple[Error, tuple[Diagnostic, ...]]:
    """Nothing was cut: the runs are plain Monte Carlo (Clopper and Pearson 1934)."""
    count, failures = sum(run.count for run in runs), sum(run.log_p.size for run in runs)
    share = failures / count
    low, high = exact_interval(failures, count, confidence=CONFIDENCE)
    std_error = math.sqrt(share * (1.0 - share) / count)
    found = count_diagnostics(failures=failures, rollouts=count, upper=high, confidence=CONFIDENCE)
    return (std_error, low, high), found
