"""The Weights page: weights over robustness, and how near the cars come."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.charts.chart import Axis, Line, Mark, PlaneChart, Points, Rule, with_unit
from pemviz.colors import BLACK, BLUE, GREY, MISSED, VERMILLION
from pemviz.panel.pieces import (
    RUN_DASHES,
    cells,
    drawn,
    number,
    percent,
    progress_words,
    quiet,
    signal_label,
    signal_name,
)
from pemviz.panel.ranking import shares
from pemviz.panel.rollout_tables import in_final_stages
from pemviz.panel.run_data import Report, RunData, Scan, ScanProgress, row_parts
from pemviz.reports.charts import RUN_COLORS
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M

MOST_POINTS = 1_000
POINTS = "point"
"""What a click on one of them is called."""
HEIGHT = 300
FARTHEST = -60.0
"""Decades below which weights are drawn at the lower edge."""
MOST_DECADES = 300.0
LN10 = math.log(10.0)


def weights_page(run: RunData) -> str:
    """The whole page; a point bears the index of its rollout, and can be clicked."""
    if not run.parts:
        return quiet("No rollouts yet.")
    if run.running:
        return quiet("Drawn when the run under way is done.")
    weights = run.memo.get("weights", lambda: _weights(run))
    waiting = looking_at_gaps(run)
    if waiting is not None:
        gaps = quiet(f"Least gaps: {progress_words(waiting)}.")
    else:
        gaps = run.memo.get("least gaps", lambda: _least_gaps(run))
    return cells(
        weights, gaps, drawn(heaviest_chart(run), caption="In brackets: share of the answer.")
    )


def drawn_points(run: RunData, *, most: int = MOST_POINTS) -> IntArray:
    """Indices ``[P]`` of the rollouts drawn: violations, the least robust, of the others some.

    If there are more than ``most``: of the violations those that contribute most, the least robust
    where several contribute the same, up to half of ``most``; of the others some evenly by
    robustness, from the least robust on.
    """
    robustness = np.asarray(run.rollouts["robustness"], dtype=np.float64)
    violated = np.asarray(run.rollouts["violated"], dtype=np.bool_)
    share = shares(run)
    usable = np.flatnonzero(np.isfinite(robustness) & np.isfinite(run.log_weight))
    if usable.size <= most:
        return usable
    violations = usable[violated[usable]]
    keys = (robustness[violations], -share[violations])
    heavy = violations[np.lexsort(keys)[: most // 2]]
    rest = usable[~np.isin(usable, heavy)]
    rest = rest[np.argsort(robustness[rest], kind="stable")]
    places = np.linspace(0, rest.size - 1, most - heavy.size).round().astype(np.int64)
    return np.sort(np.concatenate([heavy, rest[places]]))


def _weights(run: RunData) -> str:
    """The plot of weights over robustness."""
    if not run.method.has_likelihood_ratios:
        return quiet("Splitting's rollouts carry no weights: there is nothing to draw here.")
    index = run.memo.get("drawn points", lambda: drawn_points(run))
    words = (
        f"Each rollout's weight, by how much rarer or commoner it is under {run.law_words} than as "
        "sampled; the larger, the more it contributes to the answer. Click a point: that rollout "
        "shows in the scene."
    )
    if index.size < run.simulated:
        words += (
            f" Drawn are {index.size:,} of {run.simulated:,}: violations, if over "
            f"{MOST_POINTS // 2} those that contribute most, and of the others some evenly by "
            "robustness, from the least robust on."
        )
    return drawn(weight_chart(run, index), target=POINTS) + quiet(words)


def weight_chart(run: RunData, index: IntArray) -> PlaneChart:
    """Weights over robustness of the rollouts ``index`` ``[P]``.

    Those that violate are crosses, larger where they are some of those that carry the answer.
    """
    robustness = np.asarray(run.rollouts["robustness"][index], np.float64)
    violated = np.asarray(run.rollouts["violated"][index], dtype=np.bool_)
    log10_weight, share = run.log_weight[index] / LN10, shares(run)[index]
    radius = 2.4 + 3.0 * np.sqrt(np.minimum(share / 0.05, 1.0))
    tips = [_tip(run, *one) for one in zip(index.tolist(), log10_weight, share, strict=True)]

    def points(chosen: BoolArray, color: str, label: str) -> Points:
        places = np.flatnonzero(chosen)
        return Points(
            robustness[places], log10_weight[places], color, label,
            radius=np.where(chosen, radius, 2.2)[places] if color == MISSED else 2.2,
            tips=tuple(tips[place] for place in places.tolist()),
            numbers=tuple(index[places].tolist()), crosses=color == MISSED,
        )  # fmt: skip

    metric = run.config.metric
    low, high = _ends(robustness, least=0.1)
    bottom, top = _ends(np.maximum(log10_weight, FARTHEST), least=1.0)
    return PlaneChart(
        title="Weight over robustness",
        x=Axis(low, high, with_unit(f"robustness, {metric}", run.robustness_unit)),
        y=Axis(bottom, top, "log10 of the weight p / q"),
        marks=(
            Rule(0.0, "0", VERMILLION),
            points(~violated, BLUE, "does not violate"),
            points(violated, MISSED, "violates; larger: more of the answer"),
        ),
        height=HEIGHT,
    )


def _tip(run: RunData, index: int, log10_weight: float, share: float) -> str:
    part = f", {percent(share)} of the answer" if share >= 5e-4 else ""
    stage, rollout = (int(run.rollouts[key][index]) for key in ("stage", "rollout"))
    robustness = number(float(run.rollouts["robustness"][index]))
    weight = number(10.0 ** min(log10_weight, MOST_DECADES))
    return f"stage {stage}, rollout {rollout}: robustness {robustness}, weight {weight}{part}"


def _ends(values: FloatArray, *, least: float) -> tuple[float, float]:
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    room = max(0.04 * (high - low), least / 2)
    return low - room, high + room


def heaviest_chart(run: RunData) -> PlaneChart | None:
    """Gap over time of the rollouts that contribute most to the answer."""
    if not run.parts or run.running:
        return None
    return run.memo.get("heaviest", lambda: _heaviest_chart(run))


def _heaviest_chart(run: RunData) -> PlaneChart | None:
    share = shares(run)
    heaviest = np.argsort(-share, kind="stable")[: len(RUN_COLORS)]
    heaviest = heaviest[share[heaviest] > 0.0]
    if not heaviest.size:
        return None
    lines = [
        Line(
            run.time_s,
            run.signals(index)[run.charted.name][0],
            RUN_COLORS[place],
            f"rollout {int(run.rollouts['rollout'][index])} ({percent(float(share[index]))})",
            dash=RUN_DASHES[place],
        )
        for place, index in enumerate(heaviest.tolist())
    ]
    name = signal_name(run.charted).capitalize()
    title = f"{name} of the rollouts that contribute most"
    return over_time(run, title, lines)


def over_time(run: RunData, title: str, lines: Sequence[Line]) -> PlaneChart:
    """The charted signal of rollouts against time, and where bumpers touch, if that is known."""
    touch: tuple[Mark, ...] = ()
    ends = [float(end(line.y)) for line in lines for end in (np.min, np.max)]
    if run.own is None:
        touch = (Rule(CAMERA_TO_BUMPER_M, "bumpers touch", BLACK, upright=False),)
        ends.append(CAMERA_TO_BUMPER_M)
    low, high = min(0.0, *ends), max(0.0, *ends)
    return PlaneChart(
        title,
        x=Axis(0.0, float(run.time_s[-1]), "time [s]"),
        y=Axis(low, high + (0.06 * (high - low) or 1.0), signal_label(run.charted)),
        marks=(*touch, *lines),
        width=420,
        height=240,
    )


@dataclass(frozen=True, eq=False)
class LeastGaps:
    """How likely the cars come nearer than a gap.

    Attributes:
        gap_m: ``[P]`` ascending, every rollout's least gap [m].
        sampled: ``[P]`` share of the rollouts, as drawn, with a least gap up to this one.
        log10_probability: ``[P]`` of the same under the error model; empty where rollouts carry
            no weights.
    """

    gap_m: FloatArray
    sampled: FloatArray
    log10_probability: FloatArray


def least_gaps(run: RunData) -> LeastGaps | None:
    """From the rollouts that the estimate averages; ``None`` without any."""
    drawn = sum(stage.rollouts for stage in run.result.stages if stage.kind == "final")
    chosen = np.flatnonzero(in_final_stages(run.rollouts, stages=run.result.stages))
    if not chosen.size or not drawn or run.distance is None:
        return None
    gap_m = run.scans.value(*_nearest(run))[chosen]
    order = np.argsort(gap_m, kind="stable")
    log10 = np.empty(0)
    if run.method.has_likelihood_ratios:
        log_weight = run.log_weight[chosen][order]
        log10 = (np.logaddexp.accumulate(log_weight) - math.log(drawn)) / LN10
    return LeastGaps(gap_m[order], np.arange(1, order.size + 1) / drawn, log10)


def looking_at_gaps(run: RunData) -> ScanProgress | None:
    """Have every rollout's least gap found; ``None`` once they are there."""
    return None if run.distance is None else run.scans.begin(*_nearest(run), count=run.kept)


def _nearest(run: RunData) -> tuple[object, Scan[FloatArray]]:
    """The least gap ``[N]`` [m] of each rollout, as a scan of the run."""

    def scan(report: Report) -> FloatArray:
        key = "" if run.distance is None else run.distance.key
        found = np.empty(run.kept)
        for rows in row_parts(run.kept):
            found[rows] = np.min(np.asarray(run.steps([key], rows)[key], np.float64), axis=1)
            report(rows.stop)
        return found

    return "least gap", scan


def _least_gaps(run: RunData) -> str:
    """How likely the least gap is below a value: under the error model, and as drawn."""
    if run.distance is None:
        return quiet("No signal of the scenario says how near a collision is.")
    gaps = least_gaps(run)
    if gaps is None:
        return quiet("No rollouts that the answer rests on yet.")
    weighted = bool(gaps.log10_probability.size)
    words = (
        "The share of rollouts that come nearer than a gap. As sampled: under the proposal, which "
        "looks for violations."
    )
    if weighted:
        words += (
            f" Under {run.law_words}: every rollout with its weight, so how likely it is in truth; "
            "towards 1 it is rough, for common rollouts are hardly sampled."
        )
    if run.kept < run.simulated:
        words += f" From the {run.kept:,} of {run.simulated:,} rollouts that are kept here."
    return drawn(gap_chart(run, gaps)) + quiet(words)


def gap_chart(run: RunData, gaps: LeastGaps) -> PlaneChart:
    """Shares of rollouts by how near the cars come, as drawn and under the error model."""
    assert run.distance is not None  # noqa: S101  gaps are of it
    size = gaps.gap_m.size
    kept = np.unique(np.linspace(0, size - 1, min(size, MOST_POINTS)).round().astype(np.int64))
    gap_m, entries = gaps.gap_m[kept], [("as sampled", GREY, "5 3", gaps.sampled)]
    if gaps.log10_probability.size:
        probability = np.minimum(10.0**gaps.log10_probability, 1.0)
        entries.append((f"under {run.law_words}", BLUE, "", probability))
    lines = [
        Line(gap_m, values[kept], color, label, width=2.0, dash=dash)
        for label, color, dash, values in entries
    ]
    touch_m, touching = (
        (CAMERA_TO_BUMPER_M, "bumpers touch") if run.own is None else (0.0, "contact")
    )
    low, high = _ends(gaps.gap_m, least=1.0)
    least = min(float(np.min(line.y[line.y > 0.0], initial=1.0)) for line in lines)
    floor = max(math.floor(math.log10(least)), FARTHEST)
    return PlaneChart(
        title="How near the cars come",
        x=Axis(low, high, f"least {signal_name(run.distance)} in a rollout [m]"),
        y=Axis(10.0 ** (floor - 0.5), 10.0**0.4, "probability of less", log10=True),
        marks=(Rule(touch_m, f"{touch_m:g} m: {touching}", VERMILLION), *lines),
        height=HEIGHT,
    )
