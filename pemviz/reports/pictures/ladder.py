"""The ladder of uncertainty, drawn: a bar for each source of doubt on one logarithmic axis."""

import math
from collections.abc import Sequence
from html import escape

from pemviz.colors import RUNGS
from pemviz.reports.ladder_text import LADDER_TITLE
from pemviz.reports.pictures.html import number
from pemviz.reports.pictures.svg import FAINT, FONT, GRID, INK, nice_ticks
from pemviz.runs.ladder import Rung, uncertainty_ladder
from pemviz.runs.result import RunResult

WIDTH, ROW, TOP, BOTTOM = 360, 25, 16, 18
LEFT, RIGHT = 0, 352
MARGIN = 12
"""Pixels within which a tick's label would not fit around it."""
FARTHEST = -40.0
"""Decades below which nothing is drawn: an end below, or 0, is drawn as an arrow."""


def ladder_plot(result: RunResult) -> str:
    """The rungs as SVG, each with its name and ends; empty without an estimate."""
    rungs = uncertainty_ladder(result)
    if not rungs:
        return ""
    low = _lowest(rungs)
    height = TOP + ROW * len(rungs) + BOTTOM
    parts = [
        f"<svg viewBox='0 0 {WIDTH} {height}' width='100%' role='img' aria-label='{LADDER_TITLE}'>",
        f"<text x='{LEFT}' y='11' {FONT} font-size='11' font-weight='600' "
        f"fill='{INK}'>{LADDER_TITLE}</text>",
        *_axis(low, height),
        *(_row(rung, TOP + ROW * place, low) for place, rung in enumerate(rungs)),
        "</svg>",
    ]
    return "".join(parts)


def _lowest(rungs: Sequence[Rung]) -> float:
    """The axis' first decade."""
    ends = [end for rung in rungs for end in (rung.low, rung.high) if end]
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


def _tip(rung: Rung) -> str:
    note = f"{rung.note}; " if rung.note else ""
    return f"{note}narrowed by: {rung.narrowed_by}"


def _row(rung: Rung, top: float, low: float) -> str:
    """Name and ends in words, the bar below; dashed where an end is not known."""
    name = escape(rung.name)
    text = (
        f"<text x='{LEFT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{INK}'>{name}"
        f"<title>{escape(_tip(rung))}</title></text>"
    )
    middle, color = top + 19.0, RUNGS[rung.kind]
    if rung.low is None or rung.high is None:
        line = (
            f"<line x1='{LEFT}' x2='{RIGHT}' y1='{middle}' y2='{middle}' stroke='{color}' "
            "stroke-width='1.5' stroke-dasharray='2 4'/>"
            f"<text x='{RIGHT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{FAINT}' "
            "text-anchor='end'>not bounded</text>"
        )
        return text + line
    ends = (
        f"<text x='{RIGHT}' y='{top + 11:.1f}' {FONT} font-size='10.5' fill='{FAINT}' "
        f"text-anchor='end'>{number(rung.low, 2)} to {number(rung.high, 2)}</text>"
    )
    start, end = _x(rung.low, low), _x(rung.high, low)
    bar = (
        f"<rect x='{start:.1f}' y='{middle - 3:.1f}' width='{max(end - start, 3.0):.1f}' "
        f"height='6' rx='2' fill='{color}'/>"
    )
    return text + ends + bar
