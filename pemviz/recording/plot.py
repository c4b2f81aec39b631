"""Plots drawn in a 2D view: lines, points, intervals and words, with axes and ticks of their own.

The viewer's own plots run along its timelines or are bars. A drawn one can have any axis and error
bars, and zooms as they do. Places are in heights of the plotting area, from its upper left corner.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.charts.chart import IntervalChart, axis_decades, decade, nice_ticks
from pemviz.colors import Rgba
from pemviz.recording import paths
from pemviz.recording.shades import WORDS, shade

ABOVE = 0.1
LEGEND_ROW = 0.155
TICK_Y = 0.03
MOST_TICKS = 6
FEW_TICKS = 4
"""Upwards, where words stand above each other."""
WORDS_AT, BAR_AT = 0.05, 0.72
"""Of the height of a row of intervals, from its top."""
NO_DOT: Any = rr.Radius.ui_points(0.1)
GRID = 0.35
"""Half of a grid line's width, in points of the screen."""


class Log(Protocol):
    """Logs archetypes at a path, at a time that the caller chose."""

    def __call__(self, path: str, *archetypes: Any) -> None:
        """Log them."""
        ...


def ui(points: float) -> Any:
    """A radius on the screen, however far one zooms in."""
    return rr.Radius.ui_points(points)


@dataclass(frozen=True)
class Axis:
    """From value ``low`` to ``high``; ticks are values with their words, units among them."""

    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]


@dataclass(frozen=True)
class Shape:
    """How wide a plot is, and its margins, in its heights: those of a large view are smaller."""

    width: float = 1.75
    left: float = 0.24
    right: float = 0.56
    below: float = 0.2
    words_up: float = 0.06
    """How far words stand above where they are put, as the viewer writes below a place."""

    @property
    def bounds_x(self) -> tuple[float, float]:
        """From the left margin's edge to the right one's."""
        return -self.left, self.width + self.right

    @property
    def bounds_y(self) -> tuple[float, float]:
        """From top to bottom."""
        return -ABOVE, 1.0 + self.below


NORMAL = Shape()
LARGE = Shape(width=1.2, left=0.14, right=0.32, words_up=0.035)
WITHOUT_LEGEND = Shape(width=2.3, left=0.28, right=0.1, below=0.32)
ROWS = Shape(width=1.9, left=0.1, right=0.1)
"""Rows that carry their own words."""
LEGEND_SHARE = 0.6
LETTER, AROUND = 0.055, 0.2
"""How wide a letter of a row's name is, and what is around it, in heights of the plot."""


def named_rows(names: Sequence[str]) -> Shape:
    """Of rows with these names beside them; the longer they are, the more room its legend needs."""
    left = LETTER * max(map(len, names)) + AROUND
    return Shape(left=left, right=max(NORMAL.right, LEGEND_SHARE * left))


@dataclass(frozen=True)
class Frame:
    """Two axes of a plot of some shape."""

    x: Axis
    y: Axis
    shape: Shape = NORMAL

    def places(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Places ``[N, 2]`` of values ``[N]``; what lies beyond an axis is on its end."""
        across, up = (
            np.clip((np.asarray(values, np.float64) - axis.low) / (axis.high - axis.low), 0.0, 1.0)
            for axis, values in ((self.x, x), (self.y, y))
        )
        return np.stack([self.shape.width * across, 1.0 - up], axis=1)

    def across(self, y: float) -> FloatArray:
        """Both ends of a line across at a value of ``y``."""
        return self.places(np.array([self.x.low, self.x.high]), np.full(2, y))

    def upright(self, x: float) -> FloatArray:
        """Both ends of a line upwards at a value of ``x``."""
        return self.places(np.full(2, x), np.array([self.y.low, self.y.high]))


def number_axis(
    low: float, high: float, *, unit: str = "", whole: bool = False, most: int = MOST_TICKS
) -> Axis:
    """An axis with about ``most`` round ticks, their unit behind each; ``whole`` numbers only."""
    if not high > low:
        low, high = low - 0.5, low + 0.5
    ticks = nice_ticks(low, high, count=most, whole=whole)
    words = f" {unit}" if unit else ""
    return Axis(low, high, tuple((tick, f"{tick:.6g}{words}") for tick in ticks))


def decade_axis(low: float, high: float) -> Axis:
    """An axis of decimal logarithms from ``low`` to ``high``, ticks at whole powers of ten."""
    first, last = math.floor(low + 1e-9), math.ceil(high - 1e-9)
    first = min(first, last - 1)
    every = math.ceil((last - first) / MOST_TICKS)
    ticks = tuple((float(e), f"1e{e}" if e else "1") for e in range(last, first - 1, -every))
    return Axis(float(first), float(last), ticks)


def log_axes(log: Log, path: str, frame: Frame) -> None:
    """Grid lines, and words at the ticks."""
    across = [frame.across(value) for value, _ in frame.y.ticks]
    up = [frame.upright(value) for value, _ in frame.x.ticks]
    lines = [*across, *up, frame.across(frame.y.low)]
    widths = [ui(GRID)] * (len(lines) - 1) + [ui(2 * GRID)]
    grid = rr.LineStrips2D(lines, colors=WORDS, radii=widths, draw_order=1.0)
    below = [(place[0][0], 1.0 + TICK_Y) for place in up]
    beside = [(-0.45 * frame.shape.left, place[0][1] - frame.shape.words_up) for place in across]
    words = [words for _, words in (*frame.x.ticks, *frame.y.ticks)]
    ticks = written([*below, *beside], words, colors=[WORDS] * len(words))
    log(paths.part(path, "axes"), grid, ticks)


def written(
    places: Sequence[tuple[float, float]], words: Sequence[str], *, colors: Sequence[Rgba]
) -> rr.Points2D:
    """Words centred below places."""
    return rr.Points2D(
        [(float(x), float(y)) for x, y in places],
        labels=list(words),
        colors=list(colors),
        radii=NO_DOT,
        show_labels=True,
    )


def log_legend(log: Log, path: str, frame: Frame, entries: Sequence[tuple[int, str, Rgba]]) -> None:
    """Words beside the plot: row from the top, words, colour."""
    x = frame.shape.width + 0.5 * frame.shape.right
    places = [(x, row * LEGEND_ROW) for row, _, _ in entries]
    colors = [color for *_, color in entries]
    words = written(places, [words for _, words, _ in entries], colors=colors)
    log(paths.part(path, "legend"), words)


def line(
    frame: Frame, x: FloatArray, y: FloatArray, *, color: Rgba, width: float
) -> rr.LineStrips2D:
    """A line through points ``[N]``; ``width`` in points of the screen."""
    strip = frame.places(x, y)
    return rr.LineStrips2D([strip], colors=color, radii=ui(width / 2), draw_order=20.0 + width)


def dots(frame: Frame, x: FloatArray, y: FloatArray, *, colors: Sequence[Rgba]) -> rr.Points2D:
    """Points ``[N]``."""
    return rr.Points2D(
        frame.places(x, y), colors=list(colors), radii=ui(4.0), draw_order=30.0, show_labels=False
    )


def whiskers(
    frame: Frame, x: FloatArray, low: FloatArray, high: FloatArray, *, colors: Sequence[Rgba]
) -> rr.LineStrips2D:
    """An interval at each of ``[N]`` places, with a cap at either end."""
    bottom, top = frame.places(x, low), frame.places(x, high)
    step = frame.shape.width / max(frame.x.high - frame.x.low, 1.0)
    half = np.array([min(0.03, 0.3 * step), 0.0])
    strips = [
        strip
        for first, last in zip(bottom, top, strict=True)
        for strip in ([first, last], [first - half, first + half], [last - half, last + half])
    ]
    shades = [color for color in colors for _ in range(3)]
    return rr.LineStrips2D(strips, colors=shades, radii=ui(1.0), draw_order=25.0)


def log_intervals(log: Log, path: str, chart: IntervalChart) -> None:
    """Replace what is drawn at a path: a bar a row with words above it, lines across all."""
    rows = Axis(low=float(len(chart.rows)), high=0.0, ticks=())
    frame = Frame(x=decade_axis(*axis_decades(chart)), y=rows, shape=ROWS)
    log_axes(log, path, frame)
    known = [(place, row) for place, row in enumerate(chart.rows) if row.high]
    strips = [
        frame.places(np.array([decade(row.low or 0.0), decade(row.high or 0.0)]),
                     np.full(2, place + BAR_AT))
        for place, row in known
    ]  # fmt: skip
    colors = [shade(row.color) for _, row in known]
    bars = rr.LineStrips2D(strips, colors=colors, radii=ui(3.0), draw_order=20.0)
    middle, count = 0.5 * frame.shape.width, len(chart.rows)
    places = [(middle, (place + WORDS_AT) / count) for place in range(count)]
    words = [f"{row.name}: {row.figures}" for row in chart.rows]
    log(paths.part(path, "sources"), bars, written(places, words, colors=[WORDS] * count))
    if chart.rules:
        lines = [frame.upright(decade(rule.at)) for rule in chart.rules]
        colors = [shade(rule.color) for rule in chart.rules]
        across = rr.LineStrips2D(lines, colors=colors, radii=ui(0.7), draw_order=10.0)
        log(paths.part(path, "answer"), across)
