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
    GREY,
    ORANGE,
    PEM_BARS_ON_BLACK,
    PROPOSAL_BARS_ON_BLACK,
    PURPLE,
    SKY,
    VERMILLION,
    Rgba,
    rgba,
)
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile
from pemviz.sampling.estimates.stage_interval import stage_interval
from pemviz.sampling.registry import by_name
from pemviz.types import StageResult

HISTOGRAM_BINS = 40
BAR_WIDTH = 0.8
ALWAYS_REDRAWN = 100


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
    bounds = stage_interval(stage.scored, interval=interval, method=method)
    return StageFigures(
        stage=stage.stage,
        kind=stage.kind,
        rollouts=stage.scored.rollouts.count,
        elites=stage.elites,
        threshold=stage.threshold,
        failures=stage.failures,
        ess=stage.ess,
        loss=stage.loss,
        log10_probability=None if interval == "none" else stage.log10_probability,
        log10_ci_low=_log10(bounds.low),
        log10_ci_high=_log10(bounds.high),
        caveats=bounds.caveats,
    )


def _log10(value: float | None) -> float | None:
    return math.log10(value) if value is not None and value > 0.0 else None


def log_pem_curve(file: RecordingFile, gap_m: FloatArray, probability: FloatArray) -> None:
    """The perception error model's curve ``[G]``; it does not change."""
    file.static(paths.PEM_CURVE, _curve(gap_m, probability, rgba(PEM_BARS_ON_BLACK)))


def log_curves(file: RecordingFile, curves: DetectionCurves, *, stage: int) -> None:
    """The proposal's curve, in the current view and as one of all stages."""
    bars = _curve(curves.gap_m, curves.proposal, rgba(PROPOSAL_BARS_ON_BLACK))
    file.at_stage(paths.PROPOSAL_CURVE, bars, stage=stage)
    file.at_stage(paths.stage_curve(stage), bars, stage=stage)


def _curve(gap_m: FloatArray, probability: FloatArray, color: Rgba) -> rr.BarChart:
    """Bars as wide as the grid's steps; rerun places a bar by its left edge."""
    step_m = float(gap_m[1] - gap_m[0])
    return rr.BarChart(probability, abscissa=gap_m, widths=np.full(gap_m.size, step_m), color=color)


def log_robustness(file: RecordingFile, stage: StageResult, *, limit: int = HISTOGRAM_BINS) -> None:
    """The distribution of the stage's robustness, as a histogram."""
    values = stage.scored.robustness[np.isfinite(stage.scored.robustness)]
    if values.size == 0:
        return
    counts, edges = np.histogram(values, bins=min(limit, max(10, values.size // 5)))
    file.at_stage(
        paths.ROBUSTNESS,
        rr.BarChart(
            counts.astype(np.float64),
            abscissa=edges[:-1],
            widths=np.diff(edges),
            color=rgba(SKY),
        ),
        stage=stage.stage,
    )


def log_figures(file: RecordingFile, rows: Sequence[StageFigures], *, stages: int) -> None:
    """The newest stage's figures as scalars, and all so far as bars against the stage."""
    newest = rows[-1]
    for name in paths.FIGURES:
        value = getattr(newest, name)
        if value is not None:
            file.on_stage_only(paths.figure(name), rr.Scalars(float(value)), stage=newest.stage)
    if is_redrawn(newest.stage, stages=stages):
        _log_bars(file, rows)


def is_redrawn(stage: int, *, stages: int) -> bool:
    """Whether what shows all stages so far is written again after this one.

    With very many stages, doing so after each would grow with the square of their number.
    """
    every = max(1, math.ceil(stages / ALWAYS_REDRAWN))
    return stage % every == 0 or stage >= stages - 1


def _log_bars(file: RecordingFile, rows: Sequence[StageFigures]) -> None:
    draw = partial(_log_bar, file, newest=rows[-1].stage)
    plain: Mapping[str, Rgba] = {
        "threshold": rgba(GREEN),
        "failures": rgba(VERMILLION),
        "ess": rgba(SKY),
        "loss": rgba(PURPLE),
    }
    for name, color in plain.items():
        draw(rows, name=name, path=paths.bars(name), color=color, width=BAR_WIDTH)
    middle, width = "log10_probability", BAR_WIDTH / 3
    draw(rows, name=middle, path=paths.bars(middle), color=rgba(ORANGE), width=width)
    held = [row for row in rows if not row.caveats]
    doubted = [row for row in rows if row.caveats]
    for name, shift in (("log10_ci_low", -width), ("log10_ci_high", width)):
        end = partial(draw, name=name, width=width, shift=shift)
        end(held, path=paths.bars(name), color=rgba(SKY))
        end(doubted, path=paths.doubted_bars(name), color=rgba(GREY))


def _log_bar(
    file: RecordingFile,
    rows: Sequence[StageFigures],
    *,
    name: str,
    path: str,
    color: Rgba,
    width: float,
    newest: int,
    shift: float = 0.0,
) -> None:
    """Bars centred on the stage's number plus ``shift``; rerun places them by the left edge."""
    points = [
        (row.stage, float(getattr(row, name))) for row in rows if getattr(row, name) is not None
    ]
    if not points:
        return
    stages = np.array([stage for stage, _ in points], dtype=np.float64)
    file.at_stage(
        path,
        rr.BarChart(
            np.array([value for _, value in points]),
            abscissa=stages + shift - width / 2,
            widths=np.full(stages.size, width),
            color=color,
        ),
        stage=newest,
    )


def log_repetitions(file: RecordingFile, log10_probabilities: Sequence[float | None]) -> None:
    """One bar for each repetition's estimate."""
    estimates = [(i, value) for i, value in enumerate(log10_probabilities) if value is not None]
    if not estimates:
        return
    places = np.array([place for place, _ in estimates], dtype=np.float64)
    file.static(
        paths.REPETITIONS,
        rr.BarChart(
            np.array([value for _, value in estimates]),
            abscissa=places - BAR_WIDTH / 2,
            widths=np.full(places.size, BAR_WIDTH),
            color=rgba(ORANGE),
        ),
    )
