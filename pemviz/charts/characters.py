"""Charts of intervals, drawn with characters.

A job summary page shows neither inline SVG nor pictures that lie beside it; text in a fence
shows there as in every terminal and editor.
"""

import math
from dataclasses import dataclass
from typing import TypeGuard

from pemviz.charts.chart import Chart, IntervalChart, Row

WIDTH = 64


def characters(chart: Chart, *, width: int = WIDTH) -> str:
    """The rows over one axis in powers of ten; empty if no row has a positive figure.

    An end at 0 is an arrow to the left, an interval that does not hold at its level is dotted.
    Charts of another kind are not drawn.
    """
    if not isinstance(chart, IntervalChart):
        return ""
    figures = [v for row in chart.rows for v in (*row.values, row.low, row.high)]
    positive = [value for value in figures if _drawable(value)]
    if not positive:
        return ""
    low = math.floor(min(map(math.log10, positive)) + 1e-9)
    high = math.ceil(max(map(math.log10, positive)) - 1e-9)
    if high == low:
        low, high = low - 1, high + 1
    axis = _Axis(low=low, high=high, width=width)
    label_width = max(len(row.name) for row in chart.rows)
    drawn = [f"{row.name:<{label_width}}  {_draw(row, axis)}".rstrip() for row in chart.rows]
    indent = " " * (label_width + 2)
    return "\n".join([*drawn, indent + axis.ruler(), indent + axis.labels()])


def _drawable(value: float | None) -> TypeGuard[float]:
    return value is not None and value > 0.0 and math.isfinite(value)


@dataclass(frozen=True)
class _Axis:
    """A logarithmic axis from 10^low to 10^high over ``width`` columns."""

    low: int
    high: int
    width: int

    def column(self, log10_value: float) -> int:
        share = (log10_value - self.low) / (self.high - self.low)
        return round(min(max(share, 0.0), 1.0) * (self.width - 1))

    def ticks(self) -> list[tuple[int, int]]:
        """Exponents and their columns, thinned so that labels do not touch."""
        every = max(1, math.ceil((self.high - self.low) * 9 / self.width))
        return [(e, self.column(e)) for e in range(self.low, self.high + 1, every)]

    def ruler(self) -> str:
        line = ["-"] * self.width
        for _, column in self.ticks():
            line[column] = "+"
        return "".join(line)

    def labels(self) -> str:
        line = [" "] * (self.width + 8)
        for exponent, column in self.ticks():
            text = f"1e{exponent}" if exponent else "1"
            line[column : column + len(text)] = text
        return "".join(line).rstrip()


def _draw(row: Row, axis: _Axis) -> str:
    line = [" "] * axis.width
    if row.low is not None and _drawable(row.high):
        first = axis.column(math.log10(row.low)) if row.low > 0.0 else 0
        last = axis.column(math.log10(row.high))
        between, end = ("-", "|") if row.holds else (".", ":")
        line[first : last + 1] = between * (last + 1 - first)
        line[first] = end if row.low > 0.0 else "<"
        line[last] = end
    for value in row.values:
        if _drawable(value):
            line[axis.column(math.log10(value))] = row.mark
    if not "".join(line).strip():
        return "(nothing to draw: no violation was seen)"
    return "".join(line)
