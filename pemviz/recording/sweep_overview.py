"""A recording that shows all estimates of a sweep at a glance; nothing in it has a time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from pemviz.colors import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, Rgba
from pemviz.recording import paths
from pemviz.recording.plot import GRID, ui, written
from pemviz.recording.shades import WORDS, shade
from pemviz.recording.stream import RecordingFile, blueprint_of

COLORS = tuple(map(shade, (SKY, ORANGE, GREEN, VERMILLION, PURPLE, BLUE)))
WIDTH_TO_HEIGHT = 1.8
SETTING_GAP = 1.5  # between settings, in rows
MARGIN_ROWS = 1.5
MOST_GRID_LINES = 12


@dataclass(frozen=True)
class SweepEstimate:
    """One run of a sweep; ``None`` where something is not known.

    Attributes:
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
    """All runs of one setting, one a seed; the title is the setting in a few words."""

    title: str
    estimates: tuple[SweepEstimate, ...]


@dataclass(frozen=True)
class SweepTexts:
    """Markdown: settings in rows, runs in rows, what all share and how to run this again."""

    summary: str
    runs: str
    settings: str


def write_sweep_overview(
    path: Path, settings: Sequence[SweepSetting], texts: SweepTexts, *, name: str
) -> None:
    """Write the recording, over one that is there; the viewer shows it under its name.

    Raises:
        RunError: It cannot be written.
    """
    recording = RecordingFile(path, name=name, layout="sweep")
    recording.blueprint(_blueprint())
    recording.markdown(paths.SWEEP_SUMMARY, texts.summary)
    recording.markdown(paths.SWEEP_RUNS, texts.runs)
    recording.markdown(paths.SWEEP_SETTINGS, texts.settings)
    if any(setting.estimates for setting in settings):
        _log_estimates(recording, settings)
    recording.close()


def _blueprint() -> rrb.Blueprint:
    estimates = rrb.Spatial2DView(
        name="Estimate and 95 % interval (thin grey: not a 95 % interval), log10",
        origin=paths.SWEEP_ESTIMATES,
    )
    summary = rrb.TextDocumentView(name="Summary", origin=paths.SWEEP_SUMMARY)
    tabs = rrb.Tabs(
        rrb.Vertical(estimates, summary, name="Estimates", row_shares=[3, 2]),
        rrb.TextDocumentView(name="Runs", origin=paths.SWEEP_RUNS),
        rrb.TextDocumentView(name="Settings", origin=paths.SWEEP_SETTINGS),
    )
    return blueprint_of(tabs, rrb.TimePanel(state="hidden"))


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
    every = [one for setting in settings for one in setting.estimates]
    values = [
        value
        for one in every
        for value in (one.log10_probability, one.log10_ci_low, one.log10_ci_high)
        if value is not None
    ]
    low, high = (min(values), max(values)) if values else (-1.0, 0.0)
    first_rows: list[float] = []
    row = MARGIN_ROWS
    for setting in settings:
        first_rows.append(row)
        row += len(setting.estimates) + SETTING_GAP
    # half a decade for what has no value, at the left
    return _Frame(math.floor(low - 0.5), math.ceil(high), row, tuple(first_rows))


def _log_estimates(recording: RecordingFile, settings: Sequence[SweepSetting]) -> None:
    frame = _frame(settings)
    step = max(1, math.ceil((frame.high - frame.low) / MOST_GRID_LINES))
    decades = list(range(int(frame.low) + 1, int(frame.high) + 1, step))
    grid = [[(frame.x(d), 0.0), (frame.x(d), frame.rows)] for d in decades]
    lines = rr.LineStrips2D(grid, colors=WORDS, radii=ui(GRID))
    recording.static(paths.sweep_estimates("grid/lines"), lines)
    above, grey = [(frame.x(d), -0.3) for d in decades], [WORDS] * len(decades)
    numbers = written(above, [f"1e{d}" for d in decades], colors=grey)
    recording.static(paths.sweep_estimates("grid/decades"), numbers)
    beside = [
        (-0.25 * frame.rows, first + 0.5 * (len(setting.estimates) - 1))
        for setting, first in zip(settings, frame.first_rows, strict=True)
    ]
    own = [COLORS[number % len(COLORS)] for number in range(len(settings))]
    titles = written(beside, [setting.title for setting in settings], colors=own)
    recording.static(paths.sweep_estimates("settings"), titles)
    points: list[tuple[float, float]] = []
    labels: list[str] = []
    colors: list[Rgba] = []
    strips: list[list[tuple[float, float]]] = []
    strip_colors: list[Rgba] = []
    strip_radii: list[Any] = []
    for setting, first, setting_color in zip(settings, frame.first_rows, own, strict=True):
        for row, one in enumerate(setting.estimates):
            known = one.log10_probability is not None
            color = setting_color if known else shade(GREY)
            at = frame.low if one.log10_probability is None else one.log10_probability
            points.append((frame.x(at), first + row))
            labels.append(estimate_label(setting.title, one))
            colors.append(color)
            if one.log10_ci_low is not None and one.log10_ci_high is not None:
                ends = (frame.x(one.log10_ci_low), frame.x(one.log10_ci_high))
                strips.append([(end, first + row) for end in ends])
                strip_colors.append(shade(GREY) if one.caveats else color)
                strip_radii.append(ui(0.5) if one.caveats else ui(1.5))
    intervals = rr.LineStrips2D(strips, colors=strip_colors, radii=strip_radii)
    recording.static(paths.sweep_estimates("intervals"), intervals)
    dots = rr.Points2D(points, colors=colors, labels=labels, show_labels=False, radii=ui(4.0))
    recording.static(paths.sweep_estimates("points"), dots)


def estimate_label(title: str, one: SweepEstimate) -> str:
    """What is said of a point: whose it is, its estimate, and why its interval is none."""
    where = f"{title}, seed {one.seed}"
    if one.log10_probability is None:
        return f"{where}: {one.note}"
    words = f"; not a 95 % interval: {'; '.join(one.caveats)}" if one.caveats else ""
    return f"{where}: {10.0**one.log10_probability:.3g}{words}"
