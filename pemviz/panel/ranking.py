"""The rollouts of a run ranked from what is stored; nothing is simulated.

By robustness under any metric, or by what each contributes to the answer; all of them, or those
that carry the answer (:mod:`pemviz.analysis.contribution`).
"""

import csv
import io
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from pemviz import stl
from pemviz.analysis.contribution import carrying
from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import MetricName
from pemviz.panel.contribution import shares
from pemviz.panel.run_data import RunData, signals_of, verdicts
from pemviz.runs.rollout_files import latents_of
from pemviz.runs.slot_outcomes import slots_of
from pemviz.runs.specification import build_formula, build_metric, may_leave_bounds
from pemviz.sampling.elite_threshold import elite_threshold
from pemviz.sampling.elite_threshold import elites as elites_of_stage
from pemviz.types import Simulator

Among = Literal["carrying", "all"]


@dataclass(frozen=True)
class Ranking:
    """Rollouts under one metric.

    Attributes:
        metric: Its name.
        robustness: ``[N]`` in the order of the run's tables.
        share: ``[N]`` of the answer that each contributes.
        order: ``[M]`` indices into the tables of those that are ranked, first ranks first.
        among: Which are ranked: those that carry the answer or, as long as none does, all.
        by_share: Whether the largest share comes first, and not the least robust.
        rule: The rule whose robustness and answer these are; ``None``: the specification.
    """

    metric: MetricName
    robustness: FloatArray
    share: FloatArray
    order: IntArray
    among: Among
    by_share: bool = False
    rule: str | None = None


def rank(
    run: RunData,
    metric: MetricName,
    *,
    among: Among = "all",
    by_share: bool = False,
    rule: str | None = None,
) -> Ranking:
    """Rank a run's rollouts; scores are computed once for a run, a metric and a rule.

    Raises:
        InputError: The metric cannot score them: agm, with bounds that rollouts leave.
    """
    return run.memo.get(
        ("ranking", metric, among, by_share, rule),
        lambda: _rank(run, metric, among=among, by_share=by_share, rule=rule),
    )


def _rank(
    run: RunData, metric: MetricName, *, among: Among, by_share: bool, rule: str | None
) -> Ranking:
    robustness = run.memo.get(("robustness", metric, rule), lambda: _robustness(run, metric, rule))
    share = shares(run, rule=rule) if run.parts else np.empty(0)
    carries = carrying(share)
    chosen = np.arange(share.size)
    if among == "carrying" and carries.any():
        chosen = np.flatnonzero(carries)
    else:
        among = "all"
    keys = (robustness[chosen], -share[chosen])
    order = chosen[np.lexsort(keys if by_share else keys[:1])].astype(np.int64)
    return Ranking(
        metric=metric, robustness=robustness, share=share, order=order, among=among,
        by_share=by_share, rule=rule,
    )  # fmt: skip


def _robustness(run: RunData, metric: MetricName, rule: str | None) -> FloatArray:
    """Robustness ``[N]`` under the metric, of the specification or of one rule."""
    if not run.parts:
        return np.empty(0)
    if rule is None and metric == run.config.metric:
        return np.asarray(run.rollouts["robustness"], dtype=np.float64)
    simulator = cast(Simulator, run.simulator)
    formulas = {None: run.config.spec} | {one.name: one.formula for one in run.config.rules}
    config = replace(run.config, metric=metric, spec=formulas[rule], rules=())
    formula = build_formula(config, simulator)
    beyond = latents_of(run.rollouts) is not None or may_leave_bounds(simulator)
    scale = build_metric(config, simulator, beyond=beyond)
    return np.asarray(stl.robustness(formula, signals_of(run), scale), dtype=np.float64)


@dataclass(frozen=True)
class RankedRow:
    """A row of the ranking table."""

    rank: int
    index: int
    repetition: int
    stage: int
    rollout: int
    robustness: float
    violated: bool
    broken: tuple[str, ...]
    log_weight: float
    share: float
    misses: int


def row(run: RunData, ranking: Ranking, place: int) -> RankedRow:
    """The row at a zero-based place."""
    index = int(ranking.order[place])
    table = run.rollouts
    return RankedRow(
        rank=place + 1,
        index=index,
        repetition=int(table["repetition"][index]),
        stage=int(table["stage"][index]),
        rollout=int(table["rollout"][index]),
        robustness=float(ranking.robustness[index]),
        violated=bool(verdicts(table, rule=ranking.rule)[index]),
        broken=tuple(
            rule.name for rule in run.config.rules if verdicts(table, rule=rule.name)[index]
        ),
        log_weight=float(run.log_weight[index]),
        share=float(ranking.share[index]),
        misses=_errors(run, index),
    )


def _errors(run: RunData, index: int) -> int:
    """How often perception errs in a rollout, in whichever slot."""
    detected, slots = run.rollouts["detected"][index], slots_of(run.simulator)
    nominal = np.array([slot.nominal for slot in slots], dtype=np.bool_) if slots else True
    return int(np.count_nonzero(detected != nominal))


def elites(run: RunData, ranking: Ranking, *, sigma: float) -> BoolArray:
    """Which rollouts ``[N]`` their stage would learn from under the ranking's metric.

    Every stage has a level gamma_kappa of its own, never below 0; see
    :mod:`pemviz.sampling.elite_threshold`.
    """
    chosen = np.zeros(ranking.robustness.size, dtype=np.bool_)
    stages = np.stack([run.rollouts["repetition"], run.rollouts["stage"]], axis=1)
    for stage in np.unique(stages, axis=0):
        rows = np.flatnonzero((stages == stage).all(axis=1))
        robustness = ranking.robustness[rows]
        threshold = elite_threshold(robustness, sigma=sigma)
        chosen[rows] = elites_of_stage(robustness, threshold=threshold)
    return chosen


def ranking_csv(run: RunData, ranking: Ranking) -> str:
    """All rows as comma-separated values, with a header that names units.

    Where there are rules, ``breaks`` names those that a rollout breaks, separated by blanks.
    """
    text = io.StringIO()
    writer = csv.writer(text)
    rules = ["breaks"] if run.config.rules else []
    writer.writerow(
        ["rank", "repetition", "stage", "rollout", f"robustness_{ranking.metric}", "violated",
         "share_of_answer", "log_weight_nats", "pem_nll_nats", "misses", *rules]
    )  # fmt: skip
    for place in range(ranking.order.size):
        entry = row(run, ranking, place)
        writer.writerow(
            [entry.rank, entry.repetition, entry.stage, entry.rollout, repr(entry.robustness),
             entry.violated, repr(entry.share), repr(entry.log_weight),
             repr(float(run.pem_nll[entry.index])), entry.misses,
             *(" ".join(entry.broken) for _ in rules)]
        )  # fmt: skip
    return text.getvalue()
