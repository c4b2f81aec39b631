"""The result of a run, and the JSON document that files and scripts read."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pemviz.analysis.explanation import Explanation
from pemviz.analysis.model_uncertainty import DataBound, ModelInterval
from pemviz.arrays import row_sums
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_table
from pemviz.errors import InputError
from pemviz.sampling.estimates.diagnostics import MEANINGS, classified
from pemviz.sampling.value_twisted.reference import Reference
from pemviz.types import Diagnostic, Estimate, StageKind, StageResult

SCHEMA = 1
LEAST_ROBUST = 20
ALWAYS_KNOWN = ("method", "probability", "rollouts_simulated", "failures", "confidence")
"""Of an estimate; everything else may be undefined."""

RunStatus = Literal["done", "stopped", "failed"]


@dataclass(frozen=True)
class PemInfo:
    """Which perception error model a result rests on.

    Attributes:
        name: As loaded.
        digest: SHA-256 of its content.
        data: What it was trained on.
    """

    name: str
    digest: str
    data: str


@dataclass(frozen=True)
class StageSummary:
    """A stage without its rollouts; see :class:`pemviz.types.StageResult`."""

    repetition: int
    stage: int
    kind: StageKind
    rollouts: int
    threshold: float | None
    elites: int
    failures: int
    probability: float
    log10_probability: float | None
    ess: float | None
    loss: float | None


@dataclass(frozen=True)
class RankedRollout:
    """One of the least robust rollouts of a run.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        robustness: Under the run's metric.
        violated: The classical verdict.
        nll: Its negative log-likelihood under the perception error model [nats].
        log_weight: Its log importance weight [nats].
        misses: How many steps missed.
    """

    repetition: int
    stage: int
    rollout: int
    robustness: float
    violated: bool
    nll: float
    log_weight: float
    misses: int


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """Everything a run tells, but for the rollouts themselves.

    Attributes:
        reference: The answer by the value-twisted reference, if it was asked for.
        pem_interval: The answer's range over other models that fit the same data.
        data_bound: What the model's training data alone allow.
        explanation: Where and when the detector misses before violations, and what would help.
        warnings: About the model and its data; those about sampling are the estimates' own.
        message: Why the run failed, if it did.
    """

    run_id: str
    status: RunStatus
    config: ExperimentConfig
    pem: PemInfo
    versions: Mapping[str, str]
    assumptions: tuple[str, ...]
    estimate: Estimate | None = None
    repetitions: tuple[Estimate, ...] = ()
    stages: tuple[StageSummary, ...] = ()
    least_robust: tuple[RankedRollout, ...] = ()
    reference: Reference | None = None
    pem_interval: ModelInterval | None = None
    data_bound: DataBound | None = None
    explanation: Explanation | None = None
    warnings: tuple[str, ...] = ()
    timings_s: Mapping[str, float] = field(default_factory=dict[str, float])
    message: str | None = None


def summarise_stage(stage: StageResult) -> StageSummary:
    """The stage's figures."""
    return StageSummary(
        repetition=stage.repetition,
        stage=stage.stage,
        kind=stage.kind,
        rollouts=stage.scored.rollouts.count,
        threshold=stage.threshold,
        elites=stage.elites,
        failures=stage.failures,
        probability=stage.probability,
        log10_probability=stage.log10_probability,
        ess=stage.ess,
        loss=stage.loss,
    )


def with_stage(result: RunResult, stage: StageResult) -> RunResult:
    """The result with one more stage: its figures, ranking and timings."""
    timings_s = dict(result.timings_s)
    for part, seconds in stage.timings_s.items():
        timings_s[part] = timings_s.get(part, 0.0) + seconds
    ranked = sorted(
        (*result.least_robust, *rank_rollouts(stage)),
        key=lambda r: (r.robustness, r.repetition, r.stage, r.rollout),
    )
    return replace(
        result,
        stages=(*result.stages, summarise_stage(stage)),
        least_robust=tuple(ranked[:LEAST_ROBUST]),
        timings_s=timings_s,
    )


def rank_rollouts(stage: StageResult, *, count: int = LEAST_ROBUST) -> Sequence[RankedRollout]:
    """The stage's ``count`` least robust rollouts, least robust first."""
    scored = stage.scored
    order = np.argsort(scored.robustness, kind="stable")[:count]
    chosen = scored.rollouts
    nll = -row_sums(chosen.log_p[order])
    return [
        RankedRollout(
            repetition=stage.repetition,
            stage=stage.stage,
            rollout=int(index),
            robustness=float(scored.robustness[index]),
            violated=bool(scored.violated[index]),
            nll=float(nll[place]),
            log_weight=float(chosen.log_weight[index]),
            misses=int(np.count_nonzero(~chosen.detected[index])),
        )
        for place, index in enumerate(order)
    ]


def result_document(result: RunResult) -> dict[str, Any]:
    """The contents of ``result.json``: strict JSON, null where a figure is undefined."""
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "run_id": result.run_id,
        "status": result.status,
        "message": result.message,
        "seed": result.config.seed,
        "versions": dict(result.versions),
        "config": config_table(result.config),
        "pem": asdict(result.pem),
        "estimate": None if result.estimate is None else estimate_document(result.estimate),
        "reference": None if result.reference is None else asdict(result.reference),
        "pem_interval": None if result.pem_interval is None else asdict(result.pem_interval),
        "data_bound": None if result.data_bound is None else asdict(result.data_bound),
        **_explanation_document(result.explanation),
        "repetitions": [estimate_document(estimate) for estimate in result.repetitions],
        "stages": [asdict(stage) for stage in result.stages],
        "least_robust": [asdict(rollout) for rollout in result.least_robust],
        "assumptions": list(result.assumptions),
        "warnings": list(result.warnings),
        "timings_s": dict(result.timings_s),
    }
    return _strict(document)


def estimate_document(estimate: Estimate) -> dict[str, Any]:
    """One estimate as JSON values."""
    table = asdict(estimate)
    probability = table.pop("unbiased_probability")
    std_error = table.pop("unbiased_std_error")
    table["unbiased"] = {"probability": probability, "std_error": std_error}
    table["warnings"] = list(estimate.warnings)
    return table


def estimate_from_document(document: Mapping[str, Any]) -> Estimate:
    """The inverse of :func:`estimate_document`.

    Raises:
        InputError: A value is missing.
    """
    table: dict[str, Any] = dict(document)
    unknown = [name for name in ALWAYS_KNOWN if table.get(name) is None]
    if unknown:
        message = f"estimate: {', '.join(unknown)} is missing"
        raise InputError(message)
    try:
        unbiased = table.pop("unbiased")
        table["unbiased_probability"] = unbiased["probability"]
        table["unbiased_std_error"] = unbiased["std_error"]
        warnings, diagnostics = table.pop("warnings"), table.pop("diagnostics", None)
        found = Estimate(**table)
        return replace(found, diagnostics=diagnostics_read(diagnostics, warnings, of=found))
    except (KeyError, TypeError) as error:
        message = f"estimate: not as pemviz writes it ({error})"
        raise InputError(message) from error


def diagnostics_read(
    diagnostics: Sequence[Any] | None, warnings: Sequence[Any], *, of: Estimate
) -> tuple[Diagnostic, ...]:
    """The diagnostics of an estimate in a document.

    Args:
        diagnostics: As the document has them; ``None`` in one of an older version.
        warnings: Their texts.
        of: The estimate's figures.

    Raises:
        InputError: They are not as pemviz writes them.
    """
    if not all(isinstance(text, str) for text in warnings):
        message = "estimate.warnings: must be texts"
        raise InputError(message)
    if diagnostics is None:
        return classified(warnings, of)
    found = tuple(Diagnostic(**entry) for entry in diagnostics)
    for one in found:
        figures = [figure for figure in (one.value, one.limit) if figure is not None]
        if one.kind not in MEANINGS or not all(type(f) in (int, float) for f in figures):
            message = f"estimate.diagnostics: {str(one.kind)[:60]!r} is none that pemviz writes"
            raise InputError(message)
    if [one.text for one in found] != list(warnings):
        message = "estimate.warnings: must be the texts of its diagnostics"
        raise InputError(message)
    return found


def _explanation_document(explanation: Explanation | None) -> dict[str, Any]:
    if explanation is None:
        return {"sensitivity": None, "causes": None}
    causes = asdict(explanation)
    return {"sensitivity": causes.pop("sensitivity"), "causes": causes}


def _strict(value: Any) -> Any:
    """``value`` with every number that JSON cannot hold replaced by null."""
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
