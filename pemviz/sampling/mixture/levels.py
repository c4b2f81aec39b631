"""Down to which level of robustness the rollouts drawn so far can be trusted, and the elites."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.sampling.elite_threshold import VIOLATION_THRESHOLD

LARGEST_SHARE = 0.5
"""Of the probability under the error model that elites have between them."""


@dataclass(frozen=True)
class Elites:
    """The rollouts that a proposal learns from.

    Attributes:
        threshold: They violate, or their robustness is at most this level.
        chosen: Which of the pool's, ``[N]``.
    """

    threshold: float
    chosen: BoolArray

    @property
    def count(self) -> int:
        """How many."""
        return int(self.chosen.sum())


def failing_elites(robustness: FloatArray, violated: BoolArray, *, least: int) -> Elites:
    """The violating rollouts; with too few of them the least robust others as well.

    Args:
        robustness: ``[N]``.
        violated: ``[N]``.
        least: So many elites at least, or a third of all.
    """
    least = min(least, max(1, violated.size // 3))
    if int(violated.sum()) >= least:
        return Elites(VIOLATION_THRESHOLD, violated)
    level = float(np.partition(robustness, least - 1)[least - 1])
    level = max(level, VIOLATION_THRESHOLD)
    return Elites(level, violated | (robustness <= level))


def guided_elites(
    robustness: FloatArray, violated: BoolArray, log_weight: FloatArray, *, least_ess: float
) -> Elites:
    """Rollouts down to the lowest level of robustness that the weights tell the probability of.

    The effective sample size of what lies at or below the level, and at or below any higher one,
    is ``least_ess`` at least. What fails in an improbable way, far below what is known well, does
    not draw the level down to 0.

    Args:
        robustness: ``[N]``.
        violated: ``[N]``.
        log_weight: Exponents included, ``[N]``.
        least_ess: Least effective sample size of the elites.
    """
    score = np.where(violated, np.minimum(robustness, VIOLATION_THRESHOLD), robustness)
    order = np.argsort(score, kind="stable")
    relative = np.exp(log_weight[order] - np.max(log_weight))
    total, squares = np.cumsum(relative), np.cumsum(relative**2)
    enough = np.square(total) >= least_ess * squares
    # ties count together: only the last of equal scores tells the level's effective sample size
    ordered = score[order]
    last = np.append(ordered[1:] > ordered[:-1], True)
    short = np.flatnonzero(last & ~enough & (ordered >= VIOLATION_THRESHOLD))
    above = ordered[min(short[-1] + 1, ordered.size - 1)] if short.size else VIOLATION_THRESHOLD
    level = max(float(above), VIOLATION_THRESHOLD)
    # where most rollouts share one score, the level lies below it
    few = ordered[last & (total <= LARGEST_SHARE * total[-1])]
    if few.size and level > few[-1]:
        level = max(float(few[-1]), VIOLATION_THRESHOLD)
    return Elites(level, score <= level)
