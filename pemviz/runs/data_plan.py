"""What to measure next after a run: from its answer, its uncertainty and its error model."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pemviz.analysis.band_models import BandOutcomes, band_outcomes
from pemviz.analysis.data_plan import DataPlan, RefitBand, SequencePlan, refit_plan, sequence_plan
from pemviz.analysis.label_plan import LARGEST_DRAWN, LabelPlan, label_plan, model_misses
from pemviz.errors import PemError
from pemviz.pem import Pem, load_pem, support_of
from pemviz.runs.experiment import Experiment
from pemviz.runs.memory import own_memory
from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.state.composed import hidden_in, own_pem

EXAMPLE = "rrc"
"""The shipped model whose memory is an example for models of single frames."""


def with_data_plan(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A finished result with what to measure next, if it is asked for.

    Args:
        result: With its estimate and what its data alone allow.
        experiment: What was run; its problem's ``pause`` may raise to stop.
    """
    config = experiment.config
    if not (config.plan or config.target is not None) or result.estimate is None:
        return result
    sequences = None if experiment.is_own_system else _sequences(experiment)
    reason = _no_labels_because(result, experiment)
    target = planned_target(result)
    if reason is None and target is None:
        reason = "what the labels at hand allow is no more than the answer: name a --target"
    found = None if reason is not None or target is None else _labels(result, experiment, target)
    if found is None:
        reason = reason or "the scenario does not meet the target whatever the detector does"
        plan = DataPlan(None, halves=False, reason=reason, refits=(), sequences=sequences)
        return replace(result, plan=plan)
    labels, outcomes = found
    plan = DataPlan(
        labels=labels,
        halves=config.target is None,
        reason=None,
        refits=_refits(experiment, outcomes),
        sequences=sequences,
    )
    return replace(result, plan=plan)


def planned_target(result: RunResult) -> float | None:
    """The target that was asked for, or halfway from the answer to what its data allow.

    Halfway in powers of ten; ``None`` where there is no answer, or the data allow no more.
    """
    if result.config.target is not None:
        return result.config.target
    answer, bound = result.estimate, result.data_bound
    if answer is None or bound is None or not 0.0 < answer.probability < bound.probability:
        return None
    return math.sqrt(answer.probability) * math.sqrt(bound.probability)


def _no_labels_because(result: RunResult, experiment: Experiment) -> str | None:
    if hidden_in(experiment.pem):
        return "labels are planned for misses that are independent given the state"
    if experiment.twin is None:
        return "the scenario has no fast twin"
    if support_of(own_pem(experiment.pem)) is None:
        return f"error model {result.pem.name} carries no counts of its training data"
    if result.explanation is None or result.estimate is None or not result.estimate.failures:
        return "no violation with a weight was seen, to tell where misses matter"
    return None


def _labels(
    result: RunResult, experiment: Experiment, target: float
) -> tuple[LabelPlan, BandOutcomes] | None:
    answer, explanation = result.estimate, result.explanation
    support = support_of(experiment.pem)
    if answer is None or explanation is None or support is None or experiment.twin is None:
        return None
    log10 = answer.log10_probability
    if log10 is None:
        return None
    return label_plan(
        replace(experiment.problem, simulator=experiment.twin),
        features=experiment.features,
        support=support,
        target=target,
        log_probability=math.log(10.0) * log10,
        elasticity=explanation.sensitivity[0].elasticity,
        seed=experiment.config.seed,
    )


def _refits(experiment: Experiment, outcomes: BandOutcomes) -> tuple[RefitBand, ...]:
    """From the violations at hand, or from such as are drawn for the model where they are far."""
    members: Sequence[Pem] = () if experiment.ensemble is None else experiment.ensemble.members
    if len(members) < 2:
        return ()
    own = model_misses(experiment.pem, outcomes.salient)
    if outcomes.effective_failures(own) < SMALL_ESS and experiment.twin is not None:
        outcomes = band_outcomes(
            replace(experiment.problem, simulator=experiment.twin),
            miss=np.where(own > 0.0, own, LARGEST_DRAWN),
            features=experiment.features,
            seed=experiment.config.seed,
        )
    return refit_plan(outcomes, pem=experiment.pem, members=members)


def _sequences(experiment: Experiment) -> SequencePlan | None:
    """For the model's own memory, or that of a shipped detector as an example."""
    own = own_pem(experiment.pem)
    try:
        fitted = own_memory(own)
        if fitted is not None:
            return sequence_plan(fitted, example=own.name, is_own=True)
        example = own_memory(load_pem(EXAMPLE))
    except PemError:  # a damaged file is told where that model is asked for
        return None
    return None if example is None else sequence_plan(example, example=EXAMPLE, is_own=False)
