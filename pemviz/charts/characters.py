"""Charts of intervals, drawn with characters.

A job summary page shows neither inline SVG nor pictures that lie beside it; text in a fence
shows there as in every terminal and editor.
"""

import math
from collections.abc import Callable
from typing import TypeGuard

from pemviz.charts.chart import Chart, IntervalChart, Row

WIDTH = 64


def characters(chart: Chart) -> str:
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

    def column(log10: float) -> int:
        return round(min(max((log10 - low) / (high - low), 0.0), 1.0) * (WIDTH - 1))

    # thinned so that labels do not touch
    every = max(1, math.ceil((high - low) * 9 / WIDTH))
    ruler, labels = ["-"] * WIDTH, [" "] * (WIDTH + 8)
    for exponent in range(low, high + 1, every):
        place, text = column(exponent), f"1e{exponent}" if exponent else "1"
        ruler[place] = "+"
        labels[place : place + len(text)] = text
    label_width = max(len(row.name) for row in chart.rows)
    drawn = [f"{row.name:<{label_width}}  {_draw(row, column)}".rstrip() for row in chart.rows]
    indent = " " * (label_width + 2)
    return "\n".join([*drawn, indent + "".join(ruler), indent + "".join(labels).rstrip()])


def _drawable(value: float | None) -> TypeGuard[float]:
    return value is not None and value > 0.0 and math.isfinite(value)


def _draw(row: Row, column: Callable[[float], int]) -> str:
    line = [" "] * WIDTH
    if row.low is not None and _drawable(row.high):
        first = column(math.log10(row.low)) if row.low > 0.0 else 0
        last = column(math.log10(row.high))
        between, end = ("-", "|") if row.holds else (".", ":")
        line[first : last + 1] = between * (last + 1 - first)
        line[first] = end if row.low > 0.0 else "<"
        line[last] = end
    for value in row.values:
        if _drawable(value):
            line[column(math.log10(value))] = row.mark
    if not "".join(line).strip():
        is_known = row.low is not None or row.values
        return "(nothing to draw: no violation was seen)" if is_known else "(not known)"
    return "".join(line)
