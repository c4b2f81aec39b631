"""The Weights page: weights over robustness, and how near the cars come."""

import math
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.charts.svg import Axis, Plot, text
from pemviz.colors import BLACK, BLUE, GREY, MISSED, VERMILLION
from pemviz.panel.curve_chart import RUN_DASHES, Curves, Line, curves_svg, over_time, signal_name
from pemviz.panel.pieces import cells, number, percent, progress_words, quiet
from pemviz.panel.ranking import shares
from pemviz.panel.rollout_tables import in_final_stages
from pemviz.panel.run_data import Report, RunData, Scan, ScanProgress, row_parts
from pemviz.reports.charts import RUN_COLORS
from pemviz.reports.html import clicks_to
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M

MOST_POINTS = 1_000
POINTS = "point"
"""What a click on one of them is called."""
HEIGHT = 300
FARTHEST = -60.0
"""Decades below which weights are drawn at the lower edge."""
LN10 = math.log(10.0)


def weights_page(run: RunData) -> str:
    """The whole page; a point bears the index of its rollout, and can be clicked."""
    if not run.parts:
        return quiet("No rollouts yet.")
    if run.running:
        return quiet("Drawn when the run under way is done.")
    weights = run.memo.get("weights", lambda: _weights(run))
    heaviest = heaviest_curves(run)
    waiting = looking_at_gaps(run)
    if waiting is not None:
        gaps = quiet(f"Least gaps: {progress_words(waiting)}.")
    else:
        gaps = run.memo.get("least gaps", lambda: _least_gaps(run))
    return cells(weights, gaps, "" if heaviest is None else curves_svg(heaviest))


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
    plot, index = _weight_axes(run)
    plot.vline(0.0, color=VERMILLION, label="0")
    shapes = "".join(_point(run, plot, one) for one in index.tolist())
    group = f"<g {clicks_to(POINTS)}>{shapes}</g>"
    y = plot.height - 6.0
    violates = "\N{MULTIPLICATION X} violates; larger: more of the answer"
    group += text(violates, plot.left, y, color=MISSED)
    group += text("\N{BLACK CIRCLE} does not", plot.left + 210, y, color=BLUE)
    words = (
        "Each rollout's weight, by how much rarer or commoner it is under the error model than as "
        "drawn; the larger, the more it contributes to the answer. Click a point: that rollout "
        "shows in the scene."
    )
    if index.size < run.simulated:
        words += (
            f" Drawn are {index.size:,} of {run.simulated:,}: violations, if over "
            f"{MOST_POINTS // 2} those that contribute most, and of the others some evenly by "
            "robustness, from the least robust on."
        )
    return plot.text(extra=group) + quiet(words)


def _weight_axes(run: RunData) -> tuple[Plot, IntArray]:
    """The empty plot, and which rollouts are drawn in it."""
    index = run.memo.get("drawn points", lambda: drawn_points(run))
    unit = "" if run.config.metric == "agm" else " [m]"
    low, high = _ends(np.asarray(run.rollouts["robustness"][index], np.float64), least=0.1)
    bottom, top = _ends(np.maximum(run.log_weight[index] / LN10, FARTHEST), least=1.0)
    plot = Plot(
        title="Weight over robustness",
        x=Axis(low, high, f"robustness, {run.config.metric}{unit}"),
        y=Axis(bottom, top, "weight p / q", log10=True),
        height=HEIGHT,
        left=54,
        bottom=50,
    )
    return plot, index


def _ends(values: FloatArray, *, least: float) -> tuple[float, float]:
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    room = max(0.04 * (high - low), least / 2)
    return low - room, high + room


def _at(run: RunData, plot: Plot, index: int) -> tuple[float, float]:
    weight = max(float(run.log_weight[index]) / LN10, FARTHEST)
    return plot.px(float(run.rollouts["robustness"][index])), plot.py(weight)


def _point(run: RunData, plot: Plot, index: int) -> str:
    """A rollout, as a cross if it violates; larger if it is one of those that carry the answer."""
    share, (x, y) = float(shares(run)[index]), _at(run, plot, index)
    part = f", {percent(share)} of the answer" if share >= 5e-4 else ""
    stage, rollout = (int(run.rollouts[key][index]) for key in ("stage", "rollout"))
    tip = (
        f"stage {stage}, rollout {rollout}: robustness "
        f"{number(float(run.rollouts['robustness'][index]))}, weight "
        f"{number(10.0 ** (float(run.log_weight[index]) / LN10))}{part}"
    )
    if run.rollouts["violated"][index]:
        r = 2.4 + 3.0 * math.sqrt(min(share / 0.05, 1.0))
        shape = f"<path d='M{x - r:.1f} {y - r:.1f}l{2 * r:.1f} {2 * r:.1f}m0 {-2 * r:.1f}"
        shape += f"l{-2 * r:.1f} {2 * r:.1f}' stroke='{MISSED}' stroke-width='1.5' fill='none'/>"
    else:
        shape = f"<circle cx='{x:.1f}' cy='{y:.1f}' r='2.2' fill='{BLUE}' fill-opacity='0.6'/>"
    hit = f"<circle cx='{x:.1f}' cy='{y:.1f}' r='5' fill='transparent'/>"
    return f"<g data-number='{index}'>{shape}{hit}<title>{tip}</title></g>"


def heaviest_curves(run: RunData) -> Curves | None:
    """Gap over time of the rollouts that contribute most to the answer."""
    if not run.parts or run.running:
        return None
    return run.memo.get("heaviest", lambda: _heaviest_curves(run))


def _heaviest_curves(run: RunData) -> Curves | None:
    share = shares(run)
    heaviest = np.argsort(-share, kind="stable")[: len(RUN_COLORS)]
    heaviest = heaviest[share[heaviest] > 0.0]
    if not heaviest.size:
        return None
    unit = f" [{run.charted.unit}]" if run.charted.unit else ""
    lines = [
        Line(
            f"rollout {int(run.rollouts['rollout'][index])} ({percent(float(share[index]))}){unit}",
            run.signals(index)[run.charted.name][0],
            RUN_COLORS[place],
            dash=RUN_DASHES[place],
        )
        for place, index in enumerate(heaviest.tolist())
    ]
    name = signal_name(run.charted).capitalize()
    title = f"{name} of the rollouts that contribute most (share of the answer)"
    return over_time(run, title, lines, touch_color=BLACK)


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
        return quiet("No signal of the scenario tells how near the cars come.")
    gaps = least_gaps(run)
    if gaps is None:
        return quiet("No rollouts that the answer rests on yet.")
    low, high = _ends(gaps.gap_m, least=1.0)
    logs = [np.log10(gaps.sampled), gaps.log10_probability]
    floor = max(min(float(np.min(v[np.isfinite(v)], initial=0.0)) for v in logs), FARTHEST)
    plot = Plot(
        title="How near the cars come",
        x=Axis(low, high, f"least {signal_name(run.distance)} in a rollout [m]"),
        y=Axis(math.floor(floor) - 0.5, 0.4, "probability of less", log10=True),
        height=HEIGHT,
        left=54,
        bottom=50,
    )
    touch_m, touching = (
        (CAMERA_TO_BUMPER_M, "bumpers touch") if run.own is None else (0.0, "contact")
    )
    plot.vline(touch_m, color=VERMILLION, label=f"{touch_m:g} m: {touching}")
    weighted = bool(gaps.log10_probability.size)
    entries = [("as drawn", GREY, "5 3"), *[("under the error model", BLUE, "")] * weighted]
    size = gaps.gap_m.size
    kept = np.unique(np.linspace(0, size - 1, min(size, MOST_POINTS)).round().astype(np.int64))
    for values, (_, color, dash) in zip(logs, entries, strict=False):
        y = np.minimum(values, 0.0)[kept]
        plot.line(gaps.gap_m[kept], y, color=color, width=2.0, dash=dash)
    for place, entry in enumerate(reversed(entries)):
        plot.legend([entry], x=plot.left + 160 * place, y=plot.height - 6)
    words = (
        "The share of rollouts that come nearer than a gap. As drawn: under the proposal, which "
        "looks for violations."
    )
    if weighted:
        words += (
            " Under the error model: every rollout with its weight, so how likely it is in truth; "
            "towards 1 it is rough, for common rollouts are hardly drawn."
        )
    if run.kept < run.simulated:
        words += f" From the {run.kept:,} of {run.simulated:,} rollouts that are kept here."
    return plot.text() + quiet(words)
