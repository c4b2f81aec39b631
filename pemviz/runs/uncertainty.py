"""How far a run's answer is to be trusted: its diagnostics, and the uncertainty budget.

Each source of the budget bounds the failure probability as far as one source of doubt goes, from
the sampling error to what the training data alone allow. Sources are not added up: each takes for
granted what the others doubt.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from pemviz.runs.result import RunMemory, RunResult
from pemviz.sampling.bursts.curve import CurvePoint
from pemviz.sampling.estimates.diagnostics import reference_disagreement, unreliable_reference
from pemviz.sampling.estimates.trust import interval_caveats, remedy
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.unsafe_states import is_of_single_states
from pemviz.types import Diagnostic

SEVERAL_SLOTS = "not beside the run with several slots"
"""Begins why nothing was measured where there are; curves take none either."""


def run_diagnostics(result: RunResult) -> tuple[Diagnostic, ...]:
    """What is wrong with a run's answer: with its estimate, and beside the reference."""
    own = () if result.estimate is None else result.estimate.diagnostics
    return (*own, *reference_diagnostics(result))


def reference_diagnostics(result: RunResult) -> tuple[Diagnostic, ...]:
    """What is wrong with a run's answer beside the reference; nothing without one."""
    estimate, reference = result.estimate, result.reference
    if estimate is None or reference is None:
        return ()
    disagreement = reference_disagreement(
        estimate,
        probability=reference.probability,
        std_error=reference.std_error,
        trusted=not reference.warnings,
    )
    return (*disagreement, *unreliable_reference(reference.warnings))


def run_interval_caveats(result: RunResult) -> tuple[str, ...]:
    """Why the answer's interval is no 95 % interval, and the answer decides nothing.

    Empty if it is one, or there is none.
    """
    if result.estimate is None:
        return ()
    return interval_caveats(result.estimate, run_diagnostics(result))


def run_remedy(result: RunResult) -> str | None:
    """What to try where the answer's interval, or that of a rule's, is none; ``None``: nothing.

    Of a rule that was never broken there is no interval that anyone could rely on.
    """
    estimate, rules = result.estimate, (rule.estimate for rule in result.rules)
    doubted = any(interval_caveats(rule) for rule in rules if rule.ci_low is not None)
    if estimate is None or not (doubted or run_interval_caveats(result)):
        return None
    return remedy_of(result, run_diagnostics(result))


def remedy_of(result: RunResult, diagnostics: Iterable[Diagnostic]) -> str:
    """What to try where a run's estimate has these diagnostics; nothing that the run refuses."""
    config, checks = result.config, list[str]()
    has_twin = config.is_braking_scenario and config.simulator != "sumo"
    has_twin = has_twin and config.position_errors is None and result.latents is None
    outcomes = config.memory_law == "outcomes"
    if has_twin and outcomes and is_of_single_states(config.spec):
        checks.append("zero-variance")
    if config.lost == "end":  # others go on from what may break
        checks.append("splitting" if has_twin else "subset")
    return remedy(config.method, checks=checks, diagnostics=diagnostics)


def memory_option(result: RunResult) -> str:
    """What looks at other memories of misses than the run's, of what the run does not refuse."""
    memory = result.memory or RunMemory(tau_s=0.0)
    if result.config.memory_law == "visibility":
        return "a run with --memory-law outcomes"
    if memory.hidden:
        return "a run with other hidden properties"
    if result.config.lost == "end" and not memory.unmeasured.startswith(SEVERAL_SLOTS):
        return "--memory-curve"
    return "a run with another --memory-s"


def visibility_option(result: RunResult) -> str:
    """What answers by the visibility that the model carries and the run leaves out.

    Empty where it leaves none out, or pemviz has none for what was run.
    """
    memory = result.memory
    if memory is None or not memory.left_out or memory.unmeasured.startswith(SEVERAL_SLOTS):
        return ""
    return "a run with --memory-law visibility by method auto"


def data_warnings(result: RunResult) -> tuple[str, ...]:
    """What is said about the error model, its data and its refits, in words."""
    about_answer = {diagnostic.text for diagnostic in run_diagnostics(result)}
    about_refits = () if result.pem_interval is None else result.pem_interval.warnings
    own = (warning for warning in result.warnings if warning not in about_answer)
    return (*own, *about_refits)


SourceKind = Literal["sampling", "lost", "reference", "refits", "model-classes", "memory", "data"]


@dataclass(frozen=True)
class UncertaintySource:
    """One source of doubt.

    Attributes:
        kind: Which.
        name: In words.
        low: Lower end; ``None`` where it is not known.
        high: Upper end; ``None`` likewise.
        note: Which models the ends belong to, or why there are none.
        narrowed_by: What would narrow it.
    """

    kind: SourceKind
    name: str
    low: float | None
    high: float | None
    note: str
    narrowed_by: str


def uncertainty_budget(result: RunResult) -> tuple[UncertaintySource, ...]:
    """What leaves a result open, sampling first; nothing without an estimate."""
    return tuple(_sources(result)) if result.estimate is not None else ()


def _sources(result: RunResult) -> Iterator[UncertaintySource]:
    estimate, caveats = result.estimate, run_interval_caveats(result)
    assert estimate is not None  # noqa: S101  checked before
    better = remedy_of(result, run_diagnostics(result))
    yield UncertaintySource(
        kind="sampling",
        name=f"sampling, {'not a ' if caveats else ''}{100.0 * estimate.confidence:g} % interval",
        low=estimate.ci_low,
        high=estimate.ci_high,
        note=caveats[0] if caveats else "",
        narrowed_by=better if caveats else by_name(result.config.method).narrows,
    )
    if result.lost is not None:
        low, high = result.lost.ends(estimate.probability)
        yield UncertaintySource(
            kind="lost",
            name=f"{result.lost.count} rollouts that could not be simulated",
            low=low,
            high=high,
            note="",
            narrowed_by="a simulator that does not break at them",
        )
    if (reference := result.reference) is not None:
        sampled = "exact reference (+- 2 standard errors)"
        yield UncertaintySource(
            kind="reference",
            name=sampled if reference.std_error else "exact, over all of the few states",
            low=max(reference.probability - 2.0 * reference.std_error, 0.0),
            high=reference.probability + 2.0 * reference.std_error,
            note="",
            narrowed_by="nothing is left to narrow",
        )
    if result.is_of_detector_itself:  # nothing of an error model is taken for granted
        return
    name, interval = f"refits of {result.pem.name}", result.pem_interval
    if interval is None:
        yield UncertaintySource(
            kind="refits",
            name=name,
            low=None,
            high=None,
            note="the model has no ensemble, or nothing failed",
            narrowed_by="pemviz pem fit --members 20",
        )
    else:
        yield UncertaintySource(
            kind="refits",
            name=f"{name} ({100 * interval.confidence:g} % of {interval.members})",
            low=0.0 if interval.low is None else interval.low,
            high=interval.high,
            note="",
            narrowed_by="more labelled obstacles",
        )
    if result.model_classes:
        yield _model_classes(result)
    yield _memory(result)
    bound, name = result.data_bound, "the training data alone"
    if bound is None:
        yield UncertaintySource(
            kind="data",
            name=name,
            low=None,
            high=None,
            note="the model carries no counts of its data, or the scenario has no fast twin",
            narrowed_by="a model fitted by pemviz pem fit",
        )
    else:
        yield UncertaintySource(
            kind="data",
            name=f"{name} ({100 * bound.confidence:g} %)",
            low=0.0,
            high=bound.probability,
            note="",
            narrowed_by="labels where there are few",
        )


def _model_classes(result: RunResult) -> UncertaintySource:
    ranked = sorted(result.model_classes, key=lambda answer: answer.log10_probability)
    vague = [answer.name for answer in ranked if not answer.is_reliable]
    named = f"{ranked[0].name} to {ranked[-1].name}" if len(ranked) > 1 else ranked[0].name
    return UncertaintySource(
        kind="model-classes",
        name=f"other model classes ({named})",
        low=ranked[0].probability,
        high=ranked[-1].probability,
        note=f"{', '.join(vague)} only roughly" if vague else "",
        narrowed_by="labels where they disagree",
    )


def _memory(result: RunResult) -> UncertaintySource:
    memory = result.memory or RunMemory(tau_s=0.0)
    points = (*memory.curve, *memory.frailty_curve, *(one.point for one in memory.measured))
    low, high = ends_of(points)
    narrows = "tracked video of this detector" if points else memory_option(result)
    beside = visibility_option(result)
    return UncertaintySource(
        kind="memory",
        name=f"memory of misses, {_memory_words(memory)}",
        low=low,
        high=high,
        note=f"without the model's other law: {memory.left_out}" if memory.left_out else "",
        narrowed_by=f"{narrows}, {beside}" if beside else narrows,
    )


def _memory_words(memory: RunMemory) -> str:
    """What was assumed of it, or over which memories the answer is known."""
    if memory.curve:
        between = f"{memory.curve[0].tau_s:g} to {memory.curve[-1].tau_s:g} s"
        over_frailty = memory.frailty_curve
        return between + (f", frailty to {over_frailty[-1].frailty:g}" if over_frailty else "")
    own = memory.fitted
    if memory.measured and own is not None and memory.is_own:
        return f"its own, {own.low_s:.2g} to {own.high_s:.2g} s"
    if memory.measured:
        return "as measured on video"
    if memory.hidden:
        known = "measured" if memory.is_own_visibility else "assumed"
        return f"{' and '.join(memory.hidden)} {known}"
    parts = [f"{memory.tau_s:.2g} s"] if memory.tau_s else []
    parts += [f"frailty {memory.frailty:.2g}"] if memory.frailty else []
    if not parts:
        return "taken as none"
    return f"{', '.join(parts)} {'measured' if memory.is_own else 'assumed'}"


def ends_of(points: Iterable[CurvePoint]) -> tuple[float | None, float | None]:
    """The lowest and the highest end of answers' intervals; ``None`` without any."""
    every = tuple(points)
    return (
        min((point.low for point in every if point.low is not None), default=None),
        max((point.high for point in every if point.high is not None), default=None),
    )
