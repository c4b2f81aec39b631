"""Why the violations of a run happen, and what a better detector would change.

Of a scenario with several slots violations come as methods know them, with an outcome a step; here
they are in the scenario's own steps, with names of slots. An error is a miss of an obstacle, or a
report of a ghost.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pemviz.analysis import causes, sensitivity
from pemviz.analysis import outcome_likelihood as outcomes
from pemviz.analysis.causes import BandMisses, Bursts, Chain, Failures
from pemviz.analysis.sensitivity import BandSensitivity, MemorySensitivity
from pemviz.arrays import FloatArray
from pemviz.config.ranges import AtLeastZero, Count, Share
from pemviz.proposals.offset_logistic import StateFeatures
from pemviz.sampling.folding import Folding
from pemviz.sampling.state.composed import ComposedSimulator, own_features, property_in
from pemviz.sampling.state.visibility import Visibility
from pemviz.simulators.detector_loop import DETECTOR_ITSELF
from pemviz.types import StageResult

BAND_WIDTH_M = 2.0


@dataclass(frozen=True)
class SlotErrors:
    """Errors of one slot, over violations weighted by how likely each is.

    Attributes:
        name: Of the slot.
        nominal: Its harmless outcome: True for an obstacle, False for a ghost.
        errors: How many a violation has on average.
        share: Share of all slots' errors.
        probability_by_step: Of an error that may matter, given a violation.
        elasticity: d log(failure probability) / d log(P(error)): ten per cent fewer errors here
            bring about ``elasticity`` times ten per cent fewer violations. ``None`` as in
            :class:`pemviz.analysis.sensitivity.BandSensitivity`.
        std_error: Of the elasticity; ``None`` likewise.
    """

    name: str
    nominal: bool
    errors: AtLeastZero
    share: Share
    probability_by_step: tuple[Share, ...]
    elasticity: float | None
    std_error: AtLeastZero | None


def slot_errors(
    failures: Failures, *, folding: Folding, likelihood: outcomes.OutcomeLikelihood
) -> tuple[SlotErrors, ...]:
    """Errors by slot of weighted violations as methods know them."""
    by_step = np.clip(failures.share @ np.ascontiguousarray(failures.missed), 0.0, 1.0)
    by_slot = by_step.reshape(-1, folding.turns).T
    every = float(by_slot.sum())
    slope = likelihood.slope()
    rows: list[SlotErrors] = []
    for number, slot in enumerate(folding.simulator.slots):
        inside = np.zeros_like(failures.deciding)
        inside[:, number :: folding.turns] = failures.deciding[:, number :: folding.turns]
        elasticity, error = sensitivity.mean_sum(failures, slope, inside)
        errors = float(by_slot[number].sum())
        rows.append(
            SlotErrors(
                name=slot.name,
                nominal=slot.nominal,
                errors=errors,
                share=errors / every if every > 0.0 else 0.0,
                probability_by_step=tuple(by_slot[number].tolist()),
                elasticity=elasticity,
                std_error=error,
            )
        )
    return tuple(rows)


def any_error_by_step(failures: Failures, *, folding: Folding) -> FloatArray:
    """Probability that some slot errs where it may matter, given a violation, ``[T-1]``."""
    steps = failures.deciding.shape[1] // folding.turns
    some = np.ascontiguousarray(failures.missed).reshape(-1, steps, folding.turns)
    return np.clip(failures.share @ some.any(axis=2), 0.0, 1.0)


def in_steps(chain: Chain, *, folding: Folding) -> Chain:
    """A chain of unrolled steps in the scenario's own, with the slot of each error."""
    steps = [divmod(step, folding.turns) for step in chain.missed_steps]
    slots = folding.simulator.slots
    return replace(
        chain,
        missed_steps=tuple(step for step, _ in steps),
        slots=tuple(slots[slot].name for _, slot in steps),
    )


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
        slots: Errors by slot, where there are several; what is said of misses above is said of
            the errors of all slots.
    """

    repetition: Count
    misses_by_distance: tuple[BandMisses, ...]
    miss_probability_by_step: tuple[Share, ...]
    chains: tuple[Chain, ...]
    sensitivity: tuple[BandSensitivity, ...]
    memory: MemorySensitivity | None = None
    bursts: Bursts | None = None
    stage: Count | None = None
    slots: tuple[SlotErrors, ...] = ()


def explain(
    stage: StageResult,
    *,
    features: StateFeatures,
    farthest_m: float | None,
    target: float | None,
    dt_s: float,
    tau_s: float = 0.0,
    folding: Folding | None = None,
    system: ComposedSimulator | None = None,
) -> Explanation | None:
    """Explain a final stage; ``None`` if nothing failed in it.

    Args:
        stage: Rollouts with importance weights.
        features: Says at which states perception's outcome may matter.
        farthest_m: Bands of two metres of the gap reach from 0 m to at least here; ``None``
            where the scenario has no gap, and nothing is shown by bands.
        target: Failure probability that the detector is to be improved for.
        dt_s: Time between two frames [s].
        tau_s: Memory time of misses [s]; 0: they are independent given the state.
        folding: To the scenario's own steps, where it has slots.
        system: The scenario with its hidden properties, if it has any.
    """
    failures = causes.failures_of(stage.scored, features=features)
    if failures is None or stage.log10_probability is None:
        return None
    rollouts = failures.rollouts
    bands = 0 if farthest_m is None else math.ceil(farthest_m / BAND_WIDTH_M)
    edges = [BAND_WIDTH_M * band for band in range(bands + 1)]
    log_mu = stage.log10_probability * math.log(10.0)
    properties = () if system is None else system.components
    visibility = property_in(properties, Visibility)
    remembered: outcomes.MemoryLikelihood | None = None
    if system is not None and visibility is not None:
        remembered = outcomes.FrailOutcomes.of(rollouts, system=system, visibility=visibility)
    elif tau_s > 0.0:
        remembered = outcomes.RememberedOutcomes.of(rollouts, tau_s=tau_s, dt_s=dt_s)
    labels = [one.label for one in properties if one.label]
    labels += [DETECTOR_ITSELF] if causes.observed(failures) else []
    memory = None
    if remembered is not None and remembered.tau_s > 0.0:
        memory = sensitivity.memory_sensitivity(
            failures, remembered, log_probability=log_mu, target=target
        )
    turns = 1 if folding is None else folding.turns
    explanation = Explanation(
        repetition=stage.repetition,
        stage=stage.stage,
        misses_by_distance=causes.misses_by_distance(failures, edges=edges),
        miss_probability_by_step=tuple(causes.miss_probability_by_step(failures).tolist()),
        chains=causes.likeliest_chains(failures),
        sensitivity=sensitivity.band_sensitivities(
            failures,
            log_probability=log_mu,
            edges=edges,
            target=target,
            likelihood=remembered,
            unknown_because=f"not available with {' and '.join(labels)}" if labels else None,
        ),
        memory=memory,
        bursts=causes.bursts_of(
            failures,
            # where the scenario itself reacts, whatever is remembered as well
            mattering=own_features(features).reacts(rollouts.decision_states()),
            dt_s=dt_s,
            gap=None if farthest_m is None else "gap",
            turns=turns,
        ),
    )
    if folding is None or turns == 1:
        return explanation
    likelihood = remembered or outcomes.IndependentOutcomes.of(rollouts)
    by_step = any_error_by_step(failures, folding=folding)
    return replace(
        explanation,
        miss_probability_by_step=tuple(by_step.tolist()),
        chains=tuple(in_steps(chain, folding=folding) for chain in explanation.chains),
        slots=slot_errors(failures, folding=folding, likelihood=likelihood),
    )
