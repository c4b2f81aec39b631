"""Charts as SVG within pages: readable at any width, with what pointers and clicks need.

Drawn by hand, by :mod:`pemviz.charts.plot`, and not by matplotlib: the panel redraws charts while
a person waits and adds a cursor at every step that is played; a chart here takes 1 ms.
"""

import math
from collections.abc import Callable
from html import escape
from itertools import pairwise

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.charts import plot
from pemviz.charts.chart import (
    DASHED,
    DOTTED,
    Axis,
    Bars,
    Box,
    Cells,
    Chart,
    IntervalChart,
    Line,
    Mark,
    PlaneChart,
    Points,
    Row,
    Rule,
    Whiskers,
)
from pemviz.charts.decades import axis_decades, decade
from pemviz.charts.plot import FAINT, GRID, INK, Plot, text

INTERVAL_PX, ROW_PX, TOP_PX, BOTTOM_PX, EDGE_PX = 360, 26, 18, 32, 4
LEGEND_ROW_PX, LEVELS_PX = 14, 128
CHARACTER_PX = 5.4
"""How wide a character of a legend is, on average."""

Clickable = Callable[[str], str]
"""Attributes of what holds points with a ``data-number`` each, by the element id clicks go to."""


def svg(chart: Chart, *, target: str = "", clickable: Clickable | None = None) -> str:
    """A chart as one SVG element.

    Args:
        chart: What to draw.
        target: Element id of the input that a click on a point writes its number into.
        clickable: What makes clicks do so.
    """
    if isinstance(chart, IntervalChart):
        return _intervals(chart)
    return _plane(chart, act=clickable(target) if clickable is not None and target else "")


def _intervals(chart: IntervalChart) -> str:
    """Names and figures above bars; a range that is not known is a faint line."""
    low, high = axis_decades(chart)
    height = TOP_PX + ROW_PX * len(chart.rows) + BOTTOM_PX
    right = INTERVAL_PX - EDGE_PX

    def px(value: float) -> float:
        share = (decade(value, low=low, high=high) - low) / (high - low)
        return EDGE_PX + share * (right - EDGE_PX)

    bottom = height - BOTTOM_PX + 2
    parts = [text(chart.title, 0, 11, color=INK, size=11, weight="600")]
    for tick in plot.nice_ticks(low, high, count=5, whole=True):
        x = px(10.0**tick)
        anchor = "start" if x < 3 * EDGE_PX else "end" if x > right - 3 * EDGE_PX else "middle"
        parts.append(f"<path d='M{x:.1f} {TOP_PX}V{bottom}' stroke='{GRID}'/>")
        parts.append(text(plot.power(tick), x, bottom + 12, anchor=anchor, size=9, raw=True))
    parts.append(text(chart.label, (EDGE_PX + right) / 2, height - 4, anchor="middle", size=9.5))
    for rule in chart.rules:
        line = f"<path d='M{px(rule.at):.1f} {TOP_PX}V{bottom}' stroke='{rule.color}'"
        parts.append(f"{line} stroke-dasharray='{rule.dash}'>{_tip(rule.label)}</path>")
    for place, row in enumerate(chart.rows):
        parts.append(_row(row, TOP_PX + ROW_PX * place, px, right))
    return plot.svg("".join(parts), width=INTERVAL_PX, height=height, title=chart.title)


def _row(row: Row, top: float, px: Callable[[float], float], right: float) -> str:
    middle = top + 19.0
    words = text(row.name, 0, top + 11, color=INK) + text(
        row.figures, right, top + 11, anchor="end"
    )
    parts = [f"<g stroke='#ffffff' stroke-width='3' style='paint-order:stroke'>{words}</g>"]
    if row.low is None or row.high is None:
        known = bool(row.values)
        if not known:
            line = f"<path d='M{EDGE_PX} {middle}H{right}' stroke='{row.color}'"
            parts.append(f"{line} stroke-width='1.5' stroke-dasharray='2 4'/>")
    elif row.holds:
        start, end = px(row.low), px(row.high)
        parts.append(
            f"<rect x='{start:.1f}' y='{middle - 3:.1f}' width='{max(end - start, 3.0):.1f}' "
            f"height='6' rx='2' fill='{row.color}' fill-opacity='0.8'/>"
        )
    else:
        start, end = px(row.low), px(row.high)
        line = f"<path d='M{start:.1f} {middle}H{max(end, start + 3.0):.1f}' stroke='{row.color}'"
        parts.append(f"{line} stroke-width='4' stroke-dasharray='3 3'/>")
    for value in row.values:
        spot = f"<circle cx='{px(value):.1f}' cy='{middle}' r='3.4' fill='{row.color}'"
        parts.append(f"{spot} stroke='#ffffff'/>")
    return f"<g>{_tip(row.tip or row.name)}{''.join(parts)}</g>"


def _plane(chart: PlaneChart, *, act: str) -> str:
    entries = [
        (mark.label, mark.color, _dash(mark))
        for mark in chart.marks
        if not isinstance(mark, Cells | Rule) and mark.label
    ]
    cells = next((mark for mark in chart.marks if isinstance(mark, Cells)), None)
    rows = _legend_rows(entries, chart.width - 60)
    drawn = Plot(
        title=chart.title,
        x=_axis(chart.x),
        y=_axis(chart.y),
        width=chart.width,
        height=chart.height + LEGEND_ROW_PX * len(rows),
        left=52,
        right=LEVELS_PX if cells is not None else 10,
        bottom=34 + LEGEND_ROW_PX * len(rows),
    )
    over = "".join(_draw(drawn, chart, mark, act=act) for mark in chart.marks)
    for place, row in enumerate(rows):
        x = drawn.left - 10
        for entry in row:
            drawn.legend([entry], x=x, y=drawn.bottom + 42 + LEGEND_ROW_PX * place)
            x += _entry_px(entry)
    if cells is not None:
        over += _levels(drawn, cells)
    return drawn.text(extra=over)


def _axis(axis: Axis) -> plot.Axis:
    low, high = (_place(axis, end) for end in (axis.low, axis.high))
    ticks = None if axis.ticks is None else tuple(_place(axis, tick) for tick in axis.ticks)
    return plot.Axis(low, high, axis.label, log10=axis.log10, ticks=ticks)


def _place(axis: Axis, value: float) -> float:
    return decade(value) if axis.log10 else value


def _places(axis: Axis, values: FloatArray) -> FloatArray:
    return np.array([_place(axis, value) for value in np.asarray(values).tolist()])


def _draw(drawn: Plot, chart: PlaneChart, mark: Mark, *, act: str) -> str:
    """Put a mark on the plot; what has to lie over it comes back."""
    x, y = chart.x, chart.y
    match mark:
        case Line():
            drawn.line(
                _places(x, mark.x), _places(y, mark.y), color=mark.color, width=mark.width,
                dash=mark.dash, opacity=mark.opacity, tip=mark.tip,
            )  # fmt: skip
        case Points():
            return _points(drawn, _places(x, mark.x), _places(y, mark.y), mark, act=act)
        case Whiskers():
            at, low, high = _places(x, mark.x), _places(y, mark.low), _places(y, mark.high)
            for place, holds in enumerate(mark.holds):
                dash = "" if holds else DOTTED
                drawn.whisker(at[place], low[place], high[place], color=mark.color, dash=dash)
        case Bars():
            drawn.bars(_places(x, mark.edges), mark.heights, color=mark.color, tips=mark.tips)
        case Rule() if mark.upright:
            upright = [one for one in chart.marks if isinstance(one, Rule) and one.upright]
            above = len(upright) - 1 - upright.index(mark)
            drawn.vline(
                _place(x, mark.at), color=mark.color, label=mark.label, dash=mark.dash, above=above
            )
        case Rule():
            drawn.hline(_place(y, mark.at), color=mark.color, label=mark.label, dash=mark.dash)
        case Cells():
            return _shades(drawn, mark)
        case Box():
            left, right = drawn.px(mark.low_x), drawn.px(mark.high_x)
            bottom, top = drawn.py(mark.low_y), drawn.py(mark.high_y)
            return (
                f"<rect x='{left:.1f}' y='{top:.1f}' width='{right - left:.1f}' "
                f"height='{bottom - top:.1f}' fill='none' stroke='{mark.color}' "
                f"stroke-dasharray='{DASHED}'/>"
            )
    return ""


def _points(drawn: Plot, x: FloatArray, y: FloatArray, mark: Points, *, act: str) -> str:
    """Discs over all else, with a wider ring that a pointer finds; none beyond the axes."""
    tips = mark.tips or ("",) * x.size
    shapes: list[str] = []
    for place, (at, up, tip) in enumerate(zip(x.tolist(), y.tolist(), tips, strict=True), start=1):
        px, py = drawn.px(at), drawn.py(min(max(up, drawn.y.low), drawn.y.high))
        if not drawn.left - 1 <= px <= drawn.right + 1:
            continue
        spot = f"<circle cx='{px:.1f}' cy='{py:.1f}' r='{mark.radius}' fill='{mark.color}'"
        ring = f"<circle cx='{px:.1f}' cy='{py:.1f}' r='{mark.radius + 3}' fill='transparent'/>"
        number = f" data-number='{place}'" if mark.clickable else ""
        shapes.append(
            f"<g{number}>{_tip(tip)}{spot} stroke='#ffffff' stroke-width='0.6'/>{ring}</g>"
        )
    clicks = f" {act} style='cursor:pointer'" if act and mark.clickable else ""
    return f"<g{clicks}>{''.join(shapes)}</g>"


def _shades(drawn: Plot, mark: Cells) -> str:
    """Neighbours of a row with the same level as one rectangle."""
    shapes: list[str] = []
    rows, columns = mark.values.shape
    height = (drawn.bottom - drawn.top) / rows
    width = (drawn.right - drawn.left) / columns
    for row, values in enumerate(mark.values.tolist()):
        shades = [_shade(mark, value) for value in values]
        changes = np.flatnonzero(np.array(shades[1:]) != np.array(shades[:-1])) + 1
        for first, last in pairwise([0, *changes.tolist(), columns]):
            shapes.append(
                f"<rect x='{drawn.left + first * width:.2f}' width='{(last - first) * width:.2f}' "
                f"y='{drawn.bottom - (row + 1) * height:.2f}' height='{height + 0.6:.2f}' "
                f"fill='{shades[first]}' shape-rendering='crispEdges'/>"
            )
    return "".join(shapes)


def _shade(mark: Cells, value: float) -> str:
    if not math.isfinite(value):
        return mark.unknown
    found = (level.color for level in mark.levels if value >= level.low)
    return next(found, mark.levels[-1].color)


def _levels(drawn: Plot, cells: Cells) -> str:
    """A swatch a level beside the plot, the highest on top, and what is not known."""
    x, y = drawn.right + 10, drawn.top + 4
    parts = [text(cells.title, x, y + 4, color=INK, weight="600", size=10)]
    entries = [
        *((level.words, level.color) for level in cells.levels),
        ("not known", cells.unknown),
    ]
    for place, (words, color) in enumerate(entries):
        top = y + 13 + 17 * place
        swatch = f"<rect x='{x}' y='{top}' width='13' height='13' fill='{color}'"
        parts.append(f"{swatch} stroke='{FAINT}' stroke-width='0.5'/>")
        parts.append(text(words, x + 17, top + 10, size=9.5))
    return "".join(parts)


def _dash(mark: Mark) -> str:
    if isinstance(mark, Line):
        return mark.dash
    if isinstance(mark, Whiskers) and not all(mark.holds):
        return DOTTED
    return DASHED if isinstance(mark, Box) else "2 2" if isinstance(mark, Points) else ""


def _legend_rows(
    entries: list[tuple[str, str, str]], room_px: float
) -> list[list[tuple[str, str, str]]]:
    """Entries in as few rows as they fit into."""
    rows: list[list[tuple[str, str, str]]] = []
    left_px = 0.0
    for entry in entries:
        if not rows or left_px < _entry_px(entry):
            rows.append([])
            left_px = room_px
        rows[-1].append(entry)
        left_px -= _entry_px(entry)
    return rows


def _entry_px(entry: tuple[str, str, str]) -> float:
    return 30.0 + CHARACTER_PX * len(entry[0])


def _tip(words: str) -> str:
    return f"<title>{escape(words)}</title>" if words else ""
