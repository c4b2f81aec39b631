"""The result of a run: everything that it tells, but for the rollouts themselves.

:mod:`pemviz.runs.result_file` writes it to ``result.json`` and reads it back; the types and
ranges of the fields here, and of the types that they name, say what may stand there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np

from pemviz.analysis.causes import CARRIED, carrying, contributions
from pemviz.analysis.data_plan import DataPlan
from pemviz.analysis.explanation import Explanation
from pemviz.analysis.model_uncertainty import DataBound, ModelClassAnswer, ModelInterval
from pemviz.analysis.robustness_tail import RobustnessTail
from pemviz.analysis.starts import DangerousStarts
from pemviz.config import ExperimentConfig
from pemviz.config.ranges import AtLeastZero, Count, Log10, Range, Share
from pemviz.latents import LatentCounts
from pemviz.pem import PositionErrorModel
from pemviz.runs.memory import RunMemory
from pemviz.runs.rules import RuleAnswer
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.types import Estimate, ShownInNotebooks, StageKind, StageResult, numbers_of

LEAST_ROBUST = 20

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


def position_info(model: PositionErrorModel | None) -> PemInfo | None:
    """Which position errors a result rests on."""
    if model is None:
        return None
    return PemInfo(name=model.name, digest=model.digest, data=model.card.data)


@dataclass(frozen=True)
class StageSummary:
    """A stage without its rollouts; see :class:`pemviz.types.StageResult`.

    ``threshold`` is ``None`` also where it is infinite: where the specification does not depend
    on the rollout.
    """

    repetition: Count
    stage: Count
    kind: StageKind
    rollouts: Count
    threshold: float | None
    elites: Count
    failures: Count
    probability: AtLeastZero
    log10_probability: Log10 | None
    ess: AtLeastZero | None
    loss: float | None


@dataclass(frozen=True)
class RankedRollout:
    """One of the least robust rollouts of a run.

    Attributes:
        repetition: Zero-based.
        stage: Its stage.
        rollout: Its index in the stage.
        robustness: Under the run's metric; infinite where the specification does not depend
            on the rollout, below 0 if it is violated then.
        violated: Whether the formula fails, see :func:`pemviz.stl.violated`.
        nll: Its negative log-likelihood under the perception error model [nats].
        log_weight: Its log importance weight [nats].
        misses: How many steps missed.
        share: What it contributes to its stage's estimate, if it is among the rollouts that carry
            that (:mod:`pemviz.analysis.causes`); ``None`` if it is not, or if the estimate
            does not rest on its stage.
        broken: The rules that it breaks, by name, where there are rules.
    """

    repetition: Count
    stage: Count
    rollout: Count
    robustness: float
    violated: bool
    nll: float
    log_weight: float
    misses: Count
    share: Share | None = None
    broken: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DrivenDistance:
    """How far the ego drives in a rollout.

    Attributes:
        mean_km: On average, under the error model [km].
        std_error_km: Of that [km].
        rollouts: By how many.
    """

    mean_km: Annotated[float, Range(low=1e-6, high=1e9)]
    std_error_km: AtLeastZero
    rollouts: Count


@dataclass(frozen=True, kw_only=True)
class RunResult(ShownInNotebooks):
    """Everything a run tells, but for the rollouts themselves.

    Attributes:
        run_id: The run's name, that of its folder.
        status: ``stopped`` also while it goes on, as that is what a kill would leave.
        config: What was asked.
        pem: The perception error model that was asked.
        versions: Of pemviz and of what the figures may depend on, by package.
        assumptions: What the answer takes for granted, in words.
        estimate: The answer; of several repetitions, their mean.
        repetitions: The estimate of each repetition that is done.
        rules: The answer to each rule, where there are rules; ``estimate`` then says how likely
            any of them is broken.
        stages: Every stage that is done.
        least_robust: The least robust of the rollouts that carry the estimate, least robust
            first, then the least robust of the others; of all as long as nothing carries one.
        least_robust_by_rule: Likewise of each rule by name, where there are rules: ranked by the
            robustness in that rule, shares of the answer to it.
        memory: What was assumed of how misses hang together, and what the model's own data say
            of it; ``None`` in results of versions that knew no memory.
        latents: How many standard normals the simulator took; ``None`` if none.
        position_errors: By which the scenario measured; ``None``: it measured exactly.
        driven: How far a rollout is, where it is a stretch of driving in free traffic.
        reference: The answer by the zero-variance reference, if it was asked for.
        pem_interval: The answer's range over other models that fit the same data.
        starts: Which starts are dangerous, where the simulator names random ones: of violations
            in all, then of each rule's.
        model_classes: The answer under other model classes that learnt from the same data.
        data_bound: What the model's training data alone allow.
        plan: What to measure next, if it was asked for.
        explanation: Where and when the detector misses before violations, and what would help.
        robustness_tail: Robustness expected and in the worst hundredth, under the error model;
            ``None`` where the rollouts do not tell.
        warnings: About the model and its data; those about sampling are the estimates' own.
        timings_s: Wall time by part of the work [s].
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
    rules: tuple[RuleAnswer, ...] = ()
    stages: tuple[StageSummary, ...] = ()
    least_robust: tuple[RankedRollout, ...] = ()
    least_robust_by_rule: Mapping[str, tuple[RankedRollout, ...]] = field(
        default_factory=dict[str, tuple[RankedRollout, ...]]
    )
    memory: RunMemory | None = None
    latents: LatentCounts | None = None
    position_errors: PemInfo | None = None
    driven: DrivenDistance | None = None
    reference: Reference | None = None
    pem_interval: ModelInterval | None = None
    starts: tuple[DangerousStarts, ...] = ()
    model_classes: tuple[ModelClassAnswer, ...] = ()
    data_bound: DataBound | None = None
    plan: DataPlan | None = None
    explanation: Explanation | None = None
    robustness_tail: RobustnessTail | None = None
    warnings: tuple[str, ...] = ()
    timings_s: Mapping[str, AtLeastZero] = field(default_factory=dict[str, float])
    message: str | None = None


def summarise_stage(stage: StageResult) -> StageSummary:
    """The stage's figures."""
    return StageSummary(
        repetition=stage.repetition,
        stage=stage.stage,
        kind=stage.kind,
        rollouts=stage.count,
        threshold=_finite(stage.threshold),
        elites=stage.elites,
        failures=stage.failures,
        probability=stage.probability,
        log10_probability=stage.log10_probability,
        ess=stage.ess,
        loss=_finite(stage.loss),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def with_stage(result: RunResult, stage: StageResult) -> RunResult:
    """The result with one more stage: its figures, ranking and timings."""
    timings_s = dict(result.timings_s)
    for part, seconds in stage.timings_s.items():
        timings_s[part] = timings_s.get(part, 0.0) + seconds
    stages = (*result.stages, summarise_stage(stage))
    weighty = weighty_stages(stages)

    def least(before: Sequence[RankedRollout], rule: str | None) -> tuple[RankedRollout, ...]:
        ranked = sorted(
            (*before, *rank_rollouts(stage, rule=rule)),
            key=lambda r: (
                r.share is None or (r.repetition, r.stage) not in weighty,
                r.robustness,
                r.repetition,
                r.stage,
                r.rollout,
            ),
        )
        return tuple(ranked[:LEAST_ROBUST])

    by_rule = {
        rule: least(result.least_robust_by_rule.get(rule, ()), rule)
        for rule in stage.scored.rule_robustness
    }
    return replace(
        result,
        stages=stages,
        least_robust=least(result.least_robust, None),
        least_robust_by_rule=by_rule,
        timings_s=timings_s,
    )


def weighty_stages(stages: Sequence[StageSummary]) -> set[tuple[int, int]]:
    """The final stages, by repetition and stage, without which the estimate would be another."""
    final = [
        (stage, stage.log10_probability)
        for stage in stages
        if stage.kind == "final" and stage.log10_probability is not None
    ]
    least = max((log10 for _, log10 in final), default=0.0) + math.log10(1.0 - CARRIED)
    return {(stage.repetition, stage.stage) for stage, log10 in final if log10 >= least}


def rank_rollouts(
    stage: StageResult, *, count: int = LEAST_ROBUST, rule: str | None = None
) -> Sequence[RankedRollout]:
    """The stage's ``count`` rollouts that :attr:`RunResult.least_robust` would list first.

    Args:
        stage: The stage.
        count: How many.
        rule: The rule that they are ranked by; ``None``: the specification.
    """
    scored = stage.scored
    chosen = scored.rollouts
    robustness = scored.robustness if rule is None else scored.rule_robustness[rule]
    violated = scored.violated if rule is None else scored.broken[rule]
    share = np.zeros(chosen.count)
    if stage.kind == "final":
        share = contributions(chosen.log_weight, violated=violated)
    carries = carrying(share)
    order = np.lexsort((robustness, ~carries))[:count]
    number = numbers_of(chosen.count, stage.drawn)
    nll = -log_p_of(chosen, order)
    return [
        RankedRollout(
            repetition=stage.repetition,
            stage=stage.stage,
            rollout=int(number[index]),
            robustness=float(robustness[index]),
            violated=bool(violated[index]),
            nll=float(nll[place]),
            log_weight=float(chosen.log_weight[index]),
            misses=int(np.count_nonzero(~chosen.detected[index])),
            share=min(float(share[index]), 1.0) if carries[index] else None,
            broken=tuple(name for name, broken in scored.broken.items() if broken[index]),
        )
        for place, index in enumerate(order)
    ]
