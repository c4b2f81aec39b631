"""The Why tab: which misses cause violations, and how far to trust the number."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from pemviz.analysis.contribution import contributions
from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.colors import BLACK, VERMILLION
from pemviz.panel.contribution import log_contributions
from pemviz.panel.run_data import RunData
from pemviz.panel.tables import final_violations
from pemviz.panel.views.models import models_part
from pemviz.panel.views.page import PLOT_PX, cell, page, wide
from pemviz.reports.pictures.causes import cause_sections
from pemviz.reports.pictures.data_plan import plan_part
from pemviz.reports.pictures.html import good, grid, heading, number, percent, quiet, warning
from pemviz.reports.pictures.memory import memory_curves
from pemviz.reports.pictures.starts import start_plane
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.reports.starts_text import (
    START_COLUMNS,
    STARTS_TITLE,
    map_words,
    start_rows,
    starts_line,
    starts_title,
)
from pemviz.runs.result import RunResult
from pemviz.runs.slot_outcomes import faultless, slots_of
from pemviz.runs.trust import data_warnings, run_diagnostics
from pemviz.sampling.estimates.meanings import RELIABLE_PARETO_K, SMALL_ESS
from pemviz.sampling.registry import by_name
from pemviz.simulators.slots import Slot
from pemviz.types import Estimate

BAND_M = 1.0
UNWEIGHTED = (
    "{}'s rollouts carry no weights, so there is nothing to diagnose and no sensitivity: "
    "its standard error comes from how far its independent runs differ."
)
MOST_BANDS = 250
MOST_EXPLAINED = 20_000


def why(run: RunData | None, *, target: str = "", start_target: str = "") -> str:
    """The whole tab.

    Args:
        run: The run shown.
        target: Element id of the input that a click on a chain writes its place into.
        start_target: The same of a click on a rollout in the plane of starts.
    """
    if run is None:
        return page(wide(quiet("Nothing has run yet.")))
    if run.running:
        return page(wide(quiet("Explained when the run under way is done.")))
    key = ("why", target, start_target)
    return run.memo.get(key, lambda: _why(run, target=target, start_target=start_target))


def _why(run: RunData, *, target: str, start_target: str) -> str:
    result = run.result
    return page(
        *map(cell, _misses(run)),
        *map(cell, cause_sections(result, target=target)),
        *map(cell, _starts(result, target=start_target)),
        cell(plan_part(result)),
        cell(_trust(run)),
        cell(models_part(result)),
        *map(cell, memory_curves(result.memory)),
        cell(_assumptions(run)),
        wide(_data(run)),
    )


def _starts(result: RunResult, *, target: str) -> list[str]:
    """Which starts are dangerous, of violations in all and of each rule's; a cell each."""
    cells: list[str] = []
    for found in result.starts:
        rows = [tuple(map(escape, row)) for row in start_rows(found)]
        picture = start_plane(found, target=target if found.points else "")
        words = f"{map_words(found)} Click a dot: that rollout shows." if found.points else ""
        cells.append(
            heading(f"{STARTS_TITLE}: {starts_title(found)}")
            + quiet(f"{starts_line(found)}.")
            + picture
            + quiet(words if picture else map_words(found))
            + grid(START_COLUMNS, rows, name=STARTS_TITLE)
        )
    return cells


@dataclass(frozen=True, eq=False)
class Failures:
    """The violating rollouts that explain the answer.

    Attributes:
        gap_m: ``[F, T-1]`` at the states where perception acted; ``None`` without a gap.
        missed: ``[F, T-1]``; with several slots, whether perception errs about any of them.
        pem_miss: ``[F, T-1]`` probability of that under the error model.
        weight: ``[F]`` importance weights, summing to 1.
        violations: How many violations these stand for, themselves included.
    """

    gap_m: FloatArray | None
    missed: BoolArray
    pem_miss: FloatArray
    weight: FloatArray
    violations: int


def failures_of(run: RunData) -> Failures | None:
    """Violations of the final stages, or of all stages if those have none."""
    if not run.parts:
        return None
    rollouts = run.rollouts
    chosen = final_violations(rollouts, stages=run.result.stages)
    if not np.any(chosen):
        chosen = np.asarray(rollouts["violated"], dtype=np.bool_)
    if not np.any(chosen):
        return None
    weight = contributions(log_contributions(run), violated=chosen)[chosen]
    places, weight = standing_for_all(weight, most=MOST_EXPLAINED)
    rows = np.flatnonzero(chosen)[places].astype(np.int64)
    gap_m = ["gap_m"] if run.own is None else []
    table = run.steps(["detected", "log_p", *gap_m], rows)
    detected = np.asarray(table["detected"], dtype=np.bool_)
    log_p = np.asarray(table["log_p"], dtype=np.float64)
    missed, pem_miss = ~detected, np.where(detected, -np.expm1(log_p), np.exp(log_p))
    if run.own is not None:
        slots = slots_of(run.own)
        missed, pem_miss = ~faultless(detected, slots=slots), _any_error(pem_miss, slots=slots)
    return Failures(
        gap_m=np.asarray(table["gap_m"][:, :-1], dtype=np.float64) if gap_m else None,
        missed=missed,
        pem_miss=pem_miss,
        weight=weight,
        violations=int(np.count_nonzero(chosen)),
    )


def standing_for_all(weight: FloatArray, *, most: int) -> tuple[IntArray, FloatArray]:
    """Places ``[M]`` of at most ``most`` of ``[N]`` weights, and weights ``[M]`` of the same sum.

    The heavier half is of the largest weights. Of the others, in the order of their weights, each
    chosen one stands for as many neighbours as any, and has the weight of them all.
    """
    if weight.size <= most:
        return np.arange(weight.size), weight
    order = np.argsort(-weight, kind="stable")
    heavy, rest = order[: most // 2], order[most // 2 :]
    edges = np.linspace(0, rest.size, most - heavy.size + 1).round().astype(np.int64)
    standing = weight.copy()
    middle = rest[(edges[:-1] + edges[1:]) // 2]
    standing[middle] = np.add.reduceat(weight[rest], edges[:-1])
    places = np.sort(np.concatenate([heavy, middle]))
    return places, standing[places]


def _any_error(missed: FloatArray, *, slots: Sequence[Slot]) -> FloatArray:
    """Probability that perception errs about any slot, from those of 'missed' of each."""
    nominal = np.array([slot.nominal for slot in slots] or [True], dtype=np.bool_)
    error = np.where(nominal if len(slots) > 1 else nominal[0], missed, 1.0 - missed)
    return 1.0 - np.prod(1.0 - error, axis=-1) if len(slots) > 1 else error


def _misses(run: RunData) -> list[str]:
    """Where and when violations miss, in two cells."""
    title = heading("Misses that cause violations")
    failures = failures_of(run)
    if failures is None:
        words = (
            "No rollout of this run violates: there is nothing to explain. Plain simulation "
            "hardly ever finds a violation; choose another method in the Experiment tab."
        )
        return [title + quiet(words)]
    hanging = run.config.memory_s or run.config.frailty
    given = ", given the outcomes before" if hanging else ""
    note = (
        "Bars: share of steps missed in violations, weighted by how likely each is under the "
        f"error model. Black: what the error model itself says{given}."
    )
    if failures.missed.shape[0] < failures.violations:
        note += (
            f" From {failures.missed.shape[0]:,} of {failures.violations:,} violations: the half "
            "of these that contribute most, and of the others an even choice, each of which "
            "stands for its neighbours in weight."
        )
    sentence = miss_sentence(failures, misses=deciding_misses(run), dt_s=_dt_s(run))
    where = title + quiet(sentence)
    if failures.gap_m is None:
        return [where + time_plot(failures, dt_s=_dt_s(run)) + quiet(note)]
    where += distance_plot(failures, failures.gap_m)
    return [where, time_plot(failures, dt_s=_dt_s(run)) + quiet(note)]


def _dt_s(run: RunData) -> float:
    return run.simulator.dt_s


def deciding_misses(run: RunData) -> float | None:
    """Misses of a violation where perception decides: the total of the table by distance."""
    explanation = run.result.explanation
    if explanation is None or not explanation.misses_by_distance:
        return None
    return sum(band.misses for band in explanation.misses_by_distance)


def miss_sentence(failures: Failures, *, misses: float | None, dt_s: float) -> str:
    """The chain of misses in words.

    Args:
        failures: The violating rollouts.
        misses: How many a violation has where perception decides; those of all steps are
            counted if that is not known.
        dt_s: Time step [s].
    """
    everywhere = float(np.sum(failures.weight * np.count_nonzero(failures.missed, axis=1)))
    count = everywhere if misses is None else misses
    where = "" if misses is None else " where perception decides"
    longest = float(np.sum(failures.weight * longest_runs(failures.missed)))
    words = (
        f"A violation takes {count:.1f} misses{where} on average, the longest unbroken chain being "
        f"{longest:.1f} steps ({longest * dt_s:.2f} s)."
    )
    if failures.gap_m is None:
        return words
    edges, share, _ = by_distance(failures, failures.gap_m)
    heavy = np.flatnonzero(np.nan_to_num(share) >= 0.5)
    if heavy.size:
        words += (
            f" Most steps between {edges[heavy[0]]:g} and {edges[heavy[-1] + 1]:g} m are missed."
        )
    return words


def longest_runs(missed: BoolArray) -> FloatArray:
    """The longest unbroken chain of misses ``[F]`` in each rollout."""
    longest = np.zeros(missed.shape[0])
    current = np.zeros(missed.shape[0])
    for step in range(missed.shape[1]):
        current = np.where(missed[:, step], current + 1, 0.0)
        longest = np.maximum(longest, current)
    return longest


def by_distance(failures: Failures, gap_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Edges ``[B+1]`` of gap bands, weighted share missed and the error model's ``[B]``."""
    high = max(BAND_M, float(np.ceil(np.max(gap_m))))
    band_m = BAND_M * max(1.0, float(np.ceil(high / (MOST_BANDS * BAND_M))))
    edges = np.arange(0.0, high + band_m / 2, band_m)
    weight = np.broadcast_to(failures.weight[:, None], gap_m.shape)
    inside = gap_m >= 0.0
    index = np.minimum((gap_m[inside] / band_m).astype(np.int64), edges.size - 2)

    def share(values: FloatArray) -> FloatArray:
        size = edges.size - 1
        total = np.bincount(index, weights=weight[inside], minlength=size)
        part = np.bincount(index, weights=(weight * values)[inside], minlength=size)
        return np.divide(part, total, out=np.full(size, np.nan), where=total > 0.0)

    return edges, share(failures.missed.astype(np.float64)), share(failures.pem_miss)


def distance_plot(failures: Failures, gap_m: FloatArray) -> str:
    """Share of steps missed by distance."""
    edges, missed, expected = by_distance(failures, gap_m)
    plot = Plot(
        title="Missed in violations, by distance",
        x=Axis(0.0, float(edges[-1]), "gap [m]"),
        y=Axis(0.0, 100.0, "steps missed [%]", ticks=(0.0, 50.0, 100.0)),
        height=200,
    )
    tips = [
        f"{edges[i]:g} to {edges[i + 1]:g} m: {100 * missed[i]:.0f} % missed, error model "
        f"{100 * expected[i]:.2g} %"
        for i in range(missed.size)
    ]
    plot.bars(edges, 100.0 * missed, color=VERMILLION, tips=tips)
    plot.line((edges[:-1] + edges[1:]) / 2, 100.0 * expected, color=BLACK, width=1.8)
    return plot.text()


def time_plot(failures: Failures, *, dt_s: float) -> str:
    """Share missed by time."""
    missed = 100.0 * np.sum(failures.weight[:, None] * failures.missed, axis=0)
    expected = 100.0 * np.sum(failures.weight[:, None] * failures.pem_miss, axis=0)
    edges = np.arange(missed.size + 1) * dt_s
    plot = Plot(
        title="Missed in violations, by time",
        x=Axis(0.0, float(edges[-1]), "time [s]"),
        y=Axis(0.0, 100.0, "steps missed [%]", ticks=(0.0, 50.0, 100.0)),
        height=200,
    )
    plot.bars(edges, missed, color=VERMILLION)
    plot.line(edges[:-1] + dt_s / 2, expected, color=BLACK, width=1.8)
    return plot.text()


def _trust(run: RunData) -> str:
    estimate = run.result.estimate
    words = [diagnostic.text for diagnostic in run_diagnostics(run.result)]
    parts = [heading("How far to trust the number"), *(warning(w) for w in words)]
    method = by_name(run.config.method)
    if not method.has_likelihood_ratios:
        parts.append(quiet(UNWEIGHTED.format(method.name.capitalize())))
    elif estimate is not None and not words:
        parts.append(good("The diagnostics give no warning."))
    if method.interval_caveat is not None:
        parts.append(quiet(f"The interval: {method.interval_caveat}."))
    if method.rests_on_weights and estimate is not None and estimate.ess is not None:
        parts.append(diagnostics_table(estimate))
    parts.append(_reference(run))
    return "".join(parts)


def diagnostics_table(estimate: Estimate) -> str:
    """The weights' diagnostics beside what they should be."""
    size, tail = number(estimate.ess), number(estimate.pareto_k, 2)
    lines = [
        ["effective sample size of the violations", size, f"{SMALL_ESS:g} or more"],
        ["Pareto k-hat, the weights' tail", tail, f"{RELIABLE_PARETO_K:g} or less"],
        ["largest weight's share", percent(estimate.max_weight_share), "a few per cent"],
    ]
    return grid(["diagnostic", "found", "wanted"], lines, name="Diagnostics")


def _data(run: RunData) -> str:
    """What the model's training data do not show."""
    words = data_warnings(run.result)
    if not words:
        return ""
    lines = "".join(f"<div style='break-inside:avoid'>{warning(w)}</div>" for w in words)
    columns = f"<div style='columns:{PLOT_PX}px'>{lines}</div>"
    return heading("The error model and its data") + columns


def _reference(run: RunData) -> str:
    reference, estimate = run.result.reference, run.result.estimate
    if reference is None:
        return ""
    true = reference.probability
    ratio = ""
    if estimate is not None and true:
        ratio = f"; the answer is {number(estimate.probability / true, 2)} times that"
    error = " by recursion over all states"
    if reference.std_error:
        error = f" \N{PLUS-MINUS SIGN} {number(reference.std_error, 2)}"
    return quiet(f"Reference: {number(true)}{error}{ratio}.")


def _assumptions(run: RunData) -> str:
    items = "".join(f"<li>{escape(assumption)}</li>" for assumption in run.result.assumptions)
    return heading("Assumed") + f"<ul style='margin:0;padding-left:18px;color:#52606d'>{items}</ul>"
