"""The charts that there are of a result, each described once; engines draw them."""

import math
from collections.abc import Sequence

import numpy as np

from pemviz.analysis.label_plan import BandPlan, LabelPlan
from pemviz.analysis.starts import DangerousStarts, StartMap, StartValue
from pemviz.arrays import BoolArray, FloatArray
from pemviz.charts import chart as marks
from pemviz.charts.chart import Axis, IntervalChart, PlaneChart, Row, with_unit
from pemviz.colors import (
    BLACK,
    BLUE,
    GREEN,
    MISSED,
    ORANGE,
    PEM,
    PROPOSAL,
    PURPLE,
    SKY,
    SOURCES,
    VERMILLION,
)
from pemviz.reports.answer_words import source_name, uncertainty_title
from pemviz.reports.estimate_words import end_text, range_text
from pemviz.reports.memory_words import CurveAxis, measured_names
from pemviz.reports.plan_words import z_text
from pemviz.runs.result import RunMemory, RunResult
from pemviz.runs.uncertainty import run_interval_caveats, uncertainty_budget
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

MOST_REPETITIONS = 20
PROBABILITY = "probability of a violation"
RUN_COLORS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY)


def uncertainty_chart(result: RunResult) -> IntervalChart | None:
    """A bar for each source of uncertainty, the answer across them; ``None`` without any."""
    doubted = bool(run_interval_caveats(result))
    rows = tuple(
        Row(
            name=source_name(source).partition(";")[0],
            low=source.low,
            high=source.high,
            values=(),
            color=SOURCES[source.kind],
            holds=not (doubted and source.kind == "sampling"),
            figures="not bounded" if source.high is None else range_text(source.low, source.high),
            tip=f"{source.note}; " * bool(source.note) + f"narrowed by: {source.narrowed_by}",
        )
        for source in uncertainty_budget(result)
    )
    estimate = result.estimate
    if not rows or estimate is None:
        return None
    answer = (marks.Rule(estimate.probability, "the answer", GREEN, marks.SOLID),) * (
        estimate.probability > 0
    )
    return IntervalChart(uncertainty_title(result), rows, PROBABILITY, rules=answer, up_to=1.0)


def interval_chart(result: RunResult, *, limit: float | None) -> IntervalChart | None:
    """The answer with its interval beside its repetitions, refits and reference; a gate's limit."""
    estimate, models = result.estimate, result.pem_interval
    if estimate is None:
        return None
    repetitions = result.repetitions if len(result.repetitions) > 1 else ()
    rows = [
        _answer(f"repetition {number}", one, caveats=interval_caveats(one))
        for number, one in enumerate(repetitions[:MOST_REPETITIONS], start=1)
    ]
    name = estimate.method if not repetitions else f"mean of {len(repetitions)}"
    rows.append(_answer(name, estimate, caveats=run_interval_caveats(result)))
    if models is not None and models.high is not None:
        median = () if models.median is None else (models.median,)
        ends = models.low or 0.0, models.high
        rows.append(Row("refits", *ends, median, ORANGE, figures=range_text(*ends)))
    if result.reference is not None:
        rows.append(_point("reference", result.reference.probability, GREEN, mark="*"))
    if limit is not None:
        rows.append(_point("gate", limit, BLACK, mark="X"))
    return IntervalChart("Probability with its interval", tuple(rows), PROBABILITY)


def models_chart(result: RunResult) -> IntervalChart | None:
    """The answer under the run's own error model and others; ``None`` without others."""
    rows: list[Row] = []
    if result.estimate is not None and result.estimate.probability > 0.0:
        rows.append(_point(f"{result.pem.name}, as shipped", result.estimate.probability, BLUE))
    interval = result.pem_interval
    refits = () if interval is None else interval.log10_answers
    if interval is not None and interval.high is not None and refits:
        refits = tuple(10.0**value for value in refits if value is not None)
        ends = interval.low or 0.0, interval.high
        name = f"its {interval.members} refits"
        rows.append(Row(name, *ends, refits, ORANGE, figures=range_text(*ends)))
    for model_class in sorted(result.model_classes, key=lambda one: one.log10_probability):
        rough = "" if model_class.is_reliable else " (rough)"
        rows.append(_point(f"{model_class.name}{rough}", model_class.probability, VERMILLION))
    if len(rows) < 2:
        return None
    if result.reference is not None:
        rows.append(_point("exact reference", result.reference.probability, GREEN))
    if result.data_bound is not None:
        name = "data alone, upper bound"
        rows.append(_point(name, result.data_bound.probability, PURPLE))
    return IntervalChart("The answer under other error models", tuple(rows), PROBABILITY)


def runs_chart(
    runs: Sequence[tuple[str, RunResult]], *, limit: float | None
) -> IntervalChart | None:
    """The answers of several runs by name, and a limit across them; ``None`` without any."""
    rows: list[Row] = []
    for place, (name, result) in enumerate(runs):
        color, estimate = RUN_COLORS[place % len(RUN_COLORS)], result.estimate
        if estimate is None:
            rows.append(Row(name, None, None, (), color, figures="no estimate"))
        else:
            caveats = run_interval_caveats(result)
            rows.append(_answer(name, estimate, caveats=caveats, color=color))
    if not any(row.high or row.values for row in rows):
        return None
    rules = () if limit is None else (marks.Rule(limit, f"{limit:g}", BLACK),)
    return IntervalChart("Answers side by side", tuple(rows), PROBABILITY, rules=rules)


def _answer(name: str, estimate: Estimate, *, caveats: Sequence[str], color: str = BLUE) -> Row:
    return Row(
        name,
        estimate.ci_low,
        estimate.ci_high,
        (estimate.probability,) if estimate.probability > 0.0 else (),
        color,
        holds=not caveats,
        figures=end_text(estimate.probability) if estimate.probability > 0.0 else "none seen",
    )


def _point(name: str, value: float, color: str, *, mark: str = "o") -> Row:
    return Row(name, None, None, (value,), color, figures=end_text(value), mark=mark)


def memory_chart(memory: RunMemory, axis: CurveAxis) -> PlaneChart | None:
    """The failure probability along memory times or frailties; ``None`` without a curve."""
    points = [p for p in axis.points(memory) if p.low and p.high and p.probability > 0.0]
    if not points:
        return None
    rows = [(axis.place(p), p.probability, p.low, p.high) for p in points]
    places, probability, low, high = np.array(rows, dtype=np.float64).T
    holds = tuple(not point.caveats for point in points)
    kind = "95 % intervals" if all(holds) else "intervals; dotted: not a 95 % one"
    names = {
        place: f"{place:.2g}{axis.unit}: {name.split(',')[0]}, on video"
        for place, name in sorted(measured_names(memory, axis).items())
    }
    floor = 10.0 ** math.floor(math.log10(low.min()) - 0.5)
    return PlaneChart(
        title=axis.title.partition(", by")[0],
        x=Axis(0.0, 1.02 * max(float(places.max()), 1e-9), with_unit(axis.head, axis.unit.strip())),
        y=Axis(floor, 1.5, "P(violation)", log10=True),
        marks=(
            *(marks.Rule(at, name, PEM, marks.SOLID) for at, name in names.items()),
            marks.Line(places, probability, PROPOSAL, width=2.0, tip="failure probability"),
            marks.Whiskers(places, low, high, PROPOSAL, holds, label=kind),
        ),
    )


LEVELS = ("#5b1a00", "#b23a00", "#ec7014", "#fdae5b", "#fdd9a0", "#fff4d6")
"""From the likeliest level down."""
UNKNOWN = "#e9ecef"
HALF = math.log10(0.5)


def starts_chart(found: DangerousStarts) -> PlaneChart | None:
    """P(violation) in the plane of two start values; ``None`` where violations are too few."""
    plane = found.plane
    if plane is None:
        return None
    values = {one.name: one for one in found.values}
    across, up = values[plane.across], values[plane.up]
    shades = np.array(
        [[math.nan if v is None else v for v in row] for row in plane.log10_probability]
    )
    half_across = (plane.across_high - plane.across_low) / (shades.shape[1] - 1) / 2.0
    half_up = (plane.up_high - plane.up_low) / (shades.shape[0] - 1) / 2.0
    usual = marks.Box(
        across.all_starts[0], across.all_starts[-1], up.all_starts[0], up.all_starts[-1], BLACK,
        label="80 % of all, each way",
    )  # fmt: skip
    dots = marks.Points(
        np.array([one.across for one in found.points]),
        np.array([one.up for one in found.points]),
        BLACK,
        label="a sampled violation",
        radius=1.7,
        tips=tuple(
            f"stage {one.stage}, rollout {one.rollout}: {plane.across} {one.across:.4g}, "
            f"{plane.up} {one.up:.4g}"
            for one in found.points
        ),
        numbers=tuple(range(1, len(found.points) + 1)),
    )
    cells = marks.Cells(
        shades, _levels(plane), UNKNOWN, "P(violation)", "log10 of P(violation) at the place"
    )
    return PlaneChart(
        title=f"P(violation{'' if found.rule is None else f' of {found.rule}'}) by start",
        x=Axis(plane.across_low - half_across, plane.across_high + half_across,
               _start_label(across)),
        y=Axis(plane.up_low - half_up, plane.up_high + half_up, _start_label(up)),
        marks=(cells, usual, dots) if found.points else (cells, usual),
        width=440,
        height=300,
    )  # fmt: skip


def _start_label(value: StartValue) -> str:
    return with_unit(f"{value.name.replace('_', ' ')} at the start", value.unit)


def _levels(plane: StartMap) -> tuple[marks.Level, ...]:
    """From the likeliest down: decades, and 0.5, as many as there are values for.

    The last of all shades has whatever lies below too.
    """
    known = [value for row in plane.log10_probability for value in row if value is not None]
    if not known:
        return ()
    highest = max(known)
    ends = [HALF] if highest >= HALF else []
    first = math.floor(highest - 1e-9) if highest < HALF else -1
    ends += [first - step for step in range(len(LEVELS) - len(ends))]
    needed = next((i + 1 for i, end in enumerate(ends) if end <= min(known)), len(ends))
    ends = ends[:needed]
    words = [f"{_power(end)} and more" for end in ends[:1]]
    words += [f"from {_power(end)}" for end in ends[1:]]
    if len(ends) == len(LEVELS):
        words[-1] = f"below {_power(ends[-2])}"
    named = zip(ends, words, LEVELS, strict=False)
    return tuple(marks.Level(end, word, color) for end, word, color in named)


def _power(log10: float) -> str:
    return f"{10.0**log10:g}" if log10 >= -3.0 else f"1e{log10:g}"


REQUIREMENT_LINES = (
    ("labels so far allow", PURPLE, marks.DASHED),
    ("required", VERMILLION, marks.SOLID),
    ("error model", BLACK, marks.DOTTED),
)
"""What is drawn in every band, from the top as a rule."""
MARGIN_M = 2.0
LEAST = 1e-12
"""Probabilities below are drawn as this."""


def requirement_chart(labels: LabelPlan) -> PlaneChart | None:
    """P(missed) over z: what the labels allow, what is required, what the error model says."""
    if not labels.bands:
        return None
    ends = [_band_ends(band) for band in labels.bands]
    lowest = min(min(band.required, band.model) for band in labels.bands)
    floor = math.floor(math.log10(max(lowest, LEAST)) - 0.2)
    lines = [
        marks.Line(
            np.array([low + 0.06, high - 0.06]),
            np.full(2, max(value, LEAST)),
            color,
            label=name if band is labels.bands[0] else "",
            width=2.6,
            dash=dash,
            tip=f"{z_text(band)}: {name} {value:.2g}",
            name=name,
        )
        for band, (low, high) in zip(labels.bands, ends, strict=True)
        for (name, color, dash), value in zip(
            REQUIREMENT_LINES, (band.allowed, band.required, band.model), strict=True
        )
    ]
    return PlaneChart(
        title=f"P(missed): required for {labels.target:.2g}, and now",
        x=Axis(ends[0][0] - 0.3, ends[-1][1] + 0.3, "z, camera to the obstacle's centre [m]"),
        y=Axis(10.0**floor, 1.4, "P(missed)", log10=True,
               ticks=tuple(10.0**power for power in range(floor, 1))),
        marks=tuple(lines),
    )  # fmt: skip


def _band_ends(band: BandPlan) -> tuple[float, float]:
    """Where the band is drawn; one without an edge is drawn so far beyond its other one."""
    low = band.low_m if band.low_m is not None else (band.high_m or 0.0) - MARGIN_M
    return low, band.high_m if band.high_m is not None else low + MARGIN_M


def gap_chart(
    gap_m: FloatArray, missed: BoolArray, share: FloatArray, *, dt_s: float
) -> PlaneChart:
    """Gaps ``[V, T]`` [m] of violations over time, the likeliest first, darker the likelier.

    Dots stand where outcomes ``[V, T-1]`` of the likeliest are missed; shares are ``[V]``.
    """
    time_s = np.arange(gap_m.shape[1]) * dt_s
    lines = [
        marks.Line(
            time_s, gaps, BLUE, opacity=0.25 + 0.6 * min(part / float(share[0]), 1.0),
            tip=f"{part:.0%} of the weight", name=f"violation {place}",
        )
        for place, gaps, part in zip(
            range(len(gap_m), 0, -1), gap_m[::-1], share[::-1].tolist(), strict=True
        )
    ]  # fmt: skip
    steps = np.flatnonzero(missed[0])
    dots = marks.Points(
        time_s[steps], gap_m[0][steps], MISSED, "missed, in the likeliest", radius=2.6
    )
    return PlaneChart(
        title="Gap in the likeliest violations",
        x=Axis(0.0, float(time_s[-1]), "time [s]"),
        y=Axis(min(0.0, float(gap_m.min())) - 0.5, float(gap_m.max()) + 0.5, "gap [m]"),
        marks=(*lines, dots),
        width=460,
        height=210,
    )


def miss_chart(probability: Sequence[float], *, dt_s: float) -> PlaneChart:
    """P(a miss that matters at each step, given a violation)."""
    values = 100.0 * np.asarray(probability, dtype=np.float64)
    edges = dt_s * np.arange(values.size + 1, dtype=np.float64)
    return PlaneChart(
        title="Misses that matter, given a violation",
        x=Axis(0.0, float(edges[-1]), "time [s]"),
        y=Axis(0.0, 100.0, "missed [%]", ticks=(0.0, 25.0, 50.0, 75.0, 100.0)),
        marks=(marks.Bars(edges, values, MISSED),),
        width=460,
        height=210,
    )
