"""The numbers behind a chart as a table: one row a value, whatever mark it is drawn with.

Columns are ``series``, the labels of the axes with their units, and where a mark has more than a
place, ``low`` and ``high``, whether that is an interval at its level, and a note.
"""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.charts import chart as marks
from pemviz.charts.chart import Axis, Chart, IntervalChart, PlaneChart

SERIES, HOLDS, NOTE = "series", "interval at its level", "note"
ACTING = ("=", "+", "-", "@", "\t", "\r")
"""What makes a spreadsheet take text for a formula."""


@dataclass(frozen=True)
class Place:
    """One row; ``None`` where a mark has no such thing."""

    series: str
    x: float | None = None
    y: float | None = None
    low: float | None = None
    high: float | None = None
    value: float | None = None
    holds: bool | None = None
    note: str = ""


def chart_csv(chart: Chart) -> str:
    """A chart's numbers with every digit, as CSV; columns in which nothing stands are left out."""
    heads, rows = _intervals(chart) if isinstance(chart, IntervalChart) else _plane(chart)
    texts = [[_cell(value) for value in row] for row in rows]
    kept = [column for column in range(len(heads)) if any(row[column] for row in texts)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([row[column] for column in kept] for row in [heads, *texts])
    return stream.getvalue()


def _cell(value: object) -> str:
    """Text of anyone's is kept from acting; numbers stand as they are."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "no"
        case str():
            return f"'{value}" if value.startswith(ACTING) else value
        case float() | int():
            return "" if math.isnan(value) else repr(float(value))
        case _:
            raise TypeError(value)


def _intervals(chart: IntervalChart) -> tuple[list[str], list[tuple[object, ...]]]:
    label = chart.label
    rows: list[tuple[object, ...]] = []
    for row in chart.rows:
        holds = None if row.low is None else row.holds
        for value in row.values or (None,):
            rows.append((row.name, value, row.low, row.high, holds, row.figures))
    rows += [(rule.label, rule.at, None, None, None, "") for rule in chart.rules]
    return [SERIES, label, f"{label}: low", f"{label}: high", HOLDS, NOTE], rows


def _plane(chart: PlaneChart) -> tuple[list[str], list[tuple[object, ...]]]:
    x, y = chart.x, chart.y
    cells = (mark.quantity for mark in chart.marks if isinstance(mark, marks.Cells))
    label = y.label or "about"
    heads = [
        SERIES,
        x.label,
        label,
        f"{label}: low",
        f"{label}: high",
        next(cells, ""),
        HOLDS,
        NOTE,
    ]
    rows = [
        (one.series, _worded(x, one.x), _worded(y, one.y), one.low, one.high, one.value, one.holds,
         one.note)
        for mark in chart.marks
        for one in _places(chart, mark)
    ]  # fmt: skip
    return heads, rows


def _worded(axis: Axis, value: float | None) -> object:
    """What stands at a value of an axis of kinds; elsewhere the value."""
    if value is None or not axis.words or axis.ticks is None:
        return value
    return dict(zip(axis.ticks, axis.words, strict=True)).get(value, value)


def _places(chart: PlaneChart, mark: marks.Mark) -> Iterator[Place]:  # noqa: PLR0912  one a kind
    """The rows of a mark."""
    match mark:
        case marks.Line():
            series = mark.label or mark.name or mark.tip or chart.title
            for at, up in zip(mark.x.tolist(), mark.y.tolist(), strict=True):
                yield Place(series, at, up)
        case marks.Points():
            series = mark.label or mark.name or chart.title
            for at, up, note in zip(
                mark.x.tolist(), mark.y.tolist(), _notes(mark.tips, mark.x.size), strict=True
            ):
                yield Place(series, at, up, note=note)
        case marks.Strokes():
            for at, up in zip(mark.x.tolist(), mark.y.tolist(), strict=True):
                yield Place(mark.label, at, up)
        case marks.Whiskers():
            ends = zip(mark.x.tolist(), mark.low.tolist(), mark.high.tolist(), strict=True)
            for (at, low, high), holds in zip(ends, mark.holds, strict=True):
                yield Place(mark.label or chart.title, at, low=low, high=high, holds=holds)
        case marks.Bars():
            middle = (mark.edges[:-1] + mark.edges[1:]) / 2.0
            heights = mark.heights.tolist()
            notes = _notes(mark.tips, middle.size)
            for at, up, note in zip(middle.tolist(), heights, notes, strict=True):
                yield Place(mark.label or chart.title, at, up, note=note)
        case marks.Band():
            yield Place(mark.label, low=mark.low, high=mark.high, holds=mark.holds)
        case marks.Rule():
            yield Place(mark.label, mark.at) if mark.upright else Place(mark.label, y=mark.at)
        case marks.Veil():
            yield Place(mark.label or "veil", mark.at)
        case marks.Box():
            yield Place(f"{mark.label}: from", mark.low_x, mark.low_y)
            yield Place(f"{mark.label}: to", mark.high_x, mark.high_y)
        case marks.Cells():
            yield from _shades(chart, mark)


def _notes(tips: Sequence[str], count: int) -> Sequence[str]:
    return tips or ("",) * count


def _shades(chart: PlaneChart, mark: marks.Cells) -> Iterator[Place]:
    """The middle of each shade with its value."""
    rows, columns = mark.values.shape
    across, up = (
        axis.low + (np.arange(count) + 0.5) / count * (axis.high - axis.low)
        for axis, count in ((chart.x, columns), (chart.y, rows))
    )
    for row, values in zip(up.tolist(), mark.values.tolist(), strict=True):
        for column, value in zip(across.tolist(), values, strict=True):
            yield Place(mark.title, column, row, value=value)
