"""Intervals on a logarithmic axis, drawn with characters.

A job summary page shows neither inline SVG nor pictures that lie beside it; text in a fence
shows there as in every terminal and editor.
"""

import math
from dataclasses import dataclass
from typing import TypeGuard

WIDTH = 64


@dataclass(frozen=True)
class IntervalRow:
    """One row of the plot.

    Attributes:
        label: At its left.
        value: Drawn as ``o``; ``None`` or 0 is not drawn.
        low: Left end of the interval; 0 is drawn as an arrow to the left, ``None`` not at all.
        high: Right end.
        mark: What stands for the value.
        holds: Whether the interval holds at its level; one that does not is dotted.
    """

    label: str
    value: float | None
    low: float | None = None
    high: float | None = None
    mark: str = "o"
    holds: bool = True


def interval_plot(rows: list[IntervalRow], *, width: int = WIDTH) -> str:
    """The rows over one axis in powers of ten; empty if no row has a positive figure."""
    figures = [value for row in rows for value in (row.value, row.low, row.high)]
    positive = [value for value in figures if _drawable(value)]
    if not positive:
        return ""
    low = math.floor(min(map(math.log10, positive)) + 1e-9)
    high = math.ceil(max(map(math.log10, positive)) - 1e-9)
    if high == low:
        low, high = low - 1, high + 1
    axis = _Axis(low=low, high=high, width=width)
    label_width = max(len(row.label) for row in rows)
    drawn = [f"{row.label:<{label_width}}  {_draw(row, axis)}".rstrip() for row in rows]
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


def _draw(row: IntervalRow, axis: _Axis) -> str:
    line = [" "] * axis.width
    if row.low is not None and _drawable(row.high):
        first = axis.column(math.log10(row.low)) if row.low > 0.0 else 0
        last = axis.column(math.log10(row.high))
        between, end = ("-", "|") if row.holds else (".", ":")
        line[first : last + 1] = between * (last + 1 - first)
        line[first] = end if row.low > 0.0 else "<"
        line[last] = end
    if _drawable(row.value):
        line[axis.column(math.log10(row.value))] = row.mark
    if not "".join(line).strip():
        return "(nothing to draw: no failure was seen)"
    return "".join(line)
