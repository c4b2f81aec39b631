"""The repetitions of one experiment as one row of a table."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from pemviz.sampling.estimates.repetitions import summarise_repetitions
from pemviz.types import Estimate


@dataclass(frozen=True)
class RowSummary:
    """Several repetitions.

    Attributes:
        repetitions: How many.
        rollouts_in_estimate: Of one repetition.
        violating_share: Mean share of those that violate.
        violating_share_std_error: Standard error of that mean between repetitions; ``None``
            with one repetition.
        median: Median of the estimates, which one large weight cannot move.
        pooled: Mean with the standard error between repetitions; diagnostics are the least
            favourable.
    """

    repetitions: int
    rollouts_in_estimate: int
    violating_share: float
    violating_share_std_error: float | None
    median: float
    pooled: Estimate


def summarise(estimates: Sequence[Estimate]) -> RowSummary:
    """One row of at least one repetition."""
    shares = [one.failures / one.rollouts_in_estimate for one in estimates]
    count = len(estimates)
    return RowSummary(
        repetitions=count,
        rollouts_in_estimate=estimates[0].rollouts_in_estimate,
        violating_share=statistics.fmean(shares),
        violating_share_std_error=(
            statistics.stdev(shares) / math.sqrt(count) if count > 1 else None
        ),
        median=statistics.median(one.probability for one in estimates),
        pooled=summarise_repetitions(estimates),
    )
