"""What to measure next: labels for a target, labels for the refits, tracked sequences for tau.

Refits that put log P(missed) in a band a standard deviation s apart know as much of it as a sample
with a misses, where trigamma(a) = s^2 (the variance of the logarithm of a Beta variable whose hits
are many more than its misses). Half the standard deviation takes as many misses as have a quarter
of that variance, and at P(missed) so many labelled obstacles more::

    log mu ~ sum_b e_b log P_b        contribution_b = e_b Cov(log P_b, log mu) / Var(log mu)

with e_b the elasticity: which bands the range comes from.

An interval of log tau from S independent sequences is about t_(S-1) s / sqrt(S) to either side,
with Student's t and a spread s of the sequences that more of them do not change.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import polygamma, stdtrit

from pemviz.analysis.band_models import BandOutcomes
from pemviz.analysis.binomial_plan import MOST_LABELS
from pemviz.analysis.label_plan import LabelPlan, model_misses
from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero, Count
from pemviz.pem import Pem
from pemviz.pem.data.support import DISTANCE_EDGES_M
from pemviz.pem.models.cards import FittedMemory

LEAST_CONTRIBUTION = 0.1
WANTED_FACTOR = 1.2
MOST_SEQUENCES = 10_000_000


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

    Violations are those of models near the answer; refits are at least two.
    """
    own = model_misses(pem, outcomes.salient)
    bands = np.flatnonzero(own > 0.0)
    missed = np.stack([model_misses(member, outcomes.salient) for member in members])[:, bands]
    log_missed = np.log(missed)
    moved = log_missed @ outcomes.slopes(own)[bands]
    centred = moved - moved.mean()
    variance, terms = float(centred @ centred), log_missed * outcomes.slopes(own)[bands]
    contribution = np.zeros(bands.size)
    if variance > 0.0:
        contribution = (terms - terms.mean(axis=0)).T @ centred / variance
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


def labels_to_halve(log_missed: FloatArray) -> int:
    """Labels after which log P(missed) ``[M]`` of the refits would spread half as much."""
    variance = float(np.var(log_missed, ddof=1))
    if variance <= 0.0:
        return 0
    further = misses_for(variance / 4.0) - misses_for(variance)
    return min(math.ceil(further / math.exp(float(np.mean(log_missed)))), MOST_LABELS)


def misses_for(variance: float) -> float:
    """How many misses leave log P(missed) with this variance: trigamma's inverse."""
    from scipy.optimize import brentq  # noqa: PLC0415  slow to import

    def excess(log_misses: float) -> float:
        return math.log(float(np.asarray(polygamma(1, math.exp(log_misses))))) - math.log(variance)

    return math.exp(float(np.asarray(brentq(excess, -20.0, 40.0))))


@dataclass(frozen=True)
class SequencePlan:
    """Tracked sequences for a memory time.

    Attributes:
        example: Whose memory it is.
        is_own: Whether that is the run's error model; otherwise an example of a detector.
        tau_s: Its memory time [s].
        low_s: Lower end of the memory time's interval [s].
        high_s: Upper end [s].
        sequences: Independent sequences that it rests on.
        factor: What the interval is to reach to either side.
        wanted: So many sequences like these would do, those at hand included.
    """

    example: str
    is_own: bool
    tau_s: AtLeastZero
    low_s: AtLeastZero
    high_s: AtLeastZero
    sequences: Count
    factor: AtLeastZero
    wanted: Count


def sequence_plan(fitted: FittedMemory, *, example: str, is_own: bool) -> SequencePlan | None:
    """How many sequences fix the memory time to within WANTED_FACTOR; ``None`` if it may be 0.

    ``example`` names the model whose memory it is, which may be the run's own.
    """
    low_s, high_s = fitted.tau_interval_s
    if low_s <= 0.0 or high_s <= low_s:
        return None
    wanted = sequences_for(
        half_width=0.5 * math.log(high_s / low_s),
        sequences=fitted.sequences,
        wanted=math.log(WANTED_FACTOR),
        confidence=fitted.confidence,
    )
    return SequencePlan(
        example=example,
        is_own=is_own,
        tau_s=fitted.memory.tau_s,
        low_s=low_s,
        high_s=high_s,
        sequences=fitted.sequences,
        factor=WANTED_FACTOR,
        wanted=wanted,
    )


def sequences_for(*, half_width: float, sequences: int, wanted: float, confidence: float) -> int:
    """Fewest sequences whose interval is ``wanted`` wide to either side.

    ``half_width`` is that of ``sequences``, at least two, in the same unit; both intervals have the
    same confidence.
    """

    def width(count: int) -> float:
        return float(stdtrit(count - 1, 0.5 + confidence / 2.0)) / math.sqrt(count)

    scale = half_width / width(sequences)
    fewest, most = 1, 2
    while scale * width(most) > wanted and most < MOST_SEQUENCES:
        fewest, most = most, 2 * most
    while most - fewest > 1:
        middle = (fewest + most) // 2
        fewest, most = (middle, most) if scale * width(middle) > wanted else (fewest, middle)
    return min(most, MOST_SEQUENCES)


@dataclass(frozen=True)
class DataPlan:
    """What evidence would narrow an answer, and how much of it that takes.

    Attributes:
        labels: Labels that would show a target; ``None`` for the ``reason``.
        halves: Whether the target is not one that was given, but lies halfway, in powers of
            ten, from the answer to what the labels at hand allow.
        reason: Why there is no plan for labels; ``None`` where there is one.
        refits: Labels that would halve the range over refits, by band; empty where not known.
        sequences: Tracked sequences that would fix the memory time; ``None`` where not known.
    """

    labels: LabelPlan | None
    halves: bool
    reason: str | None
    refits: tuple[RefitBand, ...]
    sequences: SequencePlan | None
