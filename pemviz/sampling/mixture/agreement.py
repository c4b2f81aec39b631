"""Do parts of the rollouts that should tell the same tell the same?

An average of weights has no way to know of a failure mode that its proposals do not draw. What
shows it, if anything does, is that parts of the rollouts disagree: those before the final batch
and the final batch; one half and the other; what fitted proposals draw and what pilots draw.
"""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.sampling.estimates.diagnostics import parts_disagreement, pilots_alone
from pemviz.sampling.estimates.estimate import log_stratified_error
from pemviz.sampling.estimates.importance_weights import log_mean_failing_weight, log_sum
from pemviz.sampling.mixture.balance_heuristic import Judged, Pool
from pemviz.types import Diagnostic

PARTS_ADAPTATION = math.sqrt(2.0)
"""Factor on the standard error of a part, which strata of few rollouts tell too small."""

LogEstimate = tuple[float, float]
"""Log of an estimate and of its standard error."""


def disagreements(pool: Pool, *, final: slice) -> Sequence[Diagnostic]:
    """Of a pool whose last rollouts, ``final`` of all, are the final batch."""
    judged = pool.judged
    late = [_among_itself(pool, judged, part) for part in (slice(0, final.start), final)]
    odd = np.arange(pool.drawn) % 2 == 1
    halves = [
        _of(judged.log_weight[half], judged.violated[half], judged.component[half])
        for half in (odd, ~odd)
    ]
    return (
        *parts_disagreement(late=_errors_apart(*late), halves=_errors_apart(*halves)),
        *pilots_alone(_share_of_pilots(pool)),
    )


def _among_itself(pool: Pool, judged: Judged, part: slice) -> LogEstimate:
    return _of(pool.weights_among(part), judged.violated[part], judged.component[part])


def _of(log_weight: FloatArray, violated: BoolArray, component: IntArray) -> LogEstimate:
    return (
        log_mean_failing_weight(log_weight, violated),
        log_stratified_error(log_weight, violated, component),
    )


def _errors_apart(first: LogEstimate, second: LogEstimate) -> float:
    """Distance of two estimates in joint standard errors; 0 where neither saw a failure."""
    largest = max(first[0], second[0])
    if not np.isfinite(largest):
        return 0.0
    (one, error), (other, other_error) = np.exp(np.array([first, second]) - largest)
    joint = PARTS_ADAPTATION * float(np.hypot(error, other_error))
    return abs(float(one - other)) / joint if joint > 0.0 else 0.0


def _share_of_pilots(pool: Pool) -> float:
    """Of the estimate, from failures for which pilots were most of what could draw them."""
    if not pool.violated.any():
        return 0.0
    log_weight, alone = pool.log_weight[pool.violated], pool.by_pilots
    return float(np.exp(log_sum(log_weight[alone]) - log_sum(log_weight))) if alone.any() else 0.0
