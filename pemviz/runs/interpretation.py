"""What a run's result means: causes, other models' answers, thin data, the reference.

Nothing here changes what it is given: a run hands over what it has found so far and keeps what
comes back.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from pemviz.analysis.explanation import explain
from pemviz.analysis.model_uncertainty import (
    ENOUGH_FAILURES,
    MOST_VIOLATIONS,
    ModelClassRatios,
    SomeViolations,
    Violating,
    data_bound,
    extrapolation_warnings,
    member_estimates,
    model_class_answers,
    model_class_ratios,
    model_interval,
    violating,
)
from pemviz.analysis.robustness_tail import robustness_tail
from pemviz.analysis.starts import Violations
from pemviz.arrays import FloatArray
from pemviz.pem.judging.reweight import MemberEstimates
from pemviz.runs.experiment import Experiment
from pemviz.runs.memory import RunMemory
from pemviz.runs.result import RunResult, StageSummary
from pemviz.runs.starts import (
    StageStarts,
    repetition_starts,
    stage_starts,
    starts_of_run,
)
from pemviz.runs.trust import reference_diagnostics, run_interval_caveats
from pemviz.sampling.bursts.curve import (
    MEASURED_FRAILTY,
    MEASURED_S,
    CurvePoint,
    frailty_curve,
    memory_curve,
)
from pemviz.sampling.method import PoolsStages
from pemviz.sampling.problem import nothing_finished
from pemviz.sampling.rollouts.batches import run_here
from pemviz.sampling.state.composed import ComposedSimulator, memory_of_pem, own_pem
from pemviz.sampling.zero_variance.reference import reference, reference_of_few_states
from pemviz.simulators.latents import within
from pemviz.types import StageResult, numbers_of

Told = TypeVar("Told", bound=SomeViolations)


@dataclass(frozen=True)
class _Weighed(Generic[Told]):
    """V of N rollouts' violations, or what model classes make of them, with log weights ``[V]``."""

    told: Told
    log_weight: FloatArray
    count: int

    @classmethod
    def concatenate(cls, parts: "Sequence[_Weighed[Told]]") -> "_Weighed[Told]":
        """All of at least one part, as if drawn in one."""
        counts = [part.count for part in parts]
        firsts = np.cumsum([0, *counts], dtype=np.int64)[:-1]
        moved = [
            replace(part.told, rollout=part.told.rollout + first)
            for part, first in zip(parts, firsts, strict=True)
        ]
        log_weight = np.concatenate([part.log_weight for part in parts])
        return cls(type(moved[0]).concatenate(moved), log_weight, sum(counts))


@dataclass(frozen=True)
class Interpreted:
    """A result with what it means, as far as a run has come.

    Attributes:
        result: The result.
        members: The answers of the error model's ensemble on which ``result.pem_interval``
            rests, one for each part of a final batch that was asked.
        unasked: Violations of the latest stages, of which other model classes are asked once
            there are many, or the repetition is done; with the stages' own log weights.
        of_repetition: What they make of those before, since the last repetition ended.
        of_repetitions: The same of each repetition that is done, with the log weights that its
            estimate averages.
        stage_starts: What violations of the stages since the last repetition ended started from.
        starts: The same of each repetition that is done, with parts of its estimate.
    """

    result: RunResult
    members: tuple[MemberEstimates, ...] = ()
    unasked: tuple[_Weighed[Violating], ...] = ()
    of_repetition: tuple[_Weighed[ModelClassRatios], ...] = ()
    of_repetitions: tuple[_Weighed[ModelClassRatios], ...] = ()
    stage_starts: tuple[StageStarts, ...] = ()
    starts: tuple[Violations, ...] = ()


def interpret(
    interpreted: Interpreted, *, experiment: Experiment, stage: StageResult
) -> Iterator[Interpreted]:
    """Judge a finished stage; only final rollouts that carry weights say something.

    Yields what is known after each step, so that a run that is stopped within a long one keeps
    those before.

    Args:
        interpreted: All before; its result has the stage's summary already.
        experiment: What is run; its problem's ``pause`` may raise to stop.
        stage: The stage with its rollouts.
    """
    before, interpreted = interpreted, _with_starts(interpreted, experiment, stage)
    if not experiment.has_likelihood_ratios:
        if interpreted is not before:
            yield interpreted
        return
    pools = isinstance(experiment.method, PoolsStages)
    if stage.kind == "final" or pools:
        interpreted = _told_model_classes(interpreted, experiment, stage)
    if stage.kind != "final":
        if pools:
            yield interpreted
        return
    for step in (_explained, _ordinary, _asked_of_members, _compared_with_data):
        interpreted = step(interpreted, experiment, stage)
        yield interpreted


def _with_starts(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """What the violations started from, of stages that the estimate averages."""
    averaged = stage.kind == "final" or isinstance(experiment.method, PoolsStages)
    found = stage_starts(experiment, stage) if averaged else None
    if found is None:
        return interpreted
    return replace(interpreted, stage_starts=(*interpreted.stage_starts, found))


def _explained(interpreted: Interpreted, experiment: Experiment, stage: StageResult) -> Interpreted:
    """Of a final batch in parts, the part with most failures explains best."""
    if stage.failures == 0:
        return interpreted
    if any(part.failures >= stage.failures for part in _parts_before(interpreted.result, stage)):
        return interpreted
    explanation = explain(
        stage,
        features=experiment.features,
        farthest_m=experiment.back_end.farthest_m,
        target=experiment.config.target,
        dt_s=experiment.back_end.simulator.dt_s,
        tau_s=memory_of_pem(experiment.pem).tau_s,
        folding=experiment.folding,
        system=within(experiment.problem.simulator, ComposedSimulator),
    )
    if explanation is None:
        return interpreted
    return replace(interpreted, result=replace(interpreted.result, explanation=explanation))


def _ordinary(interpreted: Interpreted, _: Experiment, stage: StageResult) -> Interpreted:
    """What robustness is without a violation; the largest final batch tells most of it."""
    before = interpreted.result.robustness_tail
    if before is not None and before.rollouts >= stage.count:
        return interpreted
    robustness = stage.scored.robustness if stage.drawn is None else stage.drawn.robustness
    log_weight = stage.scored.rollouts.log_weight if stage.drawn is None else stage.drawn.log_weight
    found = robustness_tail(robustness, log_weight)
    result = replace(interpreted.result, robustness_tail=before if found is None else found)
    return replace(interpreted, result=result)


def _asked_of_members(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """The answers of the ensemble's models, from as many failures as are enough."""
    result, ensemble = interpreted.result, experiment.ensemble
    if ensemble is None:
        return interpreted
    if sum(part.failures for part in _parts_before(result, stage)) >= ENOUGH_FAILURES:
        return interpreted
    simulator = experiment.problem.simulator
    answers = member_estimates(stage.scored, simulator=simulator, ensemble=ensemble)
    members = (*interpreted.members, answers)
    if any(part.failures for part in result.stages if part.kind == "final"):
        result = replace(result, pem_interval=model_interval(members))
    return replace(interpreted, result=result, members=members)


def _told_model_classes(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """The stage's violations, kept for other model classes; asked of at once if there are many."""
    if not experiment.model_classes:
        return interpreted
    told, rollouts = violating(stage.scored), stage.scored.rollouts
    number = numbers_of(rollouts.count, stage.drawn)[told.rollout]
    log_weight = rollouts.log_weight[told.rollout]
    weighed = _Weighed(replace(told, rollout=number), log_weight, stage.count)
    unasked = (*interpreted.unasked, weighed)
    interpreted = replace(interpreted, unasked=unasked)
    many = sum(part.told.rollout.size for part in unasked) >= MOST_VIOLATIONS
    return _asked_of_model_classes(interpreted, experiment) if many else interpreted


def _asked_of_model_classes(interpreted: Interpreted, experiment: Experiment) -> Interpreted:
    """What other model classes make of the violations that they were not asked of yet."""
    if not interpreted.unasked:
        return interpreted
    asked = _Weighed.concatenate(interpreted.unasked)
    simulator, model_classes = experiment.problem.simulator, experiment.model_classes
    ratios = model_class_ratios(asked.told, simulator=simulator, model_classes=model_classes)
    weighed = _Weighed(ratios, asked.log_weight, asked.count)
    of_repetition = (*interpreted.of_repetition, weighed)
    return replace(interpreted, unasked=(), of_repetition=of_repetition)


def interpret_repetition(
    interpreted: Interpreted, *, experiment: Experiment, state: Any
) -> Interpreted:
    """Which starts are dangerous, and what other model classes answer, once a repetition is done.

    Args:
        interpreted: All before, with every stage of the repetition.
        experiment: What is run.
        state: The method's, after its last stage.
    """
    interpreted = _asked_of_model_classes(_starts_told(interpreted, experiment, state), experiment)
    if not interpreted.of_repetition:
        return interpreted
    weighed, method = _Weighed.concatenate(interpreted.of_repetition), experiment.method
    if isinstance(method, PoolsStages):
        of_all = method.pooled_log_weight(state)
        weighed = replace(weighed, log_weight=of_all[weighed.told.rollout])
    of_repetitions = (*interpreted.of_repetitions, weighed)
    pooled = _Weighed.concatenate(of_repetitions)
    model_classes = model_class_answers(
        pooled.told,
        model_classes=experiment.model_classes,
        log_weight=pooled.log_weight,
        of=pooled.count,
    )
    return replace(
        interpreted,
        result=replace(interpreted.result, model_classes=model_classes),
        of_repetition=(),
        of_repetitions=of_repetitions,
    )


def _starts_told(interpreted: Interpreted, experiment: Experiment, state: Any) -> Interpreted:
    if not interpreted.stage_starts:
        return interpreted
    method = experiment.method
    done = repetition_starts(
        interpreted.stage_starts,
        log_weight=method.pooled_log_weight(state) if isinstance(method, PoolsStages) else None,
        weighted=experiment.has_likelihood_ratios,
    )
    starts = (*interpreted.starts, done)
    told = replace(interpreted.result, starts=starts_of_run(experiment, starts))
    return replace(interpreted, result=told, stage_starts=(), starts=starts)


def _compared_with_data(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """Once a run: where the model extrapolates, and what its data alone allow."""
    if len(interpreted.result.warnings) > len(experiment.warnings):
        return interpreted
    problem = experiment.problem
    warnings = (
        *experiment.warnings,
        *extrapolation_warnings(stage.scored, simulator=problem.simulator, pem=problem.pem),
    )
    bound = None
    if experiment.twin is not None:
        twin = replace(problem.without_rules(), simulator=experiment.twin)
        sharpened_by = experiment.features if experiment.config.plan else None
        bound = data_bound(twin, seed=experiment.config.seed, sharpened_by=sharpened_by)
    if bound is not None:
        warnings = (
            *warnings,
            "the training data alone, without the model's guesses, allow a failure "
            f"probability up to {bound.probability:.1g} ({bound.confidence:.0%})",
        )
    return replace(
        interpreted, result=replace(interpreted.result, warnings=warnings, data_bound=bound)
    )


def _parts_before(result: RunResult, stage: StageResult) -> list[StageSummary]:
    """Earlier parts of the same repetition's final batch."""
    return [
        part
        for part in result.stages
        if (part.repetition, part.kind) == (stage.repetition, "final") and part.stage < stage.stage
    ]


def with_curves(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A finished result with the answer over memory times and over frailties, if it is asked for.

    It stays as it is with hidden properties of the user's own, which the curves know nothing of.

    Args:
        result: With the estimate of all repetitions.
        experiment: What was run; its problem's ``pause`` may raise to stop.
    """
    memory, config = result.memory, experiment.config
    if not config.memory_curve or memory is None or memory.hidden:
        return result
    pem, back_end = own_pem(experiment.pem), experiment.back_end.scenario_alone
    problem = experiment.problem.without_rules()
    problem = replace(problem, simulator=back_end.simulator, pem=pem, finished=nothing_finished)
    if back_end.twin is not None:
        problem = replace(problem, simulator=back_end.twin, run_batches=run_here)
    fitted = memory.fitted
    measured = () if fitted is None else (fitted.tau_s,)
    over_tau = memory_curve(
        problem,
        pem=pem,
        features=back_end.features,
        seed=config.seed,
        also_s=(memory.tau_s, *measured, *MEASURED_S.values()),
        frailty=memory.frailty,
    )
    measured = () if fitted is None or fitted.frailty is None else (fitted.frailty,)
    over_frailty = frailty_curve(
        problem,
        pem=pem,
        features=back_end.features,
        seed=config.seed,
        also=(memory.frailty, *measured, *MEASURED_FRAILTY.values()),
        tau_s=memory.tau_s,
    )
    own = _own_point(result, memory)
    return replace(
        result,
        memory=replace(
            memory,
            curve=_through(own, over_tau),
            frailty_curve=_through(own, over_frailty),
        ),
    )


def _own_point(result: RunResult, memory: RunMemory) -> CurvePoint | None:
    """The answer as a point of a curve: it is the better one, where its interval holds."""
    answer = result.estimate
    if answer is None or answer.ci_low is None or run_interval_caveats(result):
        return None
    return CurvePoint(
        tau_s=memory.tau_s,
        probability=answer.probability,
        low=answer.ci_low,
        high=answer.ci_high,
        ess=answer.ess,
        diagnostics=answer.diagnostics,
        frailty=memory.frailty,
    )


def _through(own: CurvePoint | None, curve: tuple[CurvePoint, ...]) -> tuple[CurvePoint, ...]:
    """A curve with the answer as its point there."""
    if own is None:
        return curve
    here = (own.tau_s, own.frailty)
    return tuple(own if (point.tau_s, point.frailty) == here else point for point in curve)


def beside_reference(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A finished result with the reference; a warning if they disagree.

    Sampled where it is asked for; unasked, the recursion where the scenario has few states.

    Args:
        result: With the estimate of all repetitions.
        experiment: What was run; its problem's ``pause`` may raise to stop.
    """
    twin = experiment.twin
    if result.estimate is None or twin is None:
        return result
    if experiment.config.reference:
        beside = reference(experiment.problem, twin=twin)
    else:
        beside = reference_of_few_states(experiment.problem, twin=twin)
    compared = replace(result, reference=beside)
    words = tuple(one.text for one in reference_diagnostics(compared))
    return replace(compared, warnings=(*result.warnings, *words))
