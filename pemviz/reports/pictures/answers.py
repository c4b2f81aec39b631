"""Failure probabilities one below the other on one logarithmic axis, with their ranges."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from pemviz.reports.pictures.html import number
from pemviz.reports.pictures.svg import FAINT, GRID, INK, nice_ticks, svg, text

WIDTH, ROW, TOP, BOTTOM = 560, 24, 10, 30
NAMES, FIGURES = 190, 150
"""Pixels for the names at the left and the figures at the right."""
FARTHEST = -40.0
"""Decades below which nothing is drawn."""


@dataclass(frozen=True)
class AnswerRow:
    """One row.

    Attributes:
        name: At its left.
        value: A point; ``None`` or 0 is not drawn.
        low: Lower end of its range; ``None``: no range.
        high: Upper end; ``None`` likewise.
        color: Of the mark.
        holds: Whether the range is an interval at its level; one that is not is dashed.
    """

    name: str
    value: float | None
    low: float | None
    high: float | None
    color: str
    holds: bool = True


def answers_plot(
    rows: Sequence[AnswerRow], *, title: str, limit: float | None = None, width: int = WIDTH
) -> str:
    """The rows as SVG, with a line at ``limit``; empty where nothing is above 0."""
    ends = [end for row in rows for end in (row.value, row.low, row.high, limit) if end]
    decades = [max(math.log10(end), FARTHEST) for end in ends if math.isfinite(end)]
    if not decades:
        return ""
    low, high = math.floor(min(decades)) - 0.5, math.ceil(max(decades)) + 0.5
    axis = _Axis(low, high, NAMES, width - FIGURES)
    height = TOP + ROW * len(rows) + BOTTOM
    parts = [*axis.ticks(height), *(_row(row, TOP + ROW * i, axis) for i, row in enumerate(rows))]
    if limit:
        x = axis.x(limit)
        parts.append(
            f"<path d='M{x:.1f} {TOP - 4}V{height - BOTTOM}' stroke='{INK}' stroke-width='1.4' "
            f"stroke-dasharray='5 3'><title>{escape(f'{limit:g}')}</title></path>"
        )
    return svg("".join(parts), width=width, height=height, title=title)


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    left: int
    right: int

    def x(self, value: float) -> float:
        decade = math.log10(value) if value > 0.0 else self.low
        share = (min(max(decade, self.low), self.high) - self.low) / (self.high - self.low)
        return self.left + share * (self.right - self.left)

    def ticks(self, height: int) -> list[str]:
        parts: list[str] = []
        for tick in nice_ticks(self.low, self.high, count=6, whole=True):
            x = self.x(10.0**tick)
            power = f"{tick:g}".replace("-", "\N{MINUS SIGN}")
            parts.append(f"<path d='M{x:.1f} {TOP - 4}V{height - BOTTOM}' stroke='{GRID}'/>")
            label = f"10<tspan dy='-4' font-size='8'>{power}</tspan>"
            parts.append(text(label, x, height - BOTTOM + 15, anchor="middle", raw=True))
        words = "probability of a violation"
        middle = (self.left + self.right) / 2
        parts.append(text(words, middle, height - 3, anchor="middle"))
        return parts


def _row(row: AnswerRow, top: float, axis: _Axis) -> str:
    middle = top + ROW / 2
    name = row.name if len(row.name) <= 30 else f"{row.name[:29]}\N{HORIZONTAL ELLIPSIS}"
    parts = [text(name, 0, middle + 4, color=INK, size=11.5)]
    if row.low is not None and row.high is not None:
        start, end = axis.x(row.low), axis.x(row.high)
        dash = "" if row.holds else " stroke-dasharray='3 3'"
        parts.append(
            f"<path d='M{start:.1f} {middle}H{max(end, start + 2.0):.1f}' stroke='{row.color}' "
            f"stroke-width='5' stroke-opacity='0.45'{dash}/>"
        )
    if row.value:
        parts.append(
            f"<circle cx='{axis.x(row.value):.1f}' cy='{middle}' r='4' fill='{row.color}'/>"
        )
    figures = number(row.value, 2) if row.value is not None else ""
    if not figures and row.low is not None and row.high is not None:
        figures = f"{number(row.low, 2)} to {number(row.high, 2)}"
    parts.append(text(figures, axis.right + 10, middle + 4, color=FAINT, size=11.5))
    return f"<g><title>{escape(row.name)}</title>{''.join(parts)}</g>"
