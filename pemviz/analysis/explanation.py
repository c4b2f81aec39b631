"""Why the violations of a run happen, and what a better detector would change."""

import math
from dataclasses import dataclass

from pemviz.analysis.bursts import Bursts, bursts_of
from pemviz.analysis.causes import (
    BandMisses,
    Chain,
    Failures,
    failures_of,
    likeliest_chains,
    miss_probability_by_step,
    misses_by_distance,
)
from pemviz.analysis.outcome_likelihood import RememberedOutcomes
from pemviz.analysis.sensitivity import (
    BandSensitivity,
    MemorySensitivity,
    band_sensitivities,
    memory_sensitivity,
)
from pemviz.config.ranges import Count, Share
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.memory import single_outcome_features
from pemviz.types import StageResult

BAND_WIDTH_M = 2.0


@dataclass(frozen=True)
class Explanation:
    """From the weighted violations of one repetition's final rollouts.

    Attributes:
        repetition: Which repetition.
        stage: The stage that the rollouts are of; ``None`` in results that do not tell.
        misses_by_distance: Average misses in bands of the gap [m].
        miss_probability_by_step: Given a violation, by step.
        chains: Chains of misses that carry most of the probability.
        sensitivity: For all distances together, then by band.
        memory: Sensitivity to the memory time; ``None`` where misses are independent, and in
            results of versions that did not tell it.
        bursts: Bursts of misses; ``None`` where no miss matters, and in such results.
    """

    repetition: Count
    misses_by_distance: tuple[BandMisses, ...]
    miss_probability_by_step: tuple[Share, ...]
    chains: tuple[Chain, ...]
    sensitivity: tuple[BandSensitivity, ...]
    memory: MemorySensitivity | None = None
    bursts: Bursts | None = None
    stage: Count | None = None


def explain(
    stage: StageResult,
    *,
    features: StateFeatures,
    farthest_m: float | None,
    target: float | None,
    dt_s: float,
    tau_s: float = 0.0,
) -> Explanation | None:
    """Explain a final stage; ``None`` if nothing failed in it.

    Args:
        stage: Rollouts with importance weights.
        features: Says at which states perception's outcome may matter.
        farthest_m: Bands of two metres of the gap reach from 0 m to at least here; ``None``
            where the scenario has no gap, and nothing is told by bands.
        target: Failure probability that the detector is to be improved for.
        dt_s: Time between two frames [s].
        tau_s: Memory time of misses [s]; 0: they are independent given the state.
    """
    failures = failures_of(stage.scored, features=features)
    if failures is None or stage.log10_probability is None:
        return None
    count = 0 if farthest_m is None else math.ceil(farthest_m / BAND_WIDTH_M)
    edges = [BAND_WIDTH_M * band for band in range(count + 1)]
    log_probability = stage.log10_probability * math.log(10.0)
    remembered = None
    if tau_s > 0.0:
        remembered = RememberedOutcomes.of(failures.rollouts, tau_s=tau_s, dt_s=dt_s)
    return Explanation(
        repetition=stage.repetition,
        stage=stage.stage,
        misses_by_distance=misses_by_distance(failures, edges=edges),
        miss_probability_by_step=tuple(miss_probability_by_step(failures).tolist()),
        chains=likeliest_chains(failures),
        sensitivity=band_sensitivities(
            failures,
            log_probability=log_probability,
            edges=edges,
            target=target,
            likelihood=remembered,
        ),
        memory=None
        if remembered is None
        else memory_sensitivity(
            failures, remembered, log_probability=log_probability, target=target
        ),
        bursts=_bursts(failures, features=features, farthest_m=farthest_m, dt_s=dt_s),
    )


def _bursts(
    failures: Failures, *, features: StateFeatures, farthest_m: float | None, dt_s: float
) -> Bursts | None:
    """Bursts by where the scenario itself reacts, not by what is remembered as well."""
    mattering = single_outcome_features(features).reacts(failures.rollouts.decision_states())
    return bursts_of(
        failures, mattering=mattering, dt_s=dt_s, gap=None if farthest_m is None else "gap"
    )
