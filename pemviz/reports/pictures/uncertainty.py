"""The uncertainty budget, drawn: a bar for each source on one logarithmic axis."""

import math
from collections.abc import Sequence
from html import escape

from pemviz.colors import SOURCES
from pemviz.reports.pictures.html import number
from pemviz.reports.pictures.svg import FAINT, FONT, GRID, INK, nice_ticks
from pemviz.reports.uncertainty_text import UNCERTAINTY_TITLE
from pemviz.runs.result import RunResult
from pemviz.runs.uncertainty import UncertaintySource, uncertainty_budget

WIDTH, ROW, TOP, BOTTOM = 360, 25, 16, 18
LEFT, RIGHT = 0, 352
MARGIN = 12
"""Pixels within which a tick's label would not fit around it."""
FARTHEST = -40.0
"""Decades below which nothing is drawn: an end below, or 0, is drawn as an arrow."""


def uncertainty_plot(result: RunResult) -> str:
    """The sources as SVG, each with its name and ends; empty without an estimate."""
    sources = uncertainty_budget(result)
    if not sources:
        return ""
    low = _lowest(sources)
    height = TOP + ROW * len(sources) + BOTTOM
    parts = [
        f"<svg viewBox='0 0 {WIDTH} {height}' width='100%' role='img' "
        f"aria-label='{UNCERTAINTY_TITLE}'>",
        f"<text x='{LEFT}' y='11' {FONT} font-size='11' font-weight='600' "
        f"fill='{INK}'>{UNCERTAINTY_TITLE}</text>",
        *_axis(low, height),
        *(_row(source, TOP + ROW * place, low) for place, source in enumerate(sources)),
        "</svg>",
    ]
    return "".join(parts)


def _lowest(sources: Sequence[UncertaintySource]) -> float:
    """The axis' first decade."""
    ends = [end for source in sources for end in (source.low, source.high) if end]
    return max(min([math.floor(math.log10(end)) - 1.0 for end in ends], default=-20.0), FARTHEST)


def _x(value: float, low: float) -> float:
    decades = math.log10(value) if value > 0.0 else low
    share = (min(max(decades, low), 0.0) - low) / -low
    return LEFT + share * (RIGHT - LEFT)


def _axis(low: float, height: int) -> list[str]:
    parts: list[str] = []
    for tick in nice_ticks(low, 0.0, count=5, whole=True):
        x = _x(10.0**tick, low)
        power = f"{tick:g}".replace("-", "\N{MINUS SIGN}")
        anchor = "start" if x - LEFT < MARGIN else "end" if RIGHT - x < MARGIN else "middle"
        parts.append(
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{TOP}' y2='{height - BOTTOM}' stroke='{GRID}'/>"
            f"<text x='{x:.1f}' y='{height - 5}' {FONT} font-size='9' fill='{FAINT}' "
            f"text-anchor='{anchor}'>10<tspan dy='-3' font-size='7'>{power}</tspan></text>"
        )
    return parts


def _tip(source: UncertaintySource) -> str:
    note = f"{source.note}; " if source.note else ""
    return f"{note}narrowed by: {source.narrowed_by}"


def _row(source: UncertaintySource, top: float, low: float) -> str:
    """Name and ends in words, the bar below; dashed where an end is not known."""
    name = escape(source.name)
    text = (
        f"<text x='{LEFT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{INK}'>{name}"
        f"<title>{escape(_tip(source))}</title></text>"
    )
    middle, color = top + 19.0, SOURCES[source.kind]
    if source.low is None or source.high is None:
        line = (
            f"<line x1='{LEFT}' x2='{RIGHT}' y1='{middle}' y2='{middle}' stroke='{color}' "
            "stroke-width='1.5' stroke-dasharray='2 4'/>"
            f"<text x='{RIGHT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{FAINT}' "
            "text-anchor='end'>not bounded</text>"
        )
        return text + line
    ends = (
        f"<text x='{RIGHT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{FAINT}' "
        f"text-anchor='end'>{number(source.low, 2)} to {number(source.high, 2)}</text>"
    )
    start, end = _x(source.low, low), _x(source.high, low)
    bar = (
        f"<rect x='{start:.1f}' y='{middle - 3:.1f}' width='{max(end - start, 3.0):.1f}' "
        f"height='6' rx='2' fill='{color}'/>"
    )
    return text + ends + bar
