"""The uncertainty budget: how far an answer is open, by what leaves it open.

Each source bounds the failure probability as far as one source of doubt goes, from the sampling
error to what the training data alone allow. Sources are not added up: each takes for granted what
the others doubt.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_interval_caveats
from pemviz.sampling.estimates.trust import remedy

SourceKind = Literal["sampling", "reference", "refits", "model-classes", "memory", "data"]


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
    yield _sampling(result)
    if result.reference is not None:
        yield _reference(result)
    yield _refits(result)
    if result.model_classes:
        yield _model_classes(result)
    yield _memory(result)
    yield _data(result)


def _sampling(result: RunResult) -> UncertaintySource:
    estimate, caveats = result.estimate, run_interval_caveats(result)
    assert estimate is not None  # noqa: S101  asked before
    level = f"{100.0 * estimate.confidence:g} %"
    better = remedy(estimate.method, latents=result.latents is not None)
    return UncertaintySource(
        kind="sampling",
        name=f"sampling, {'not a ' if caveats else ''}{level} interval",
        low=estimate.ci_low,
        high=estimate.ci_high,
        note=caveats[0] if caveats else "",
        narrowed_by=better if caveats else "four times the rollouts",
    )


def _reference(result: RunResult) -> UncertaintySource:
    reference = result.reference
    assert reference is not None  # noqa: S101  asked before
    sampled = "exact reference (+- 2 standard errors)"
    return UncertaintySource(
        kind="reference",
        name=sampled if reference.std_error else "exact, over all of the few states",
        low=max(reference.probability - 2.0 * reference.std_error, 0.0),
        high=reference.probability + 2.0 * reference.std_error,
        note="",
        narrowed_by="nothing is left to narrow",
    )


def _refits(result: RunResult) -> UncertaintySource:
    interval, model = result.pem_interval, result.pem.name
    if interval is None:
        return UncertaintySource(
            kind="refits",
            name=f"refits of {model}",
            low=None,
            high=None,
            note="the model has no ensemble, or nothing failed",
            narrowed_by="pemviz pem fit --ensemble",
        )
    return UncertaintySource(
        kind="refits",
        name=f"refits of {model} ({100 * interval.confidence:g} % of {interval.members})",
        low=0.0 if interval.low is None else interval.low,
        high=interval.high,
        note="",
        narrowed_by="more labelled obstacles",
    )


def _model_classes(result: RunResult) -> UncertaintySource:
    ranked = sorted(result.model_classes, key=lambda answer: answer.log10_probability)
    vague = [answer.name for answer in ranked if not answer.is_reliable]
    named = f"{ranked[0].name} to {ranked[-1].name}" if len(ranked) > 1 else ranked[0].name
    note = f"{', '.join(vague)} only roughly" if vague else ""
    return UncertaintySource(
        kind="model-classes",
        name=f"other model classes ({named})",
        low=ranked[0].probability,
        high=ranked[-1].probability,
        note=note,
        narrowed_by="labels where they part",
    )


def _memory(result: RunResult) -> UncertaintySource:
    tau_s = 0.0 if result.memory is None else result.memory.tau_s
    frailty = 0.0 if result.memory is None else result.memory.frailty
    own = None if result.memory is None else result.memory.fitted
    curve = () if result.memory is None else result.memory.curve
    over_frailty = () if result.memory is None else result.memory.frailty_curve
    lows = [point.low for point in (*curve, *over_frailty) if point.low is not None]
    highs = [point.high for point in (*curve, *over_frailty) if point.high is not None]
    assumed = f"{tau_s:g} s assumed" if tau_s > 0.0 else "taken as none"
    if frailty > 0.0:
        assumed = f"{tau_s:g} s and frailty {frailty:g} assumed"
    if result.memory is not None and result.memory.hidden:
        assumed = f"{' and '.join(result.memory.hidden)} assumed"
    name = f"memory of misses, {assumed}"
    if curve:
        between = f"{curve[0].tau_s:g} to {curve[-1].tau_s:g} s"
        name = f"memory of misses, {between}"
        if over_frailty:
            name = f"memory {between}, frailty to {over_frailty[-1].frailty:g}"
    measured = "" if own is None else f"measured {own.tau_s:.2g} s"
    if own is not None and own.frailty:
        measured += f", frailty {own.frailty:.2g}"
    return UncertaintySource(
        kind="memory",
        name=name,
        low=min(lows, default=None),
        high=max(highs, default=None),
        note=measured,
        narrowed_by="tracked video" if curve else "--memory-curve bounds it",
    )


def _data(result: RunResult) -> UncertaintySource:
    bound = result.data_bound
    if bound is None:
        return UncertaintySource(
            kind="data",
            name="the training data alone",
            low=None,
            high=None,
            note="the model carries no counts of its data, or the scenario has no fast twin",
            narrowed_by="a model fitted by pemviz pem fit",
        )
    return UncertaintySource(
        kind="data",
        name=f"the training data alone ({100 * bound.confidence:g} %)",
        low=0.0,
        high=bound.probability,
        note="",
        narrowed_by="labels where there are few",
    )
