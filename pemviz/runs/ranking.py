"""Which rollouts a result lists first and a run folder keeps: the least robust that carry it.

Those that carry the estimate (:mod:`pemviz.analysis.causes`) come before the others, each by
robustness; the first are :attr:`pemviz.runs.result.RunResult.least_robust`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pemviz.analysis.causes import CARRIED, carrying, contributions
from pemviz.arrays import AnyArray, IntArray
from pemviz.config import KeepName
from pemviz.runs.result import RankedRollout, RunResult, StageSummary
from pemviz.runs.rollout_files import log_weights
from pemviz.sampling.rollouts.large_stages import log_p_of
from pemviz.types import StageResult, numbers_of

LEAST_ROBUST = 20


def summarise_stage(stage: StageResult) -> StageSummary:
    """The stage's figures; an infinite threshold or loss is none."""

    def finite(value: float | None) -> float | None:
        return value if value is not None and math.isfinite(value) else None

    return StageSummary(
        repetition=stage.repetition,
        stage=stage.stage,
        kind=stage.kind,
        rollouts=stage.count,
        threshold=finite(stage.threshold),
        elites=stage.elites,
        failures=stage.failures,
        probability=stage.probability,
        log10_probability=stage.log10_probability,
        ess=stage.ess,
        loss=finite(stage.loss),
    )


def with_stage(result: RunResult, stage: StageResult) -> RunResult:
    """The result with one more stage: its figures, ranking and timings."""
    timings_s = dict(result.timings_s)
    for part, seconds in stage.timings_s.items():
        timings_s[part] = timings_s.get(part, 0.0) + seconds
    stages = (*result.stages, summarise_stage(stage))
    weighty = _weighty_stages(stages)

    def least(before: Sequence[RankedRollout], rule: str | None) -> tuple[RankedRollout, ...]:
        ranked = sorted(
            (*before, *_rank_rollouts(stage, rule)),
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


def _weighty_stages(stages: Sequence[StageSummary]) -> set[tuple[int, int]]:
    """The final stages, by repetition and stage, without which the estimate would be another."""
    final = [
        (stage, stage.log10_probability)
        for stage in stages
        if stage.kind == "final" and stage.log10_probability is not None
    ]
    least = max((log10 for _, log10 in final), default=0.0) + math.log10(1.0 - CARRIED)
    return {(stage.repetition, stage.stage) for stage, log10 in final if log10 >= least}


def _rank_rollouts(stage: StageResult, rule: str | None) -> list[RankedRollout]:
    """A stage's rollouts that a result would list first, by a rule or the specification."""
    scored, chosen = stage.scored, stage.scored.rollouts
    robustness = scored.robustness if rule is None else scored.rule_robustness[rule]
    violated = scored.violated if rule is None else scored.broken[rule]
    share = np.zeros(chosen.count)
    if stage.kind == "final":
        share = contributions(chosen.log_weight, violated=violated)
    carries = carrying(share)
    order = np.lexsort((robustness, ~carries))[:LEAST_ROBUST]
    number = numbers_of(chosen.count, stage.sampled)
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


def kept_rows(stage: StageResult, keep: KeepName) -> IntArray | None:
    """Rows of a stage's rollouts that its file holds, ascending; ``None``: all, unnumbered.

    A million rollouts of a hundred states take 4 GB, of which an answer rests on the violations
    alone. Every rollout that a result may list is kept too: the least robust, by each rule. A stage
    that is learned from is kept whole, or as far as it is held at all.
    """
    if keep == "all":
        return None
    scored = stage.scored
    if stage.kind != "final":
        return np.arange(scored.rollouts.count, dtype=np.int64)
    chosen = scored.violated.copy()
    for rule in (None, *scored.rule_robustness):
        chosen[[one.rollout for one in _rank_rollouts(stage, rule)]] = True
    return np.flatnonzero(chosen).astype(np.int64)


def ranked_rows(table: Mapping[str, AnyArray], stages: Sequence[StageSummary]) -> IntArray:
    """Rows ``[N]`` of a table of rollouts, in the order in which the run's result ranks them.

    Args:
        table: Under the keys of ``rollouts.npz``, stages in order.
        stages: The run's.

    Raises:
        ValueError: Latents do not fit together.
    """
    carries = np.zeros(table["violated"].shape, dtype=np.bool_)
    log_weight = log_weights(table)
    for repetition, stage in _weighty_stages(stages):
        rows = np.flatnonzero((table["repetition"] == repetition) & (table["stage"] == stage))
        if rows.size:
            violated = np.asarray(table["violated"][rows], dtype=np.bool_)
            carries[rows] = carrying(contributions(log_weight[rows], violated=violated))
    robustness = np.asarray(table["robustness"], dtype=np.float64)
    return np.lexsort((robustness, ~carries)).astype(np.int64)
