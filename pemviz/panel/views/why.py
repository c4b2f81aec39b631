"""The Why tab: which misses cause violations, and how far to trust the number."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any, cast

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.panel.palette import BLACK, VERMILLION
from pemviz.panel.rundata import RunData
from pemviz.panel.svg import Axis, Plot
from pemviz.panel.views.learning import is_number
from pemviz.panel.views.words import block, good, grid, heading, number, quiet, rows, table, warning

BAND_M = 1.0
MOST_BANDS = 250
SHOWN_ROWS = 14


def why(run: RunData | None) -> str:
    """The whole tab."""
    if run is None:
        return block(quiet("Nothing has run yet."))
    if run.running:
        return block(quiet("Explained when the run under way is done."))
    return block(run.memo.get("why", lambda: _why(run)))


def _why(run: RunData) -> str:
    return (
        _misses(run)
        + _engine_part(run, "causes", "Causes")
        + _engine_part(run, "sensitivity", "Sensitivity to the error model, by distance")
        + _trust(run)
        + _assumptions(run)
    )


@dataclass(frozen=True, eq=False)
class Failures:
    """The violating rollouts that explain the answer.

    Attributes:
        gap_m: ``[F, T-1]`` at the states where perception acted.
        missed: ``[F, T-1]``.
        pem_miss: ``[F, T-1]`` P(missed) under the error model.
        weight: ``[F]`` importance weights, summing to 1.
    """

    gap_m: FloatArray
    missed: BoolArray
    pem_miss: FloatArray
    weight: FloatArray


def failures_of(run: RunData) -> Failures | None:
    """Violations of the final stages, or of all stages if those have none."""
    if not run.parts:
        return None
    rollouts = run.rollouts
    final = {
        (s.get("repetition"), s.get("stage"))
        for s in rows(run.document.get("stages"))
        if s.get("kind") == "final"
    }
    violated = np.asarray(rollouts["violated"], dtype=np.bool_)
    pairs = zip(rollouts["repetition"].tolist(), rollouts["stage"].tolist(), strict=True)
    in_final = np.fromiter((pair in final for pair in pairs), dtype=np.bool_, count=violated.size)
    chosen = violated & in_final if np.any(violated & in_final) else violated
    if not np.any(chosen):
        return None
    log_weight = run.log_weight[chosen]
    weight = np.exp(log_weight - np.max(log_weight))
    detected = np.asarray(rollouts["detected"][chosen], dtype=np.bool_)
    log_p = np.asarray(rollouts["log_p"][chosen], dtype=np.float64)
    return Failures(
        gap_m=np.asarray(rollouts["gap_m"][chosen, :-1], dtype=np.float64),
        missed=~detected,
        pem_miss=np.where(detected, -np.expm1(log_p), np.exp(log_p)),
        weight=weight / np.sum(weight),
    )


def _misses(run: RunData) -> str:
    failures = failures_of(run)
    if failures is None:
        return heading("Misses that cause violations") + quiet(
            "No rollout of this run violates: there is nothing to explain. Plain simulation "
            "hardly ever finds a violation; choose another method in the Experiment tab."
        )
    return (
        heading("Misses that cause violations")
        + quiet(miss_sentence(failures, dt_s=run.config.scenario.dt_s))
        + distance_plot(failures)
        + time_plot(failures, dt_s=run.config.scenario.dt_s)
        + quiet(
            "Bars: share of steps missed in violations, weighted by how likely each is under the "
            "error model. Black: what the error model itself says."
        )
    )


def miss_sentence(failures: Failures, *, dt_s: float) -> str:
    """The chain of misses in words."""
    count = float(np.sum(failures.weight * np.count_nonzero(failures.missed, axis=1)))
    longest = float(np.sum(failures.weight * longest_runs(failures.missed)))
    edges, share, _ = by_distance(failures)
    heavy = np.flatnonzero(np.nan_to_num(share) >= 0.5)
    words = (
        f"A violation takes {count:.1f} misses on average, the longest unbroken chain being "
        f"{longest:.1f} steps ({longest * dt_s:.2f} s)."
    )
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


def by_distance(failures: Failures) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Edges ``[B+1]`` of gap bands, weighted share missed and the error model's ``[B]``."""
    high = max(BAND_M, float(np.ceil(np.max(failures.gap_m))))
    band_m = BAND_M * max(1.0, float(np.ceil(high / (MOST_BANDS * BAND_M))))
    edges = np.arange(0.0, high + band_m / 2, band_m)
    weight = np.broadcast_to(failures.weight[:, None], failures.gap_m.shape)
    inside = failures.gap_m >= 0.0
    index = np.minimum((failures.gap_m[inside] / band_m).astype(np.int64), edges.size - 2)

    def share(values: FloatArray) -> FloatArray:
        size = edges.size - 1
        total = np.bincount(index, weights=weight[inside], minlength=size)
        part = np.bincount(index, weights=(weight * values)[inside], minlength=size)
        return np.divide(part, total, out=np.full(size, np.nan), where=total > 0.0)

    return edges, share(failures.missed.astype(np.float64)), share(failures.pem_miss)


def distance_plot(failures: Failures) -> str:
    """Share of steps missed by distance."""
    edges, missed, expected = by_distance(failures)
    plot = Plot(
        title="Missed in violations, by distance",
        x=Axis(0.0, float(edges[-1]), "gap [m]"),
        y=Axis(0.0, 100.0, "steps missed [%]", ticks=(0.0, 50.0, 100.0)),
        height=150,
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
        height=150,
    )
    plot.bars(edges, missed, color=VERMILLION)
    plot.line(edges[:-1] + dt_s / 2, expected, color=BLACK, width=1.8)
    return plot.text()


def _engine_part(run: RunData, key: str, title: str) -> str:
    """What the engine offers under a key of the result, as a table."""
    value = run.document.get(key)
    if not value:
        return ""
    if isinstance(value, Mapping):
        found = cast(Mapping[str, Any], value)
        nested = [k for k, v in found.items() if rows(v)]
        # long series are plotted above or kept to result.json
        plain = {k: v for k, v in found.items() if not isinstance(v, list | tuple | Mapping)}
        return (
            heading(title)
            + (_pairs(plain, name=title) if plain else "")
            + "".join(quiet(_label(k)) + _rows_table(found[k], name=k) for k in nested)
        )
    return heading(title) + _rows_table(value, name=title)


def _rows_table(value: object, *, name: str) -> str:
    found = rows(value)
    if not found:
        return quiet(str(value)[:400])
    keys = [key for key in found[0] if any(line.get(key) is not None for line in found)]
    body = [[_shown(line.get(key)) for key in keys] for line in found[:SHOWN_ROWS]]
    more = f"and {len(found) - SHOWN_ROWS} more in result.json" if len(found) > SHOWN_ROWS else ""
    return grid([escape(_label(key)) for key in keys], body, name=name) + quiet(more)


def _pairs(found: Mapping[str, Any], *, name: str) -> str:
    return grid(["", ""], [[escape(_label(k)), _shown(v)] for k, v in found.items()], name=name)


def _label(key: str) -> str:
    return key.replace("_", " ")


def _shown(value: object) -> str:
    if is_number(value):
        return number(value)
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in cast(list[object], value)[:16])
    return escape("\N{EN DASH}" if value is None else str(value)[:120])


def _trust(run: RunData) -> str:
    estimate = table(run.document.get("estimate"))
    parts = [heading("How far to trust the number")]
    warnings = estimate.get("warnings")
    words = [str(w) for w in warnings] if isinstance(warnings, list | tuple) else []
    parts += [warning(w) for w in words]
    if estimate and not words:
        parts.append(good("The diagnostics give no warning."))
    lines = [
        ["effective sample size", number(estimate.get("ess")), "want 10 or more"],
        ["Pareto k-hat", number(estimate.get("pareto_k")), "reliable up to 0.7"],
        ["largest weight's share", number(estimate.get("max_weight_share")), "want a few per cent"],
    ]
    if estimate:
        parts.append(grid(["diagnostic", "value", ""], lines, name="Diagnostics"))
    parts += [_reference(run), _interval(run)]
    return "".join(parts)


def _reference(run: RunData) -> str:
    reference = table(run.document.get("reference"))
    if not reference:
        return ""
    answer = table(run.document.get("estimate")).get("probability")
    true = reference.get("probability")
    ratio = ""
    if is_number(answer) and is_number(true) and true:
        ratio = f"; the answer is {number(float(cast(float, answer)) / float(true), 2)} times that"
    error = number(reference.get("std_error"), 2)
    return quiet(f"Reference: {number(true)} \N{PLUS-MINUS SIGN} {error}{ratio}.")


def _interval(run: RunData) -> str:
    interval = table(run.document.get("pem_interval"))
    if not interval:
        return ""
    share: Any = interval.get("confidence")
    words = f"{100 * share:.3g} % of" if is_number(share) else "Of"
    notes = interval.get("warnings")
    warnings = cast(list[object], notes) if isinstance(notes, list | tuple) else []
    return quiet(
        f"Uncertainty of the error model itself: {words} {number(interval.get('members'), 6)} "
        f"models that the same data could have produced put P(violation) between "
        f"{number(interval.get('low'), 2)} and {number(interval.get('high'), 2)} "
        f"(median {number(interval.get('median'), 2)})."
    ) + "".join(warning(str(w)) for w in warnings)


def _assumptions(run: RunData) -> str:
    found = run.document.get("assumptions")
    if not isinstance(found, list | tuple):
        return ""
    items = "".join(f"<li>{escape(str(a))}</li>" for a in cast(list[object], found))
    return heading("Assumed") + f"<ul style='margin:0;padding-left:18px;color:#52606d'>{items}</ul>"
