"""What a run's stages mean: causes, other models' answers, dangerous starts, thin data.

Nothing here changes what it is given: a run hands over what it has found so far and keeps what
comes back.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from pemviz.analysis import model_uncertainty
from pemviz.analysis.explanation import explain
from pemviz.analysis.robustness_tail import robustness_tail
from pemviz.analysis.starts import Violations, dangerous_starts
from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.judging.reweight import MemberEstimates
from pemviz.runs.experiment import Experiment
from pemviz.runs.result import RunResult, StageSummary
from pemviz.sampling.kept import log_of
from pemviz.sampling.method import PoolsStages
from pemviz.sampling.state.composed import memory_of_pem
from pemviz.simulators.latents import NamesStarts, latent_counts, within
from pemviz.types import StageResult, numbers_of

MOST_STARTS = 20_000
"""Violations of a stage whose starts are kept; of more an evenly spaced part."""
Some = TypeVar("Some", bound=model_uncertainty.SomeViolations)


@dataclass(frozen=True)
class _Weighed(Generic[Some]):
    """V of N rollouts' violations, or what model classes make of them, with log weights ``[V]``."""

    some: Some
    log_weight: FloatArray
    count: int

    @classmethod
    def concatenate(cls, parts: "Sequence[_Weighed[Some]]") -> "_Weighed[Some]":
        """All of at least one part, as if sampled in one."""
        counts = [part.count for part in parts]
        firsts = np.cumsum([0, *counts], dtype=np.int64)[:-1]
        moved = [
            replace(part.some, rollout=part.some.rollout + first)
            for part, first in zip(parts, firsts, strict=True)
        ]
        log_weight = np.concatenate([part.log_weight for part in parts])
        return cls(type(moved[0]).concatenate(moved), log_weight, sum(counts))


@dataclass(frozen=True)
class _StageStarts:
    """What a stage's violations started from, until their parts of the estimate are known.

    Attributes:
        violations: With a stage's own log weights, of splitting log parts, in place of parts.
        rollout: Index of each among the stage's rollouts, ``[V]``.
        rollouts: How many the stage has.
        log_stands_for: Log of how many violations each stands for.
    """

    violations: Violations
    rollout: IntArray
    rollouts: int
    log_stands_for: float


@dataclass(frozen=True)
class Interpreted:
    """A result with what it means, as far as a run has come.

    Attributes:
        result: The result.
        members: The answers of the error model's ensemble on which ``result.pem_interval``
            rests, one for each part of a final batch that was evaluated.
        waiting: Violations of the latest stages, by which other model classes are evaluated once
            there are many, or the repetition is done; with the stages' own log weights.
        of_repetition: What they make of those before, since the last repetition ended.
        of_repetitions: The same of each repetition that is done, with the log weights that its
            estimate averages.
        stage_starts: What violations of the stages since the last repetition ended started from.
        starts: The same of each repetition that is done, with parts of its estimate.
    """

    result: RunResult
    members: tuple[MemberEstimates, ...] = ()
    waiting: tuple[_Weighed[model_uncertainty.Violating], ...] = ()
    of_repetition: tuple[_Weighed[model_uncertainty.ModelClassRatios], ...] = ()
    of_repetitions: tuple[_Weighed[model_uncertainty.ModelClassRatios], ...] = ()
    stage_starts: tuple[_StageStarts, ...] = ()
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
    is_final = stage.kind == "final"
    is_averaged = is_final or isinstance(experiment.method, PoolsStages)
    found = _stage_starts(experiment, stage) if is_averaged else None
    if found is not None:
        interpreted = replace(interpreted, stage_starts=(*interpreted.stage_starts, found))
    if not experiment.has_likelihood_ratios:
        if found is not None:
            yield interpreted
        return
    if not is_averaged:
        return
    interpreted = _with_violations(interpreted, experiment, stage)
    if not is_final:
        yield interpreted
        return
    for step in (_explained, _with_robustness_tail, _with_refits, _compared_with_data):
        interpreted = step(interpreted, experiment, stage)
        yield interpreted


def _explained(interpreted: Interpreted, experiment: Experiment, stage: StageResult) -> Interpreted:
    """Of a final batch in parts, the part with most failures explains best."""
    most = max((part.failures for part in _parts_before(interpreted.result, stage)), default=0)
    if stage.failures <= most:
        return interpreted
    explanation = explain(
        stage,
        features=experiment.features,
        farthest_m=experiment.back_end.farthest_m,
        target=experiment.config.target,
        dt_s=experiment.back_end.simulator.dt_s,
        tau_s=memory_of_pem(experiment.pem).tau_s,
        folding=experiment.folding,
        system=experiment.problem.system,
    )
    if explanation is None:
        return interpreted
    return replace(interpreted, result=replace(interpreted.result, explanation=explanation))


def _with_robustness_tail(
    interpreted: Interpreted, _: Experiment, stage: StageResult
) -> Interpreted:
    """What robustness is without a violation; the largest final batch says most of it."""
    before = interpreted.result.robustness_tail
    if before is not None and before.rollouts >= stage.count:
        return interpreted
    if stage.sampled is None:
        found = robustness_tail(stage.scored.robustness, stage.scored.rollouts.log_weight)
    else:
        found = robustness_tail(stage.sampled.robustness, stage.sampled.log_weight)
    return replace(interpreted, result=replace(interpreted.result, robustness_tail=found or before))


def _with_refits(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """The answers of the ensemble's models, from as many failures as are enough."""
    result, ensemble = interpreted.result, experiment.ensemble
    if ensemble is None:
        return interpreted
    if (
        sum(part.failures for part in _parts_before(result, stage))
        >= model_uncertainty.ENOUGH_FAILURES
    ):
        return interpreted
    simulator = experiment.problem.simulator
    answers = model_uncertainty.member_estimates(
        stage.scored, simulator=simulator, ensemble=ensemble
    )
    members = (*interpreted.members, answers)
    if any(part.failures for part in result.stages if part.kind == "final"):
        result = replace(result, pem_interval=model_uncertainty.model_interval(members))
    return replace(interpreted, result=result, members=members)


def refits_of(interpreted: Interpreted, rule: str) -> model_uncertainty.ModelInterval | None:
    """One of several rules' answers over refits; ``None`` where no rollout breaks it."""
    each = [one.rules[rule] for one in interpreted.members if rule in one.rules]
    if not any(one.effective_failures.any() for one in each):
        return None
    return model_uncertainty.model_interval(each)


def _compared_with_data(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """Once a run: where the model extrapolates, and what its data alone allow."""
    if len(interpreted.result.warnings) > len(experiment.warnings):
        return interpreted
    problem, bound = experiment.problem, None
    warnings = (
        *experiment.warnings,
        *model_uncertainty.extrapolation_warnings(
            stage.scored, simulator=problem.simulator, pem=problem.pem
        ),
    )
    if experiment.twin is not None:
        twin = replace(problem.without_rules(), simulator=experiment.twin)
        sharpened_by = experiment.features if experiment.config.plan else None
        bound = model_uncertainty.data_bound(
            twin, seed=experiment.config.seed, sharpened_by=sharpened_by
        )
    if bound is not None:
        warnings = (
            *warnings,
            "the training data alone, without the model's guesses, allow a failure "
            f"probability up to {bound.probability:.1g} ({bound.confidence:.0%})",
        )
    result = replace(interpreted.result, warnings=warnings, data_bound=bound)
    return replace(interpreted, result=result)


def _parts_before(result: RunResult, stage: StageResult) -> list[StageSummary]:
    """Earlier parts of the same repetition's final batch."""
    return [
        part
        for part in result.stages
        if (part.repetition, part.kind) == (stage.repetition, "final") and part.stage < stage.stage
    ]


def _with_violations(
    interpreted: Interpreted, experiment: Experiment, stage: StageResult
) -> Interpreted:
    """The stage's violations, kept for other model classes; evaluated at once if they are many."""
    if not experiment.model_classes:
        return interpreted
    some, rollouts = model_uncertainty.violating(stage.scored), stage.scored.rollouts
    number = numbers_of(rollouts.count, stage.sampled)[some.rollout]
    log_weight = rollouts.log_weight[some.rollout]
    weighed = _Weighed(replace(some, rollout=number), log_weight, stage.count)
    waiting = (*interpreted.waiting, weighed)
    interpreted = replace(interpreted, waiting=waiting)
    many = sum(part.some.rollout.size for part in waiting) >= model_uncertainty.MOST_VIOLATIONS
    return _with_model_classes(interpreted, experiment) if many else interpreted


def _with_model_classes(interpreted: Interpreted, experiment: Experiment) -> Interpreted:
    """What other model classes make of the violations that wait for them."""
    if not interpreted.waiting:
        return interpreted
    every = _Weighed.concatenate(interpreted.waiting)
    ratios = model_uncertainty.model_class_ratios(
        every.some,
        simulator=experiment.problem.simulator,
        model_classes=experiment.model_classes,
    )
    weighed = _Weighed(ratios, every.log_weight, every.count)
    of_repetition = (*interpreted.of_repetition, weighed)
    return replace(interpreted, waiting=(), of_repetition=of_repetition)


def interpret_repetition(
    interpreted: Interpreted, *, experiment: Experiment, state: Any
) -> Interpreted:
    """Which starts are dangerous, and what other model classes answer, once a repetition is done.

    Args:
        interpreted: All before, with every stage of the repetition.
        experiment: What is run.
        state: The method's, after its last stage.
    """
    if not (interpreted.stage_starts or interpreted.waiting or interpreted.of_repetition):
        return interpreted
    method = experiment.method
    pooled = method.pooled_log_weight(state) if isinstance(method, PoolsStages) else None
    if interpreted.stage_starts:
        interpreted = _with_starts(interpreted, experiment, pooled)
    interpreted = _with_model_classes(interpreted, experiment)
    if not interpreted.of_repetition:
        return interpreted
    weighed = _Weighed.concatenate(interpreted.of_repetition)
    if pooled is not None:
        weighed = replace(weighed, log_weight=pooled[weighed.some.rollout])
    of_repetitions = (*interpreted.of_repetitions, weighed)
    every = _Weighed.concatenate(of_repetitions)
    answers = model_uncertainty.model_class_answers(
        every.some,
        model_classes=experiment.model_classes,
        log_weight=every.log_weight,
        of=every.count,
    )
    return replace(
        interpreted,
        result=replace(interpreted.result, model_classes=answers),
        of_repetition=(),
        of_repetitions=of_repetitions,
    )


def _starts_simulator(experiment: Experiment) -> NamesStarts | None:
    """The scenario, if it names its starts and any of them is random."""
    found = within(experiment.problem.simulator, NamesStarts)
    return None if found is None or not latent_counts(found).start else found


def _stage_starts(experiment: Experiment, stage: StageResult) -> _StageStarts | None:
    """What a stage's violations started from; ``None`` where the scenario names no starts."""
    rollouts, latents = stage.scored.rollouts, stage.scored.rollouts.latents
    simulator = _starts_simulator(experiment)
    if latents is None or simulator is None:
        return None
    named = latent_counts(simulator).start
    rows = np.flatnonzero(stage.scored.violated)
    count = rows.size
    if count > MOST_STARTS:
        rows = rows[np.arange(MOST_STARTS) * count // MOST_STARTS]
    if experiment.has_likelihood_ratios:
        log_part = rollouts.log_weight[rows]
    else:  # all that violate of splitting's particles carry the same
        even = log_of(stage.log10_probability) - math.log(count) if count else -math.inf
        log_part = np.full(rows.size, even)
    place = np.full((rows.size, 3), (stage.repetition, stage.stage, 0), dtype=np.int64)
    place[:, 2] = number = numbers_of(rollouts.count, stage.sampled)[rows]
    return _StageStarts(
        violations=Violations(
            latents=latents.start[rows, :named],
            log_part=log_part,
            place=place,
            broken={name: broken[rows] for name, broken in stage.scored.broken.items()},
        ),
        rollout=number,
        rollouts=stage.count,
        log_stands_for=math.log(count / rows.size) if count else 0.0,
    )


def _with_starts(
    interpreted: Interpreted, experiment: Experiment, pooled: FloatArray | None
) -> Interpreted:
    """Which starts are dangerous, by the repetition that is done and all before.

    Violations have their parts of the repetition's estimate: by their ``pooled`` log weights or
    each stage's own; parts of splitting's runs are averaged.
    """
    stages, first, parts = interpreted.stage_starts, 0, list[Violations]()
    of = sum(s.rollouts for s in stages) if experiment.has_likelihood_ratios else len(stages)
    for stage in stages:
        own = stage.violations
        log_part = own.log_part if pooled is None else pooled[first + stage.rollout]
        parts.append(replace(own, log_part=log_part + stage.log_stands_for - math.log(of)))
        first += stage.rollouts
    starts = (*interpreted.starts, Violations.concatenate(parts))
    simulator, result = _starts_simulator(experiment), interpreted.result
    if simulator is not None:
        every = Violations.concatenate(starts)
        every = replace(every, log_part=every.log_part - math.log(len(starts)))
        rules = [rule.name for rule in experiment.config.rules]
        result = replace(result, starts=dangerous_starts(simulator, every, rules=rules))
    return replace(interpreted, result=result, stage_starts=(), starts=starts)
