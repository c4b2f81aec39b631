"""How many labelled obstacles show that a detector misses rarely enough: exact binomial planning.

Clopper and Pearson's one-sided bound for P(missed) after k misses of n obstacles is at most u if
and only if P(at most k misses of n | u) <= 1 - confidence. How likely a detector that misses with
probability p has no more than k is a binomial tail too.
"""

import math
from dataclasses import dataclass

from scipy.special import betaincc, gammaincinv

POWER = 0.9
MOST_LABELS = 10_000_000
"""More than these count as out of reach."""
SLACK = 1e-9
"""Relative rounding error that a bound may have."""


@dataclass(frozen=True)
class LabelsNeeded:
    """A sample of labelled obstacles that would do.

    Attributes:
        labels: How many more obstacles to label.
        most_missed: How many of these the detector may miss.
        power: How likely it misses no more, if its P(missed) is the assumed one.
    """

    labels: int
    most_missed: int
    power: float


def fewest_obstacles(missed: int, *, bound: float, confidence: float) -> int:
    """Fewest n for which ``missed`` misses of n bound P(missed) by ``bound`` at ``confidence``.

    Example:
        >>> from pemviz.analysis.binomial_plan import fewest_obstacles
        >>> fewest_obstacles(0, bound=0.01, confidence=0.95)
        299
        >>> fewest_obstacles(2, bound=0.01, confidence=0.95)
        628
    """
    alpha = 1.0 - confidence
    if bound >= 1.0:
        return missed
    if missed == 0:
        return math.ceil(math.log(alpha) / math.log1p(-bound) * (1.0 - SLACK))

    def shows(obstacles: int) -> bool:
        return _at_most(missed, obstacles, bound) <= alpha * (1.0 + SLACK)

    # Poisson's answer, which is near where the bound is small
    guess = math.ceil(float(gammaincinv(missed + 1.0, confidence)) / bound)
    many, step = max(missed + 1, guess), max(1, guess // 100)
    while not shows(many):
        many, step = many + step, 2 * step
    few, step = many - 1, max(1, guess // 100)
    while few > missed and shows(few):
        few, many, step = max(few - step, missed), few, 2 * step
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if shows(middle) else (middle, many)
    return many


def _at_most(events: int, trials: int, probability: float) -> float:
    """P(at most ``events``, of more ``trials``); keeps its digits where the probability is tiny."""
    return float(betaincc(events + 1.0, trials - events, probability))


def labels_needed(
    *,
    obstacles: int,
    missed: int,
    bound: float,
    assumed: float,
    confidence: float,
    power: float = POWER,
) -> LabelsNeeded | None:
    """The smallest further sample that shows P(missed) <= ``bound``, with ``power``.

    Of ``obstacles`` labelled already ``missed`` are missed; ``bound`` is above 0, ``assumed`` the
    detector's P(missed), as far as one believes to know it.

    Returns:
        ``None`` where even MOST_LABELS would not do: the detector misses too often.

    Example:
        >>> from pemviz.analysis.binomial_plan import labels_needed
        >>> need = labels_needed(obstacles=0, missed=0, bound=0.02, assumed=0.01, confidence=0.95)
        >>> need.labels, need.most_missed, round(need.power, 3)
        (1271, 17, 0.907)
    """
    if assumed >= bound:
        return None

    def sample(further: int) -> LabelsNeeded:
        labels = fewest_obstacles(missed + further, bound=bound, confidence=confidence) - obstacles
        if labels <= further:  # what is labelled already shows it
            return LabelsNeeded(max(labels, 0), max(labels, 0), 1.0)
        return LabelsNeeded(labels, further, _at_most(further, labels, assumed))

    def suffices(found: LabelsNeeded) -> bool:
        return found.power >= power or found.labels > MOST_LABELS

    few, many = -1, 0
    while not suffices(sample(many)):
        few, many = many, 2 * many + 1
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if suffices(sample(middle)) else (middle, many)
    found = sample(many)
    return None if found.labels > MOST_LABELS else found


def labels_if_none_missed(*, obstacles: int, missed: int, bound: float, confidence: float) -> int:
    """The fewest further obstacles that show P(missed) <= ``bound`` if none of them is missed."""
    needed = fewest_obstacles(missed, bound=bound, confidence=confidence)
    return max(needed - obstacles, 0)
