"""What each rollout of a shown run contributes to the run's answer."""

import csv
import io
import math
from dataclasses import dataclass, replace
from typing import Literal, cast, get_args

import numpy as np

from pemviz import stl
from pemviz.analysis.causes import carrying, contributions
from pemviz.arrays import BoolArray, FloatArray, IntArray, row_sums
from pemviz.config import MetricName
from pemviz.panel.rollout_tables import by_stage, final_violations, in_stage, latent_names, verdicts
from pemviz.panel.run_data import Report, RunData, Scan, ScanProgress, row_parts
from pemviz.runs.drawn_rollout import slots_of
from pemviz.runs.specification import build_formula, build_metric, may_leave_bounds
from pemviz.sampling.method import elite_threshold
from pemviz.sampling.method import elites as elites_of_stage
from pemviz.types import Simulator

Among = Literal["carrying", "all"]
METRIC_NAMES: tuple[MetricName, ...] = get_args(MetricName)


def shares(run: RunData, *, rule: str | None = None) -> FloatArray:
    """The share ``[N]`` of the answer that each rollout of the final stages contributes.

    Of the answer to one rule, if it is given. All are 0 as long as no rollout of a final stage
    violates.
    """

    def compute() -> FloatArray:
        violated = final_violations(run.rollouts, stages=run.result.stages, rule=rule)
        return contributions(log_contributions(run), violated=violated)

    return run.memo.get(("shares", rule), compute)


def log_contributions(run: RunData) -> FloatArray:
    """Log weights ``[N]`` by which violations of one or several stages compare [nats].

    Where stages are independent runs of rollouts without weights, the runs differ by many
    powers of ten: a run's estimate is shared by its violations.
    """
    log_weight = np.array(run.log_weight)
    if run.method.has_likelihood_ratios:
        return log_weight
    for stage in run.result.stages:
        if stage.log10_probability is not None and stage.failures:
            share = math.log(10.0) * stage.log10_probability - math.log(stage.failures)
            log_weight[in_stage(run.rollouts, stage)] += share
    return log_weight


@dataclass(frozen=True)
class Ranking:
    """Rollouts under one metric.

    Attributes:
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
    robustness = run.scans.value(*_scoring(run, metric, rule))

    def compute() -> Ranking:
        share = shares(run, rule=rule) if run.parts else np.empty(0)
        carries = carrying(share)
        every = among == "all" or not carries.any()
        chosen = np.arange(share.size) if every else np.flatnonzero(carries)
        order = chosen[np.argsort(robustness[chosen], kind="stable")]
        if by_share:
            order = order[np.argsort(-share[order], kind="stable")]
        ranked: Among = "all" if every else "carrying"
        return Ranking(metric, robustness, share, order.astype(np.int64), ranked, by_share, rule)

    return run.memo.get(("ranking", metric, among, by_share, rule), compute)


def scoring(run: RunData, metric: MetricName, *, rule: str | None = None) -> ScanProgress | None:
    """Have the scores that :func:`rank` needs computed; ``None`` once they are there.

    It returns at once: scores of a large run are computed on a thread of their own.
    """
    return run.scans.begin(*_scoring(run, metric, rule), count=run.kept)


def _scoring(run: RunData, metric: MetricName, rule: str | None) -> tuple[object, Scan[FloatArray]]:
    return ("robustness", metric, rule), lambda report: _robustness(run, metric, rule, report)


def _robustness(run: RunData, metric: MetricName, rule: str | None, report: Report) -> FloatArray:
    """Robustness ``[N]`` under the metric, of the specification or of one rule."""
    if not run.parts:
        return np.empty(0)
    if rule is None and metric == run.config.metric:
        return np.asarray(run.rollouts["robustness"], dtype=np.float64)
    simulator = cast(Simulator, run.simulator)
    formulas = {None: run.config.spec} | {one.name: one.formula for one in run.config.rules}
    config = replace(run.config, metric=metric, spec=formulas[rule], rules=())
    formula = build_formula(config, simulator)
    beyond = bool(latent_names(run.rollouts)) or may_leave_bounds(simulator)
    scale = build_metric(config, simulator, beyond=beyond)
    found = np.empty(run.kept)
    for rows in row_parts(run.kept):
        found[rows] = stl.robustness(formula, run.signals(rows), scale)
        report(rows.stop)
    return found


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
        misses=int(_error_counts(run, index)[0]),
    )


def _error_counts(run: RunData, rows: int | slice) -> IntArray:
    """How often perception errs in rollouts ``[R]``, in whichever slot."""
    detected, slots = run.steps(["detected"], rows)["detected"], slots_of(run.simulator)
    nominal = np.array([slot.nominal for slot in slots], dtype=np.bool_) if slots else True
    wrong = detected != nominal
    return np.count_nonzero(wrong, axis=tuple(range(1, wrong.ndim))).astype(np.int64)


def elites(run: RunData, ranking: Ranking, *, sigma: float) -> BoolArray:
    """Which rollouts ``[N]`` their stage would learn from under the ranking's metric.

    Every stage has a level gamma_kappa of its own, never below 0; see
    :mod:`pemviz.sampling.method`.
    """
    chosen = np.zeros(ranking.robustness.size, dtype=np.bool_)
    for rows in by_stage(run.rollouts):
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
    table = run.rollouts
    broken = {one.name: verdicts(table, rule=one.name) for one in run.config.rules}
    violated = verdicts(table, rule=ranking.rule)
    columns = [table[name] for name in ("repetition", "stage", "rollout")]
    misses, nll, log_weight = np.empty(run.kept, np.int64), np.empty(run.kept), run.log_weight
    for rows in row_parts(run.kept):
        misses[rows] = _error_counts(run, rows)
        nll[rows] = -row_sums(np.asarray(run.steps(["log_p"], rows)["log_p"], np.float64))
    for place, index in enumerate(ranking.order.tolist()):
        names = " ".join(name for name, breaks in broken.items() if breaks[index])
        writer.writerow(
            [place + 1, *(int(column[index]) for column in columns),
             repr(float(ranking.robustness[index])), bool(violated[index]),
             repr(float(ranking.share[index])), repr(float(log_weight[index])),
             repr(float(nll[index])), int(misses[index]), *(names for _ in rules)]
        )  # fmt: skip
    return text.getvalue()
