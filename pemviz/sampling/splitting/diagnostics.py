"""What is wrong with independent runs of splitting, with limits and words."""

import math

from pemviz.types import Diagnostic

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
    """Of independent runs of splitting, in some of which all particles died out."""
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
    """Of independent runs of splitting that all reached a violation: why there is no interval.

    Args:
        runs: How many.
        spread_nats: Standard deviation of the logarithms of their estimates; ``None`` for one.
        common_ancestry: Of two violating particles of a run, how often both descend from one
            particle at its start; the mean over runs.
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
        text = f"{runs} runs of splitting are too few for an interval: ask for at least {FEW_RUNS}"
        found.append(Diagnostic("few-runs", float(runs), float(FEW_RUNS), text))
    return tuple(found)


def width_diagnostics(*, probability: float, low: float, high: float) -> tuple[Diagnostic, ...]:
    """Of an interval between independent runs that reaches far from the estimate."""
    factor = max(high / probability, probability / low)
    if factor <= WIDE_FACTOR:
        return ()
    text = (
        f"the interval reaches a factor of {factor:.1f} from the estimate: it tells only the order "
        "of magnitude"
    )
    return (Diagnostic("wide-interval", factor, WIDE_FACTOR, text),)
