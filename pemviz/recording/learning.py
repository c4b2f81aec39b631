"""How a run learned: curves against gap, figures of each stage, robustness distributions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import rerun as rr

from pemviz.analysis.detection_curves import DetectionCurves
from pemviz.arrays import FloatArray
from pemviz.colors import (
    GREEN,
    PEM_ON_BLACK,
    PROPOSAL_ON_BLACK,
    PURPLE,
    SKY,
    VERMILLION,
    VIOLATED,
    Rgba,
    rgb,
    rgba,
)
from pemviz.recording import paths
from pemviz.recording.estimates import Drawn, log10_or_none, stage_axis
from pemviz.recording.plot import (
    FEW_TICKS,
    LARGE,
    WITHOUT_LEGEND,
    Axis,
    Frame,
    Log,
    dots,
    legend,
    line,
    log_axes,
    number_axis,
)
from pemviz.recording.stream import RecordingFile
from pemviz.recording.views import shown_stages
from pemviz.sampling.estimates.trust import stage_interval
from pemviz.sampling.registry import by_name
from pemviz.types import StageResult

HISTOGRAM_BINS = 40
ALWAYS_REDRAWN = 100
LEGEND_STAGES = 5
RAMP = tuple(map(rgb, (SKY, PURPLE, VERMILLION, PROPOSAL_ON_BLACK)))
DRAWN: Mapping[str, tuple[str, str | None]] = {
    "threshold": (GREEN, None),
    "failures": (VERMILLION, ""),
    "ess": (SKY, ""),
    "loss": (PURPLE, ""),
}
"""Figures that are drawn against the stage: colour, and unit at the ticks (``None``: of
robustness)."""


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
    bounds = stage_interval(stage.scored, interval=interval, method=method, drawn=stage.drawn)
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
        log10_ci_low=log10_or_none(bounds.low),
        log10_ci_high=log10_or_none(bounds.high),
        caveats=bounds.caveats,
    )


def drawn_stage(row: StageFigures) -> Drawn | None:
    """The stage's estimate as it is drawn; ``None`` without one."""
    if row.log10_probability is None:
        return None
    return Drawn(
        place=row.stage,
        log10=row.log10_probability,
        low=row.log10_ci_low,
        high=row.log10_ci_high,
        holds=not row.caveats,
    )


def log_pem_curve(file: RecordingFile, gap_m: FloatArray, probability: FloatArray) -> None:
    """Axes, and the perception error model's curve ``[G]``; neither changes."""
    frame = curve_frame(gap_m)
    log_axes(file.static, paths.PROPOSALS, frame)
    color = rgba(PEM_ON_BLACK)
    file.static(paths.PEM_CURVE, line(frame, gap_m, probability, color=color, width=3.0))
    file.static(paths.legend(paths.PEM_CURVE), legend(frame, [(0, "error model", color)]))


def curve_frame(gap_m: FloatArray) -> Frame:
    """Axes of P(detected) over the gap."""
    ticks = tuple((value, f"{value:g}") for value in (0.0, 0.25, 0.5, 0.75, 1.0))
    return Frame(
        x=number_axis(0.0, float(gap_m[-1]), unit="m"),
        y=Axis(low=0.0, high=1.0, ticks=ticks),
        shape=LARGE,
    )


def log_curves(file: RecordingFile, curves: DetectionCurves, *, stage: int, stages: int) -> None:
    """The proposal's curve: one of all stages, and on top of them while it is the newest."""
    frame, color = curve_frame(curves.gap_m), stage_color(stage, stages=stages)
    path = paths.stage_curve(stage)
    drawn = partial(line, frame, curves.gap_m, curves.proposal)
    file.at_stage(path, drawn(color=color, width=1.5), stage=stage)
    rows = {named: row for row, named in enumerate(shown_stages(stages, LEGEND_STAGES), start=1)}
    if stage in rows:
        words = legend(frame, [(rows[stage], f"stage {stage}", color)])
        file.at_stage(paths.legend(path), words, stage=stage)
    newest = drawn(color=rgba(PROPOSAL_ON_BLACK), width=4.0)
    file.at_stage(paths.NEWEST_CURVE, newest, stage=stage)


def stage_color(stage: int, *, stages: int) -> Rgba:
    """Of a stage's curve: from blue at the first to the proposal's colour at the last."""
    place = (len(RAMP) - 1) * stage / max(stages - 1, 1)
    shades = [np.interp(place, range(len(RAMP)), part) for part in zip(*RAMP, strict=True)]
    red, green, blue = (round(float(shade)) for shade in shades)
    return red, green, blue, 255


def log_robustness(
    file: RecordingFile, stage: StageResult, *, unit: str, limit: int = HISTOGRAM_BINS
) -> None:
    """The distribution of the stage's robustness, as a histogram's outline; red: violated."""
    values = (stage.drawn or stage.scored).robustness
    values = values[np.isfinite(values)]
    if values.size == 0:
        return
    counts, edges = np.histogram(values, bins=min(limit, max(10, values.size // 5)))
    frame = robustness_frame(edges, highest=int(counts.max()), unit=unit)
    log = partial(file.at_stage, stage=stage.stage)
    log_axes(log, paths.ROBUSTNESS, frame)
    heights = np.concatenate([[0.0], np.repeat(counts.astype(np.float64), 2), [0.0]])
    outline = line(frame, np.repeat(edges, 2), heights, color=rgba(SKY), width=2.0)
    log(paths.part(paths.ROBUSTNESS, "counts"), outline)
    if frame.x.low < 0.0 < frame.x.high:
        ends = np.array([frame.y.low, frame.y.high])
        limit_line = line(frame, np.zeros(2), ends, color=rgba(VIOLATED), width=1.5)
        log(paths.part(paths.ROBUSTNESS, "limit"), limit_line)


def robustness_frame(edges: FloatArray, *, highest: int, unit: str) -> Frame:
    """Axes of a histogram with these edges."""
    return Frame(
        x=number_axis(float(edges[0]), float(edges[-1]), unit=unit),
        y=number_axis(0.0, 1.05 * max(highest, 1), whole=True, most=FEW_TICKS),
        shape=WITHOUT_LEGEND,
    )


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
        shown_unit = robustness_unit if unit is None else unit
        _log_figure(log, rows, name=name, color=rgba(color), stages=stages, unit=shown_unit)


def is_redrawn(stage: int, *, stages: int) -> bool:
    """Whether what shows all stages so far is written again after this one.

    With very many stages, doing so after each would grow with the square of their number.
    """
    every = max(1, math.ceil(stages / ALWAYS_REDRAWN))
    return stage % every == 0 or stage >= stages - 1


def _log_figure(
    log: Log, rows: Sequence[StageFigures], *, name: str, color: Rgba, stages: int, unit: str
) -> None:
    """One figure of every stage: points with a line through them."""
    points = [(row.stage, getattr(row, name)) for row in rows if getattr(row, name) is not None]
    if not points:
        return
    x, y = (np.array(values, dtype=np.float64) for values in zip(*points, strict=True))
    low, high = min(float(y.min()), 0.0), max(float(y.max()), 0.0)
    high += 0.05 * (high - low or 1.0)
    frame = Frame(
        x=stage_axis(stages),
        y=number_axis(low, high, unit=unit, most=FEW_TICKS),
        shape=WITHOUT_LEGEND,
    )
    path = paths.by_stage(name)
    log_axes(log, path, frame)
    drawn = line(frame, x, y, color=color, width=1.5)
    log(paths.part(path, "values"), drawn, dots(frame, x, y, colors=[color] * x.size))
