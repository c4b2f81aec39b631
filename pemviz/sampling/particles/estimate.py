"""What independent runs of particles say together: estimate, interval, and what is wrong with it.

As levels and particles grow together, the logarithm of an unbiased particle estimate of p tends
to a normal with mean log p - s^2 / 2 and variance s^2 (Berard, Del Moral, Doucet 2014). Most runs
then find too little and a few very much: an interval around the runs' mean by its own standard
error misses p whenever those few are not among them. Here both parts of log p = E log + s^2 / 2
have intervals of their own, which the method of variance estimates recovery puts together
(Zou, Taleban, Huo 2009).
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtri, stdtrit

from pemviz.arrays import AnyArray, FloatArray
from pemviz.binomial import exact_interval
from pemviz.sampling.estimates.diagnostics import count_diagnostics, undermining
from pemviz.sampling.estimates.estimators import CONFIDENCE, negative_log_likelihood
from pemviz.sampling.estimates.importance_weights import log_sum
from pemviz.sampling.kept import EVERY, FIGURES, KeptRepetition, Recounted
from pemviz.sampling.particles.runs import ParticleRun, RunFigures
from pemviz.types import Diagnostic, Estimate


def interval_between_runs(
    log_probability: FloatArray, *, least_variance: float
) -> tuple[float, float]:
    """95 % interval of the probability that R independent runs estimate without bias, R at least 2.

    Their logarithms ``[R]`` are all finite. The variance of one is at least ``least_variance``,
    above 0: the spread of few runs may be smaller by chance.
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


FEW_RUNS = 5
"""Fewer independent runs tell next to nothing of their spread."""
LARGE_SPREAD = 1.0
"""Standard deviation of the logarithms of independent runs [nats]. Above it a log-normal's mean is
more than half a nat above its median: what is added for that outweighs what was seen."""
LARGE_MEAN_ERROR = 0.25
"""Relative standard error of the runs' mean, if they are as log-normal as their spread says. Above
it the mean of few runs is off by more than a factor of 2 too often."""
LARGE_COMMON_ANCESTRY = 0.6
"""Share of pairs of violating particles; two thirds go with a spread of about one nat."""
WIDE_FACTOR = 2.0


def died_out(*, died: int, runs: int) -> Diagnostic:
    """Of independent runs, in some of which all particles died out."""
    text = f"in {died} of {runs} runs no particle reached a violation: ask for more particles"
    return Diagnostic("died-out", float(died), 0.0, text)


def largest_spread(runs: int) -> float:
    """Standard deviation of the logarithms of so many runs up to which their mean is shown [nats].

    A log-normal with standard deviation s of its logarithm has the relative variance exp(s^2) - 1.
    """
    return min(LARGE_SPREAD, math.sqrt(math.log1p(runs * LARGE_MEAN_ERROR**2)))


def spread_diagnostics(
    *, runs: int, spread_nats: float | None, common_ancestry: float
) -> tuple[Diagnostic, ...]:
    """Of independent runs that all reached a violation: why there is no interval.

    ``spread_nats`` is the standard deviation of the logarithms of their estimates, ``None`` for
    one run; ``common_ancestry`` as in :class:`RunFigures`, the mean over runs.
    """
    found: list[Diagnostic] = []
    limit = largest_spread(runs)
    if spread_nats is not None and spread_nats > limit:
        text = (
            "the runs differ too much for an interval (by a factor of "
            f"{math.exp(spread_nats):.2g}, {runs} are reliable up to {math.exp(limit):.2g}): most "
            "such runs find too little; ask for more particles"
        )
        found.append(Diagnostic("runs-differ", spread_nats, limit, text))
    if common_ancestry > LARGE_COMMON_ANCESTRY:
        text = (
            f"{common_ancestry:.0%} of the pairs of violating particles have a common ancestor "
            f"(reliable up to {LARGE_COMMON_ANCESTRY:.0%}): ask for more particles"
        )
        found.append(Diagnostic("few-ancestors", common_ancestry, LARGE_COMMON_ANCESTRY, text))
    if runs < FEW_RUNS:
        text = f"{runs} runs are too few for an interval: ask for at least {FEW_RUNS}"
        found.append(Diagnostic("few-runs", float(runs), float(FEW_RUNS), text))
    return tuple(found)


def width_diagnostics(*, probability: float, low: float, high: float) -> tuple[Diagnostic, ...]:
    """Of an interval between independent runs that reaches far from the estimate."""
    factor = max(high / probability, probability / low)
    if factor <= WIDE_FACTOR:
        return ()
    text = (
        f"the interval reaches a factor of {factor:.1f} from the estimate: it gives only the order "
        "of magnitude"
    )
    return (Diagnostic("wide-interval", factor, WIDE_FACTOR, text),)


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


UNKNOWN = {"simulated": 0, "levels": 1, "least_variance": 1.0, "common_ancestry": 0.0}
"""In place of what all particles of a run share, where none violates, or it was not kept."""
SHARED = tuple(UNKNOWN)


def columns_of(runs: Sequence[ParticleRun]) -> dict[str, AnyArray]:
    """Of each particle ``[N]``: what its run's share, common ancestry by each rule too."""
    values = {name: [getattr(run, name) for run in runs] for name in SHARED}
    for rule in runs[0].rule_ancestry:
        values[f"common_ancestry.{rule}"] = [run.rule_ancestry[rule] for run in runs]
    return {name: np.repeat(each, [run.count for run in runs]) for name, each in values.items()}


def recounted(kept: KeptRepetition) -> Recounted:
    """The mean over the runs; no error where a run's figures were not kept."""
    runs = [_run(kept, stage) for stage in range(len(kept.stages))]
    found = estimate_of_runs(runs, method=kept.method)
    is_whole = all(kept.column(name) is not None for name in SHARED)
    return Recounted(found, EVERY if is_whole else FIGURES)


def _run(kept: KeptRepetition, number: int) -> RunFigures:
    stage, own = kept.stages[number], kept.stage == number
    shared: dict[str, Any] = dict(UNKNOWN)
    for name in SHARED:
        values = kept.column(name)
        if values is not None and own.any():
            shared[name] = values[own][0].item()
    run = RunFigures(
        log_probability=stage.log_probability, count=stage.rollouts, log_p=kept.log_p[own], **shared
    )
    if kept.rule is None or not stage.failures:
        return run
    share = np.count_nonzero(own) / stage.rollouts
    return run.of_share(share, before=stage.failures / stage.rollouts)
