"""Why the violations of a run happen, and what a better detector would change."""

import math
from dataclasses import dataclass

from pemviz.analysis.causes import (
    BandMisses,
    Chain,
    failures_of,
    likeliest_chains,
    miss_probability_by_step,
    misses_by_distance,
)
from pemviz.analysis.sensitivity import BandSensitivity, band_sensitivities
from pemviz.config.ranges import Count, Share
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.types import StageResult

BAND_WIDTH_M = 2.0


@dataclass(frozen=True)
class Explanation:
    """From the weighted violations of one repetition's final rollouts.

    Attributes:
        repetition: Which repetition.
        misses_by_distance: Average misses in bands of the gap [m].
        miss_probability_by_step: Given a violation, by step.
        chains: Chains of misses that carry most of the probability.
        sensitivity: For all distances together, then by band.
    """

    repetition: Count
    misses_by_distance: tuple[BandMisses, ...]
    miss_probability_by_step: tuple[Share, ...]
    chains: tuple[Chain, ...]
    sensitivity: tuple[BandSensitivity, ...]


def explain(
    stage: StageResult, *, features: StateFeatures, farthest_m: float | None, target: float | None
) -> Explanation | None:
    """Explain a final stage; ``None`` if nothing failed in it.

    Args:
        stage: Rollouts with importance weights.
        features: Says at which states perception's outcome may matter.
        farthest_m: Bands of two metres of the gap reach from 0 m to at least here; ``None``
            where the scenario has no gap, and nothing is told by bands.
        target: Failure probability that the detector is to be improved for.
    """
    failures = failures_of(stage.scored, features=features)
    if failures is None or stage.log10_probability is None:
        return None
    count = 0 if farthest_m is None else math.ceil(farthest_m / BAND_WIDTH_M)
    edges = [BAND_WIDTH_M * band for band in range(count + 1)]
    return Explanation(
        repetition=stage.repetition,
        misses_by_distance=misses_by_distance(failures, edges=edges),
        miss_probability_by_step=tuple(miss_probability_by_step(failures).tolist()),
        chains=likeliest_chains(failures),
        sensitivity=band_sensitivities(
            failures,
            log_probability=stage.log10_probability * math.log(10.0),
            edges=edges,
            target=target,
        ),
    )
