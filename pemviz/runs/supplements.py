"""What a run adds once its estimate is there: distance driven, curves, data plan, reference."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np

from pemviz.analysis.band_models import BandOutcomes, band_outcomes
from pemviz.analysis.data_plan import DataPlan, RefitBand, SequencePlan, refit_plan, sequence_plan
from pemviz.analysis.label_plan import LARGEST_SAMPLED, LabelPlan, label_plan, model_misses
from pemviz.config import ExperimentConfig
from pemviz.errors import ConfigError, PemError
from pemviz.pem import Pem, load_pem, support_of
from pemviz.pem.models.memory import Memory
from pemviz.proposals.fixed import PemProposal
from pemviz.runs.experiment import Experiment
from pemviz.runs.result import (
    DrivenDistance,
    MeasuredAnswer,
    RuleAnswer,
    RunMemory,
    RunResult,
    memory_of,
    own_memory,
)
from pemviz.runs.specification import build_formula, build_problem
from pemviz.runs.uncertainty import (
    SEVERAL_SLOTS,
    memory_option,
    reference_diagnostics,
    run_interval_caveats,
)
from pemviz.sampling.bursts import curve as curves
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.problem import nothing_finished, sample
from pemviz.sampling.rollouts.runners import run_here
from pemviz.sampling.slots import turns_of
from pemviz.sampling.state.composed import hidden_in, own_pem
from pemviz.sampling.zero_variance.reference import (
    FEW_STATES,
    reference,
    reference_of_few_states,
)
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import begun, latent_counts, within
from pemviz.types import Simulator

DISTANCE_ROLLOUTS = 200
LEAST_KM = 1e-6
SPAWN_KEY = 2**32 - 2
"""Of the child of the run's seed that rollouts for the distance are sampled by."""
REFERENCE_SHARE, STEPS_OF_A_STATE = 0.2, 2
"""Of the steps that rollouts took, how many the recursion may; two outcomes follow a state."""
MEASURED_ROLLOUTS = 600
"""For the answers with measured memories, however small the run: of 20 seeds on ``paper`` 38 of 39
unwarned intervals held the truth, from 300 rollouts 21 of 22, from 100 rollouts 2 of 10."""
OWN_MEMORY = "this error model"
EXAMPLE = "rrc"
"""The shipped model whose memory is an example for models of single frames."""


@runtime_checkable
class DrivesFreely(Protocol):
    """A scenario whose rollouts are stretches of driving, not encounters."""

    @property
    def distance_signal(self) -> str:
        """Name of the signal that says how far the ego has driven in the rollout [m]."""
        ...


def _with_distance(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with the distance that a rollout is, where the scenario says it."""
    scenario = within(experiment.problem.simulator, DrivesFreely)
    if scenario is None:
        return result
    scored = sample(
        experiment.problem.without_rules(),
        proposal=PemProposal(),
        count=DISTANCE_ROLLOUTS,
        seeds=np.random.SeedSequence(experiment.config.seed, spawn_key=(SPAWN_KEY,)),
    )
    driven_km = scored.rollouts.signals[scenario.distance_signal][:, -1] / 1000.0
    mean_km = float(np.mean(driven_km))
    if mean_km < LEAST_KM:  # the ego stands: no distance to divide by
        return result
    driven = DrivenDistance(
        mean_km=mean_km,
        std_error_km=float(np.std(driven_km, ddof=1) / np.sqrt(DISTANCE_ROLLOUTS)),
        rollouts=DISTANCE_ROLLOUTS,
    )
    return replace(result, driven=driven)


def _with_curves(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with the answer over memory times and over frailties, if the configuration says so.

    It stays as it is with hidden properties of the user's own, which the curves know nothing of.
    """
    memory, config = result.memory, experiment.config
    if not config.memory_curve or memory is None or memory.hidden:
        return result
    pem, back_end = own_pem(experiment.pem), experiment.back_end.scenario_alone
    problem = experiment.problem.without_rules()
    problem = replace(problem, simulator=back_end.simulator, pem=pem, finished=nothing_finished)
    if back_end.twin is not None and not experiment.twin_doubt:
        problem = replace(problem, simulator=back_end.twin, run_batches=run_here)
    fitted = memory.fitted
    measured = () if fitted is None else (fitted.tau_s,)
    over_tau = curves.memory_curve(
        problem,
        pem=pem,
        features=back_end.features,
        seed=config.seed,
        also_s=(memory.tau_s, *measured, *curves.measured_s(memory.frailty).values()),
        frailty=memory.frailty,
    )
    measured = () if fitted is None or fitted.frailty is None else (fitted.frailty,)
    over_frailty = curves.frailty_curve(
        problem,
        pem=pem,
        features=back_end.features,
        seed=config.seed,
        also=(memory.frailty, *measured, *curves.MEASURED_FRAILTY.values()),
        tau_s=memory.tau_s,
    )
    curve, frailty_curve = (_with_answer(c, result, memory) for c in (over_tau, over_frailty))
    return replace(result, memory=replace(memory, curve=curve, frailty_curve=frailty_curve))


def _with_measured(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with the answer, and that to each rule, with memories that were measured."""
    memory = result.memory
    if memory is None or result.estimate is None:
        return result
    reason = _unmeasured_because(experiment, result)
    if reason is not None:
        return replace(result, memory=replace(memory, unmeasured=reason))
    memories = measured_memories(memory)
    try:
        found = _measured(experiment, memories, experiment.config)
        rules = tuple(
            replace(rule, measured=_measured(experiment, memories, _of_rule(experiment, rule)))
            for rule in result.rules
        )
    except ConfigError as error:  # of a scenario with signals of a memory's names
        return replace(result, memory=replace(memory, unmeasured=str(error)))
    return replace(result, memory=replace(memory, measured=found), rules=rules)


def _unmeasured_because(experiment: Experiment, result: RunResult) -> str | None:
    if turns_of(experiment.problem.simulator) > 1:
        return f"{SEVERAL_SLOTS}; a run with another --memory-s tells"
    if not experiment.config.measured_memory:
        return "measured_memory is switched off"
    visibility = experiment.config.memory_law == "visibility"  # beside it those of the other law
    if (hidden := memory_of(experiment.pem).hidden) and not visibility:
        return f"not with {' and '.join(hidden)}"
    twin = experiment.back_end.scenario_alone.twin
    if twin is None or latent_counts(twin):
        return f"not without a fast twin whose start is fixed; {memory_option(result)} may tell"
    return experiment.twin_doubt or None


def measured_memories(memory: RunMemory) -> Sequence[tuple[str, Memory]]:
    """Whose was measured; of the answer's own the ends of its intervals."""
    own = memory.fitted
    if own is None:
        return tuple(curves.MEASURED.items())
    if not memory.is_own:
        return ((OWN_MEMORY, Memory(own.tau_s, own.frailty or 0.0)),)
    here = Memory(memory.tau_s, memory.frailty)
    ends = [replace(here, tau_s=tau_s) for tau_s in (own.low_s, own.high_s)]
    known = (end for end in (own.frailty_low, own.frailty_high) if end is not None)
    ends += [replace(here, frailty=frailty) for frailty in known]
    return tuple((OWN_MEMORY, end) for end in ends)


def _of_rule(experiment: Experiment, rule: RuleAnswer) -> ExperimentConfig:
    return replace(experiment.config, rules=(), spec=rule.formula)


def _measured(
    experiment: Experiment, memories: Sequence[tuple[str, Memory]], asked: ExperimentConfig
) -> tuple[MeasuredAnswer, ...]:
    """The answers to what a configuration asks, on the fast twin."""
    pem, back_end = own_pem(experiment.pem), experiment.back_end.scenario_alone
    assert back_end.twin is not None  # noqa: S101  checked before
    back_end = replace(back_end, simulator=back_end.twin)
    problem = build_problem(asked, build_formula(asked, back_end.simulator), pem, back_end)
    points = curves.memory_points(
        replace(problem, pause=experiment.problem.pause, run_batches=run_here),
        pem=pem,
        features=back_end.features,
        seed=asked.seed,
        memories=[memory for _, memory in memories],
        rollouts=MEASURED_ROLLOUTS,
    )
    names = [name for name, _ in memories]
    return tuple(map(MeasuredAnswer, names, points))


def _with_answer(
    curve: tuple[CurvePoint, ...], result: RunResult, memory: RunMemory
) -> tuple[CurvePoint, ...]:
    """A curve with the answer as its point there: the better one, where its interval holds."""
    answer = result.estimate
    if answer is None or answer.ci_low is None or run_interval_caveats(result):
        return curve
    own = CurvePoint(
        tau_s=memory.tau_s,
        probability=answer.probability,
        low=answer.ci_low,
        high=answer.ci_high,
        ess=answer.ess,
        diagnostics=answer.diagnostics,
        frailty=memory.frailty,
    )
    here = (own.tau_s, own.frailty)
    return tuple(own if (point.tau_s, point.frailty) == here else point for point in curve)


def beside_reference(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with the reference; a warning if they disagree.

    Sampled where the configuration says so; else the recursion where the scenario has few states.
    A system of the user's own without a twin is gone through itself, where that takes at most a
    fifth of the steps that its rollouts took: no rollout may show the sequence that fails. One that
    may break is not.

    Args:
        result: With the estimate of all repetitions.
        experiment: What was run; its problem's ``pause`` may raise to stop.
    """
    problem, twin = experiment.problem, experiment.twin
    if result.estimate is None:
        return result
    if twin is not None and experiment.config.reference:
        found = reference(problem, twin=twin)
    elif twin is not None:
        doubted = experiment.twin_doubt or result.lost is not None  # a twin loses nothing
        found = None if doubted else reference_of_few_states(problem, twin=twin)
    elif experiment.config.lost != "end" or not _states_are_numbers(problem.simulator):
        return result
    else:
        steps = result.estimate.rollouts_simulated * (problem.simulator.states - 1)
        most = min(int(REFERENCE_SHARE * steps / STEPS_OF_A_STATE), FEW_STATES)
        found = reference_of_few_states(problem, twin=problem.simulator, most_states=most)
    compared = replace(result, reference=found)
    words = tuple(one.text for one in reference_diagnostics(compared))
    return replace(compared, warnings=(*result.warnings, *words))


def _states_are_numbers(simulator: Simulator) -> bool:
    """Whether outcomes alone lead from state to state, and equal states can be told."""
    if latent_counts(simulator) or episodic(simulator) is not None:
        return False
    memory = begun(simulator, count=1).memory
    return all(np.asarray(values).dtype.kind in "bif" for values in memory.values())


def _with_data_plan(result: RunResult, *, experiment: Experiment) -> RunResult:
    """A result with what to measure next, if that is to be planned."""
    config = experiment.config
    if not (config.plan or config.target is not None) or result.estimate is None:
        return result
    target, found = planned_target(result), None
    reason = _no_labels_because(result, experiment)
    if reason is None and target is None:
        reason = "what the labels at hand allow is no more than the answer: name a --target"
    if reason is None and target is not None:
        found = _labels(result, experiment, target)
    if found is None and reason is None:
        reason = "the scenario does not meet the target whatever the detector does"
    plan = DataPlan(
        labels=None if found is None else found[0],
        halves=found is not None and config.target is None,
        reason=reason,
        refits=() if found is None else _refits(experiment, found[1]),
        sequences=None if experiment.is_own_system else _sequences(experiment),
    )
    return replace(result, plan=plan)


def planned_target(result: RunResult) -> float | None:
    """The configuration's target, or halfway from the answer to what its data allow.

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
    if (log10 := answer.log10_probability) is None:
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
    """From the violations at hand, or from such as are sampled for the model where they are far."""
    members: Sequence[Pem] = () if experiment.ensemble is None else experiment.ensemble.members
    if len(members) < 2:
        return ()
    own = model_misses(experiment.pem, outcomes.salient)
    if outcomes.effective_failures(own) < SMALL_ESS and experiment.twin is not None:
        outcomes = band_outcomes(
            replace(experiment.problem, simulator=experiment.twin),
            miss=np.where(own > 0.0, own, LARGEST_SAMPLED),
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
    except PemError:  # a damaged file is reported where that model is used
        return None
    return None if example is None else sequence_plan(example, example=EXAMPLE, is_own=False)


IN_ORDER = (_with_distance, _with_measured, _with_curves, _with_data_plan, beside_reference)
"""What is added to a result with the estimate of all repetitions; each may stop the run."""
