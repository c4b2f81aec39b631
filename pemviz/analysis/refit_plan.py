"""How many labels would halve the range over refits, by how far the refits differ in each band.

Refits that put log P(missed) in a band a standard deviation s apart know as much of it as a sample
with a misses, where trigamma(a) = s^2 (the variance of the logarithm of a Beta variable whose hits
are many more than its misses). Half the standard deviation takes as many misses as have a quarter
of that variance, and at P(missed) so many labelled obstacles more::

    log mu ~ sum_b e_b log P_b        contribution_b = e_b Cov(log P_b, log mu) / Var(log mu)

with e_b the elasticity: which bands the range comes from.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import polygamma

from pemviz.analysis.band_models import BandOutcomes
from pemviz.analysis.label_plan import model_misses
from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero, Count
from pemviz.pem import Pem
from pemviz.pem.data.support import DISTANCE_EDGES_M

LEAST_CONTRIBUTION = 0.1
MOST_LABELS = 10_000_000


@dataclass(frozen=True)
class RefitBand:
    """How far refits differ in one band of distance z.

    Attributes:
        low_m: Lower edge of z [m]; ``None`` behind the camera.
        high_m: Upper edge [m]; ``None`` for the farthest band.
        spread: Largest over smallest P(missed) of the refits.
        contribution: Share of the variance of log(failure probability) over the refits that comes
            from here; shares add up to 1, and may be negative.
        labels: More labelled obstacles after which refits would differ half as much here.
    """

    low_m: float | None
    high_m: float | None
    spread: AtLeastZero
    contribution: float
    labels: Count


def refit_plan(
    outcomes: BandOutcomes, *, pem: Pem, members: Sequence[Pem]
) -> tuple[RefitBand, ...]:
    """Bands that the range over refits comes from, near to far.

    Args:
        outcomes: Violations, of models near the answer.
        pem: The error model of single outcomes.
        members: Its refits, at least two.
    """
    own = model_misses(pem, outcomes.salient)
    bands = np.flatnonzero(own > 0.0)
    missed = np.stack([model_misses(member, outcomes.salient) for member in members])[:, bands]
    log_missed = np.log(missed)
    moved = log_missed @ outcomes.slopes(own)[bands]
    contribution = _contributions(log_missed * outcomes.slopes(own)[bands], moved)
    edges = (None, *DISTANCE_EDGES_M, None)
    return tuple(
        RefitBand(
            low_m=edges[band],
            high_m=edges[band + 1],
            spread=float(missed[:, place].max() / missed[:, place].min()),
            contribution=float(contribution[place]),
            labels=labels_to_halve(log_missed[:, place]),
        )
        for place, band in enumerate(bands.tolist())
        if contribution[place] >= LEAST_CONTRIBUTION
    )


def _contributions(terms: FloatArray, total: FloatArray) -> FloatArray:
    """Share of the variance of ``total [M]`` that each of its terms ``[M, B]`` brings, ``[B]``."""
    centred = total - total.mean()
    variance = float(centred @ centred)
    if variance <= 0.0:
        return np.zeros(terms.shape[1])
    return (terms - terms.mean(axis=0)).T @ centred / variance


def labels_to_halve(log_missed: FloatArray) -> int:
    """Labels after which log P(missed) ``[M]`` of the refits would spread half as much."""
    variance = float(np.var(log_missed, ddof=1))
    if variance <= 0.0:
        return 0
    further = misses_worth(variance / 4.0) - misses_worth(variance)
    return min(math.ceil(further / math.exp(float(np.mean(log_missed)))), MOST_LABELS)


def misses_worth(variance: float) -> float:
    """How many misses leave log P(missed) with this variance: trigamma's inverse."""

    def excess(log_misses: float) -> float:
        return math.log(float(np.asarray(polygamma(1, math.exp(log_misses))))) - math.log(variance)

    return math.exp(float(np.asarray(brentq(excess, -20.0, 40.0))))
