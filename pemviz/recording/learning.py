"""How a run learned: curves against gap, figures of each stage, robustness, estimates."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr

from pemviz.analysis.detection_curves import DetectionCurves
from pemviz.arrays import FloatArray
from pemviz.colors import (
    GREEN,
    GREY,
    ORANGE,
    PEM_IN_RECORDING,
    PROPOSAL_IN_RECORDING,
    PURPLE,
    SKY,
    VERMILLION,
    VIOLATED,
    Rgba,
)
from pemviz.recording import paths, plot
from pemviz.recording.plot import Axis, Frame, Log, line, log_axes, log_legend, number_axis
from pemviz.recording.shades import shade
from pemviz.recording.stream import RecordingFile
from pemviz.recording.views import shown_stages
from pemviz.sampling.estimates.trust import interval_caveats, stage_interval
from pemviz.sampling.registry import by_name
from pemviz.types import Estimate, StageResult

HISTOGRAM_BINS = 40
ALWAYS_REDRAWN = 100
LEGEND_STAGES = 5
RAMP = tuple(shade(color)[:3] for color in (SKY, PURPLE, VERMILLION, PROPOSAL_IN_RECORDING))
DRAWN: Mapping[str, tuple[str, str | None]] = {
    "threshold": (GREEN, None),
    "failures": (VERMILLION, ""),
    "ess": (SKY, ""),
    "loss": (PURPLE, ""),
}
"""Figures that are drawn against the stage: colour, and unit at the ticks (``None``: of
robustness)."""
MOST_DECADES = 12.0
"""Below the highest estimate; what is lower still lies on the axis' end."""
MOST_WHISKERS = 2_000


@dataclass(frozen=True)
class StageFigures:
    """One stage's row in the table; undefined figures are ``None``."""

    stage: int
    kind: str
    rollouts: int
    elites: int
    threshold: float | None
    failures: int
    ess: float | None
    loss: float | None
    log10_probability: float | None
    log10_ci_low: float | None
    log10_ci_high: float | None
    caveats: tuple[str, ...] = ()
    """Why the bounds are no 95 % interval; empty if they are one."""


def stage_figures(stage: StageResult, *, method: str) -> StageFigures:
    """The stage's figures, with the interval of its own estimate."""
    interval = by_name(method).stage_interval
    bounds = stage_interval(stage.scored, interval=interval, method=method, sampled=stage.sampled)
    return StageFigures(
        stage=stage.stage,
        kind=stage.kind,
        rollouts=stage.count,
        elites=stage.elites,
        threshold=stage.threshold,
        failures=stage.failures,
        ess=stage.ess,
        loss=stage.loss,
        log10_probability=None if interval == "none" else stage.log10_probability,
        log10_ci_low=_log10_or_none(bounds.low),
        log10_ci_high=_log10_or_none(bounds.high),
        caveats=bounds.caveats,
    )


def _log10_or_none(value: float | None) -> float | None:
    return math.log10(value) if value is not None and value > 0.0 else None


def log_pem_curve(file: RecordingFile, gap_m: FloatArray, probability: FloatArray) -> None:
    """Axes, and the perception error model's curve ``[G]``; neither changes."""
    frame, color = curve_frame(gap_m), shade(PEM_IN_RECORDING)
    log_axes(file.static, paths.PROPOSALS, frame)
    file.static(paths.PEM_CURVE, line(frame, gap_m, probability, color=color, width=3.0))
    log_legend(file.static, paths.PEM_CURVE, frame, [(0, "error model", color)])


def curve_frame(gap_m: FloatArray) -> Frame:
    """Axes of P(detected) over the gap."""
    ticks = tuple((value, f"{value:g}") for value in (0.0, 0.25, 0.5, 0.75, 1.0))
    x = number_axis(0.0, float(gap_m[-1]), unit="m")
    return Frame(x=x, y=Axis(low=0.0, high=1.0, ticks=ticks), shape=plot.LARGE)


def log_curves(file: RecordingFile, curves: DetectionCurves, *, stage: int, stages: int) -> None:
    """The proposal's curve: one of all stages, and on top of them while it is the newest."""
    frame, log = curve_frame(curves.gap_m), partial(file.at_stage, stage=stage)
    path, drawn = paths.stage_curve(stage), partial(line, frame, curves.gap_m, curves.proposal)
    # from blue at the first stage to the proposal's colour at the last
    place = (len(RAMP) - 1) * stage / max(stages - 1, 1)
    parts = [np.interp(place, range(len(RAMP)), part) for part in zip(*RAMP, strict=True)]
    red, green, blue = (round(float(part)) for part in parts)
    color: Rgba = red, green, blue, 255
    log(path, drawn(color=color, width=1.5))
    rows = {named: row for row, named in enumerate(shown_stages(stages, LEGEND_STAGES), start=1)}
    if stage in rows:
        log_legend(log, path, frame, [(rows[stage], f"stage {stage}", color)])
    log(paths.NEWEST_CURVE, drawn(color=shade(PROPOSAL_IN_RECORDING), width=4.0))


def log_robustness(file: RecordingFile, stage: StageResult, *, unit: str) -> None:
    """The distribution of the stage's robustness, as a histogram's outline; red: violated."""
    values = (stage.sampled or stage.scored).robustness
    values = values[np.isfinite(values)]
    if values.size == 0:
        return
    counts, edges = np.histogram(values, bins=min(HISTOGRAM_BINS, max(10, values.size // 5)))
    frame = robustness_frame(edges, highest=int(counts.max()), unit=unit)
    log = partial(file.at_stage, stage=stage.stage)
    log_axes(log, paths.ROBUSTNESS, frame)
    heights = np.concatenate([[0.0], np.repeat(counts.astype(np.float64), 2), [0.0]])
    outline = line(frame, np.repeat(edges, 2), heights, color=shade(SKY), width=2.0)
    log(paths.part(paths.ROBUSTNESS, "counts"), outline)
    if frame.x.low < 0.0 < frame.x.high:
        ends = np.array([frame.y.low, frame.y.high])
        limit_line = line(frame, np.zeros(2), ends, color=shade(VIOLATED), width=1.5)
        log(paths.part(paths.ROBUSTNESS, "limit"), limit_line)


def robustness_frame(edges: FloatArray, *, highest: int, unit: str) -> Frame:
    """Axes of a histogram with these edges."""
    return Frame(
        x=number_axis(float(edges[0]), float(edges[-1]), unit=unit),
        y=number_axis(0.0, 1.05 * max(highest, 1), whole=True, most=plot.FEW_TICKS),
        shape=plot.WITHOUT_LEGEND,
    )


def stage_axis(stages: int) -> Axis:
    """An axis of so many stages."""
    return number_axis(-0.5, max(stages, 1) - 0.5, whole=True)


def is_redrawn(stage: int, *, stages: int) -> bool:
    """Whether what shows all stages so far is written again after this one.

    With very many stages, doing so after each would grow with the square of their number.
    """
    every = max(1, math.ceil(stages / ALWAYS_REDRAWN))
    return stage % every == 0 or stage >= stages - 1


def log_figures(
    file: RecordingFile, rows: Sequence[StageFigures], *, stages: int, robustness_unit: str
) -> None:
    """The newest stage's figures as scalars, and all so far drawn against the stage."""
    newest = rows[-1]
    for name in paths.FIGURES:
        value = getattr(newest, name)
        if value is not None:
            file.on_stage_only(paths.figure(name), rr.Scalars(float(value)), stage=newest.stage)
    if not is_redrawn(newest.stage, stages=stages):
        return
    log = partial(file.at_stage, stage=newest.stage)
    for name, (color, unit) in DRAWN.items():
        points = [(row.stage, getattr(row, name)) for row in rows if getattr(row, name) is not None]
        if not points:
            continue
        x, y = (np.array(values, dtype=np.float64) for values in zip(*points, strict=True))
        low, high = min(float(y.min()), 0.0), max(float(y.max()), 0.0)
        high += 0.05 * (high - low or 1.0)
        shown_unit = robustness_unit if unit is None else unit
        height = number_axis(low, high, unit=shown_unit, most=plot.FEW_TICKS)
        frame = Frame(x=stage_axis(stages), y=height, shape=plot.WITHOUT_LEGEND)
        path = paths.by_stage(name)
        log_axes(log, path, frame)
        through = line(frame, x, y, color=shade(color), width=1.5)
        dots = plot.dots(frame, x, y, colors=[shade(color)] * x.size)
        log(paths.part(path, "values"), through, dots)


@dataclass(frozen=True)
class Drawn:
    """An estimate as it is drawn; logarithms to base 10, ``None`` where an end is not known."""

    log10: float
    low: float | None
    high: float | None
    holds: bool
    """Whether the interval holds at its level."""


def drawn_estimate(estimate: Estimate | None) -> Drawn | None:
    """An estimate as it is drawn; ``None`` without one, or if nothing failed."""
    if estimate is None or estimate.log10_probability is None:
        return None
    low, high = _log10_or_none(estimate.ci_low), _log10_or_none(estimate.ci_high)
    return Drawn(estimate.log10_probability, low, high, holds=not interval_caveats(estimate))


def drawn_stages(rows: Sequence[StageFigures]) -> dict[int, Drawn]:
    """Estimates of stages that have one, by their stage."""
    return {
        row.stage: Drawn(
            row.log10_probability, row.log10_ci_low, row.log10_ci_high, holds=not row.caveats
        )
        for row in rows
        if row.log10_probability is not None
    }


def log_estimates(
    log: Log, path: str, estimates: Mapping[int, Drawn], *, places: int, answer: Drawn | None
) -> None:
    """Estimates as points with error bars at their places, and the answer as a line across.

    On a scale of powers of ten; nothing where there is no estimate.
    """
    if not estimates:
        return
    every = [*estimates.values(), *([] if answer is None else [answer])]
    ends = [end for one in every for end in (one.log10, one.low, one.high) if end is not None]
    high = max(ends)
    height = plot.decade_axis(max(min(ends), high - MOST_DECADES), high)
    frame = Frame(x=stage_axis(places), y=height)
    log_axes(log, path, frame)
    x, y = np.array(list(estimates), np.float64), np.array([e.log10 for e in estimates.values()])
    shown: list[Any] = [plot.dots(frame, x, y, colors=[shade(ORANGE)] * x.size)]
    barred = [
        (float(place), one.low, one.high, one.holds)
        for place, one in estimates.items()
        if one.low is not None and one.high is not None
    ]
    if len(barred) <= MOST_WHISKERS:
        at, lows, highs = (np.array([bar[part] for bar in barred], np.float64) for part in range(3))
        colors = [shade(SKY if holds else GREY) for *_, holds in barred]
        shown.append(plot.whiskers(frame, at, lows, highs, colors=colors))
    log(paths.part(path, "values"), *shown)
    held = {holds for *_, holds in barred}
    words = [
        (0, "estimate", shade(ORANGE)),
        *([(1, "95 % interval", shade(SKY))] if True in held else []),
        *([(2, "not a 95 % one", shade(GREY))] if False in held else []),
        *([] if answer is None else [(3, f"answer {10.0**answer.log10:.2g}", shade(GREEN))]),
    ]
    log_legend(log, path, frame, words)
    if answer is not None:
        # dashed at the ends of its interval
        dashes = list(pairwise(np.linspace(frame.x.low, frame.x.high, 61).tolist()))[::2]
        strips = [frame.across(answer.log10)]
        for end in (answer.low, answer.high):
            if end is not None:
                strips += [frame.places(np.array(pair), np.full(2, end)) for pair in dashes]
        across = rr.LineStrips2D(strips, colors=shade(GREEN), radii=plot.ui(0.7), draw_order=10.0)
        log(paths.part(path, "answer"), across)
