"""A recording that shows all estimates of a sweep at a glance; nothing in it has a time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from pemviz.colors import (
    BLUE,
    DARK_GREY,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    WHITE,
    Rgba,
    rgba,
)
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile

COLORS = tuple(map(rgba, (SKY, ORANGE, GREEN, VERMILLION, PURPLE, BLUE)))
WIDTH_TO_HEIGHT = 1.8
SETTING_GAP = 1.5  # between settings, in rows
MARGIN_ROWS = 1.5
MOST_GRID_LINES = 12
POINT_RADIUS = rr.Radius.ui_points(4.0)
LINE_RADIUS: Any = rr.Radius.ui_points(1.5)
THIN: Any = rr.Radius.ui_points(0.5)
TEXT_ANCHOR = rr.Radius.ui_points(0.1)


@dataclass(frozen=True)
class SweepEstimate:
    """One run of a sweep.

    Attributes:
        seed: Its seed.
        log10_probability: Of its estimate; ``None`` if nothing failed or it is not done.
        log10_ci_low: Lower bound; ``None`` where unknown.
        log10_ci_high: Upper bound; ``None`` where unknown.
        caveats: Why the bounds are no 95 % interval; empty if they are one.
        note: Shown where there is no estimate: 'no violation', 'failed', 'not run'.
    """

    seed: int
    log10_probability: float | None
    log10_ci_low: float | None = None
    log10_ci_high: float | None = None
    caveats: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class SweepSetting:
    """All runs of one setting.

    Attributes:
        title: The setting in a few words.
        estimates: One a seed.
    """

    title: str
    estimates: tuple[SweepEstimate, ...]


@dataclass(frozen=True)
class SweepTexts:
    """The pages of text, as markdown.

    Attributes:
        summary: Every setting in a row.
        runs: Every run in a row.
        settings: What all runs share, and how to run this again.
    """

    summary: str
    runs: str
    settings: str


def write_sweep_overview(
    path: Path, settings: Sequence[SweepSetting], texts: SweepTexts, *, name: str
) -> None:
    """Write the recording.

    Args:
        path: Where; overwritten if it exists.
        settings: In the order in which they are shown.
        texts: The pages.
        name: The recording's name in the viewer.

    Raises:
        RunError: It cannot be written.
    """
    recording = RecordingFile(path, name=name, layout="sweep")
    recording.blueprint(sweep_blueprint())
    recording.markdown(paths.SWEEP_SUMMARY, texts.summary)
    recording.markdown(paths.SWEEP_RUNS, texts.runs)
    recording.markdown(paths.SWEEP_SETTINGS, texts.settings)
    if any(setting.estimates for setting in settings):
        _log_estimates(recording, settings)
    recording.close()


def sweep_blueprint() -> rrb.Blueprint:
    """Tabs: all estimates above the summary, runs, settings."""
    estimates = rrb.Spatial2DView(
        name="Estimate and 95 % interval (thin grey: not a 95 % interval), log10",
        origin=paths.SWEEP_ESTIMATES,
        background=[20, 20, 22],
    )
    summary = rrb.TextDocumentView(name="Summary", origin=paths.SWEEP_SUMMARY)
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Vertical(estimates, summary, name="Estimates", row_shares=[3, 2]),
            rrb.TextDocumentView(name="Runs", origin=paths.SWEEP_RUNS),
            rrb.TextDocumentView(name="Settings", origin=paths.SWEEP_SETTINGS),
        ),
        rrb.TimePanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


@dataclass(frozen=True)
class _Frame:
    """Where things stand in the plot: a row a run downwards, log10 to the right."""

    low: float
    high: float
    rows: float
    first_rows: tuple[float, ...]

    def x(self, log10: float) -> float:
        """Horizontal place of a value."""
        return (log10 - self.low) / (self.high - self.low) * self.rows * WIDTH_TO_HEIGHT


def _frame(settings: Sequence[SweepSetting]) -> _Frame:
    values = [value for setting in settings for one in setting.estimates for value in _values(one)]
    low, high = (min(values), max(values)) if values else (-1.0, 0.0)
    first_rows: list[float] = []
    row = MARGIN_ROWS
    for setting in settings:
        first_rows.append(row)
        row += len(setting.estimates) + SETTING_GAP
    # half a decade for what has no value, at the left
    return _Frame(math.floor(low - 0.5), math.ceil(high), row, tuple(first_rows))


def _values(one: SweepEstimate) -> list[float]:
    values = (one.log10_probability, one.log10_ci_low, one.log10_ci_high)
    return [value for value in values if value is not None]


def _log_estimates(recording: RecordingFile, settings: Sequence[SweepSetting]) -> None:
    frame = _frame(settings)
    _log_grid(recording, frame)
    _log_titles(recording, frame, settings)
    points: list[tuple[float, float]] = []
    labels: list[str] = []
    colors: list[Rgba] = []
    strips: list[list[tuple[float, float]]] = []
    strip_colors: list[Rgba] = []
    strip_radii: list[Any] = []
    for number, (setting, first) in enumerate(zip(settings, frame.first_rows, strict=True)):
        for place, one in enumerate(setting.estimates):
            row = first + place
            log10_probability = one.log10_probability
            color = rgba(GREY) if log10_probability is None else COLORS[number % len(COLORS)]
            points.append(
                (frame.x(frame.low if log10_probability is None else log10_probability), row)
            )
            labels.append(_label(setting, one))
            colors.append(color)
            if one.log10_ci_low is not None and one.log10_ci_high is not None:
                ends = (frame.x(one.log10_ci_low), frame.x(one.log10_ci_high))
                strips.append([(ends[0], row), (ends[1], row)])
                strip_colors.append(rgba(GREY) if one.caveats else color)
                strip_radii.append(THIN if one.caveats else LINE_RADIUS)
    intervals = rr.LineStrips2D(strips, colors=strip_colors, radii=strip_radii)
    recording.static(paths.sweep_estimates("intervals"), intervals)
    recording.static(
        paths.sweep_estimates("points"),
        rr.Points2D(points, colors=colors, labels=labels, show_labels=False, radii=POINT_RADIUS),
    )


def _label(setting: SweepSetting, one: SweepEstimate) -> str:
    where = f"{setting.title}, seed {one.seed}"
    log10_probability = one.log10_probability
    if log10_probability is None:
        return f"{where}: {one.note}"
    words = f"; not a 95 % interval: {'; '.join(one.caveats)}" if one.caveats else ""
    return f"{where}: {10.0**log10_probability:.3g}{words}"


def _log_grid(recording: RecordingFile, frame: _Frame) -> None:
    step = max(1, math.ceil((frame.high - frame.low) / MOST_GRID_LINES))
    decades = list(range(int(frame.low) + 1, int(frame.high) + 1, step))
    strips = [[(frame.x(d), 0.0), (frame.x(d), frame.rows)] for d in decades]
    recording.static(
        paths.sweep_estimates("grid/lines"),
        rr.LineStrips2D(strips, colors=rgba(DARK_GREY), radii=THIN),
    )
    recording.static(
        paths.sweep_estimates("grid/decades"),
        rr.Points2D(
            [(frame.x(d), -0.3) for d in decades],
            labels=[f"1e{d}" for d in decades],
            colors=rgba(WHITE),
            radii=TEXT_ANCHOR,
            show_labels=True,
        ),
    )


def _log_titles(recording: RecordingFile, frame: _Frame, settings: Sequence[SweepSetting]) -> None:
    recording.static(
        paths.sweep_estimates("settings"),
        rr.Points2D(
            [
                (-0.25 * frame.rows, first + 0.5 * (len(setting.estimates) - 1))
                for setting, first in zip(settings, frame.first_rows, strict=True)
            ],
            labels=[setting.title for setting in settings],
            colors=[COLORS[number % len(COLORS)] for number in range(len(settings))],
            radii=TEXT_ANCHOR,
            show_labels=True,
        ),
    )
