"""Which P(missed) in each band of distance meets a target at the least cost in labels.

To show P(missed) <= u_b in band b costs L_b(u_b) further labelled obstacles. The cheapest
requirement is::

    minimise  sum_b L_b(u_b)   subject to   log mu(u) <= log target

With u_b in place of log u_b this is close to a geometric program (Boyd, Kim, Vandenberghe,
Hassibi 2007): the failure probability is a sum of products of powers, the costs fall about as
1 / u_b. It is solved in log u_b, from the one factor on all bands that meets the target.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize

from pemviz.analysis.band_models import BandOutcomes
from pemviz.analysis.binomial_plan import MOST_LABELS, labels_if_none_missed, labels_needed
from pemviz.arrays import FloatArray, IntArray

GRID = 60
SMALLEST = 1e-6
LARGEST = 1.0
NEAREST = 1.02
"""A requirement is at least so many times what the detector is believed to do."""
SLACK = 1e-6
"""By how much the log failure probability may miss the target."""


@dataclass(frozen=True)
class LabelledBand:
    """What is known of a band of distance.

    Attributes:
        band: Its index.
        obstacles: Labelled obstacles in it.
        missed: The missed ones.
        assumed: The detector's P(missed) there, as the error model has it.
    """

    band: int
    obstacles: int
    missed: int
    assumed: float


def cheapest_requirement(
    outcomes: BandOutcomes,
    *,
    bands: Sequence[LabelledBand],
    log_target: float,
    confidence: float,
    power: float,
) -> FloatArray | None:
    """P(missed) ``[B]`` that meets the target with the fewest labels; 0 in bands left out.

    If the detector as assumed does not meet the target, the cheapest requirement is the one that
    takes the fewest labels of which none is missed: it has to become better first.

    Args:
        outcomes: Violations drawn for models near the answer.
        bands: Those whose outcomes may matter.
        log_target: Log of the failure probability to stay below [nats].
        confidence: Of each band's bound.
        power: How likely each band's sample must suffice, if the detector is as assumed.

    Returns:
        ``None`` where even P(missed) of SMALLEST everywhere does not meet it.
    """
    assumed = np.array([band.assumed for band in bands])
    ways = ((NEAREST * assumed, power), (np.full(len(bands), SMALLEST), None))
    for lowest, chance in ways:
        allocation = _Allocation(
            outcomes=outcomes,
            index=np.array([band.band for band in bands]),
            lowest=np.log(np.clip(lowest, SMALLEST, LARGEST)),
            costs=tuple(_cost(band, confidence, chance) for band in bands),
            log_target=log_target,
        )
        found = allocation.cheapest()
        if found is not None:
            return allocation.everywhere(found)
    return None


@dataclass(frozen=True)
class _Allocation:
    outcomes: BandOutcomes
    index: IntArray
    lowest: FloatArray
    costs: tuple[Callable[[float], float], ...]
    log_target: float

    def everywhere(self, log_miss: FloatArray) -> FloatArray:
        miss = np.zeros(self.outcomes.misses.shape[1])
        miss[self.index] = np.exp(log_miss)
        return miss

    def excess(self, log_miss: FloatArray) -> float:
        """Log failure probability over the target; at most 0 is wanted."""
        return self.outcomes.log_probability(self.everywhere(log_miss)) - self.log_target

    def log_cost(self, log_miss: FloatArray) -> float:
        each = (cost(value) for cost, value in zip(self.costs, log_miss.tolist(), strict=True))
        return math.log1p(sum(each))

    def cheapest(self) -> FloatArray | None:
        """The best ``log_miss``; ``None`` where the lowest does not meet the target."""
        highest = math.log(LARGEST)
        if self.excess(self.lowest) > 0.0:
            return None
        every = np.full(self.lowest.size, highest)
        if self.excess(every) <= 0.0:
            return every

        start = best = self._meeting(self.lowest, every)
        for first in (start, *self._relieved(start)):
            found = self._improved(first)
            if self.log_cost(found) < self.log_cost(best):
                best = found
        return best

    def _relieved(self, start: FloatArray) -> list[FloatArray]:
        """Starts that ask nothing of one band, where the others can make up for it."""
        starts: list[FloatArray] = []
        for band in range(start.size):
            low, high = self.lowest.copy(), start.copy()
            low[band] = high[band] = math.log(LARGEST)
            if self.excess(low) < 0.0 < self.excess(high):
                starts.append(self._meeting(low, high))
        return starts

    def _meeting(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """Where the line from ``low``, which meets the target, to ``high`` no longer does."""

        def excess(share: float) -> float:
            return self.excess(low + share * (high - low))

        share = float(np.asarray(brentq(excess, 0.0, 1.0, xtol=1e-9)))
        return low + share * (high - low)

    def _improved(self, start: FloatArray) -> FloatArray:
        """A cheaper requirement near ``start`` that still meets the target, or ``start``."""

        def spare(log_miss: FloatArray) -> float:
            return -self.excess(log_miss)

        found = minimize(
            self.log_cost,
            start,
            method="SLSQP",
            bounds=[(low, math.log(LARGEST)) for low in self.lowest],
            constraints={"type": "ineq", "fun": spare},
            options={"maxiter": 100, "ftol": 1e-6},
        )
        end = np.clip(np.asarray(found.x), self.lowest, math.log(LARGEST))
        return end if np.isfinite(end).all() and self.excess(end) <= SLACK else start


def _cost(band: LabelledBand, confidence: float, power: float | None) -> Callable[[float], float]:
    """Labels by log of what is to be shown, between exact figures on a grid.

    Args:
        band: What is known.
        confidence: Of the bound.
        power: How likely the sample suffices if the detector is as assumed; ``None``: it is to
            suffice if none of it is missed.
    """
    lowest = SMALLEST if power is None else max(NEAREST * band.assumed, SMALLEST)
    places = np.linspace(min(math.log(lowest), -1e-6), math.log(LARGEST), GRID)
    labels = [_labels(band, math.exp(place), confidence, power) for place in places.tolist()]

    def cost(log_miss: float) -> float:
        return float(np.interp(log_miss, places, labels))

    return cost


def _labels(band: LabelledBand, bound: float, confidence: float, power: float | None) -> float:
    known: Mapping[str, int] = {"obstacles": band.obstacles, "missed": band.missed}
    if power is None:
        return float(labels_if_none_missed(**known, bound=bound, confidence=confidence))
    found = labels_needed(
        **known, bound=bound, assumed=band.assumed, confidence=confidence, power=power
    )
    return float(MOST_LABELS if found is None else found.labels)
