"""An argument drawn as SVG: the top goal at the top left, what supports it to the right of it.

Shapes are those of the Goal Structuring Notation: a goal is a rectangle, a strategy a
parallelogram, a solution has round ends, a context rounded corners, assumptions (A) and
justifications (J) are oval-sided and dashed. What an element stands in is drawn beneath it, several
of a kind in one shape. An undeveloped goal has a diamond. Text that does not fit is cut, and whole
where the pointer rests.
"""

import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from itertools import pairwise

from pemviz.charts.svg import FAINT, INK, svg_element, text
from pemviz.colors import BLUE, GREEN, GREY, ORANGE, VERMILLION
from pemviz.reports.argument import Argument, Element, ElementKind
from pemviz.reports.escape import printable_line

WIDTH_PX, GAP_PX, BETWEEN_PX, BENEATH_PX = 1060, 26, 12, 6
LINE_PX, TEXT_PX, CHARACTER_PX, MARGIN_PX = 12.5, 10, 5.35, 8
BOLD_PX = 6.2
"""A character of a name."""
WIDEST_PX = 300
MOST_LINES: Mapping[ElementKind, int] = {
    "Goal": 8, "Strategy": 5, "Solution": 4, "Context": 5, "Assumption": 7, "Justification": 5,
}  # fmt: skip
COLORS: Mapping[ElementKind, str] = {
    "Goal": BLUE, "Strategy": GREEN, "Solution": ORANGE, "Context": GREY, "Assumption": GREY,
    "Justification": GREY,
}  # fmt: skip


@dataclass(frozen=True)
class _Box:
    """An element with its lines, and where it stands [px]."""

    element: Element
    lines: tuple[str, ...]
    x: float
    y: float
    width: float

    @property
    def height(self) -> float:
        return LINE_PX * (1 + len(self.lines)) + MARGIN_PX


def argument_svg(argument: Argument, *, title: str) -> str:
    """The picture; an element that supports several is drawn beside each of them."""
    by_name = {one.name: one for one in argument}
    columns = _depth(argument[0], by_name)
    width = min((WIDTH_PX - GAP_PX * (columns - 1)) / columns, WIDEST_PX)
    drawn = _Drawing(by_name, width)
    height, _ = drawn.place(argument[0], x=1.0, top=2.0)
    whole = columns * width + GAP_PX * (columns - 1) + 2
    body = "".join((*drawn.lines, *map(_shape, drawn.boxes)))
    return svg_element(body, width=math.ceil(whole), height=math.ceil(height) + 10, title=title)


def _depth(one: Element, by_name: Mapping[str, Element]) -> int:
    below = (by_name[name] for name in one.supported_by if name in by_name)
    return 1 + max((_depth(other, by_name) for other in below), default=0)


class _Drawing:
    """Places elements: each in a block of its own height, in the middle of what supports it."""

    def __init__(self, by_name: Mapping[str, Element], width: float) -> None:
        self._by_name = by_name
        self._width = width
        self.boxes: list[_Box] = []
        self.lines: list[str] = []

    def place(self, one: Element, *, x: float, top: float) -> tuple[float, _Box]:
        """Draw an element and all to its right from ``top`` on; gives its block's height."""
        children = [self._by_name[n] for n in one.supported_by if n in self._by_name]
        at, boxes = top, list[_Box]()
        for child in children:
            height, box = self.place(child, x=x + self._width + GAP_PX, top=at)
            boxes.append(box)
            at += height + BETWEEN_PX
        placed, y = list[_Box](), top
        for element in (one, *self._around(one)):
            placed.append(self._box(element, x, y))
            y += placed[-1].height + BENEATH_PX
        self.boxes += placed
        for above, beneath in pairwise(placed):
            middle = x + self._width / 2
            self.lines.append(_line(middle, above.y + above.height, middle, beneath.y, dashed=True))
        self.lines += [_elbow(placed[0], box) for box in boxes]
        return max(y - BENEATH_PX, at - BETWEEN_PX) - top, placed[0]

    def _around(self, one: Element) -> Iterator[Element]:
        """What it stands in, one for each kind."""
        named = [self._by_name[name] for name in one.in_context_of if name in self._by_name]
        for kind in dict.fromkeys(element.kind for element in named):
            first, *others = (element for element in named if element.kind == kind)
            words = "; ".join(element.text for element in (first, *others))
            last = f" to {others[-1].name}" if others else ""
            yield Element(f"{first.name}{last}", words)

    def _box(self, one: Element, x: float, y: float) -> _Box:
        room = int((self._width - 2 * MARGIN_PX - 6) / CHARACTER_PX)
        lines = textwrap.wrap(printable_line(one.text), room)
        most = MOST_LINES[one.kind]
        if len(lines) > most:
            last = lines[most - 1][: room - 2].rpartition(" ")[0]
            lines = [*lines[: most - 1], f"{last} \N{HORIZONTAL ELLIPSIS}"]
        return _Box(one, tuple(lines), x, y, self._width)


def _line(x0: float, y0: float, x1: float, y1: float, *, dashed: bool) -> str:
    dash = " stroke-dasharray='2 2'" if dashed else ""
    return f"<path d='M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}' stroke='{FAINT}' fill='none'{dash}/>"


def _elbow(left: _Box, right: _Box) -> str:
    """From the right edge of an element to the left one of what supports it, with an arrow."""
    x0, y0 = left.x + left.width, left.y + left.height / 2
    x1, y1 = right.x, right.y + right.height / 2
    middle = x0 + GAP_PX / 2
    return (
        f"<path d='M{x0:.1f} {y0:.1f}H{middle:.1f}V{y1:.1f}H{x1:.1f}' stroke='{FAINT}' "
        f"fill='none'/>"
        f"<path d='M{x1:.1f} {y1:.1f}l-6 -3v6z' fill='{FAINT}'/>"
    )


def _shape(box: _Box) -> str:
    one = box.element
    color = VERMILLION if one.undeveloped else COLORS[one.kind]
    fill = f"fill='#ffffff' stroke='{color}' stroke-width='1.3'"
    x, y, width, height = box.x, box.y, box.width - 1, box.height
    if one.kind == "Strategy":
        shape = (
            f"<path d='M{x + 6:.1f} {y:.1f}H{x + width:.1f}L{x + width - 6:.1f} {y + height:.1f}"
            f"H{x:.1f}Z' {fill}/>"
        )
    else:
        round_px = {"Goal": 0.0, "Solution": 14.0, "Context": 7.0}.get(one.kind, 14.0)
        dash = " stroke-dasharray='4 2'" if one.kind in ("Assumption", "Justification") else ""
        shape = (
            f"<rect x='{x:.1f}' y='{y:.1f}' width='{width:.1f}' height='{height:.1f}' "
            f"rx='{round_px:g}' {fill}{dash}/>"
        )
    sign = ""
    if one.undeveloped:
        shape += (
            f"<path d='M{x + width - 15:.1f} {y + 9:.1f}l6 -6l6 6l-6 6z' fill='#ffffff' "
            f"stroke='{color}' stroke-width='1.3'/>"
        )
        room = width - MARGIN_PX - 18 - BOLD_PX * len(one.name)
        sign = " (undeveloped)" if BOLD_PX * len(" (undeveloped)") < room else ""
    left = x + MARGIN_PX + 3
    words = [text(f"{one.name}{sign}", left, y + 12, color=color, size=TEXT_PX, weight="600")]
    words += [
        text(line, left, y + 12 + LINE_PX * place, color=INK, size=TEXT_PX)
        for place, line in enumerate(box.lines, start=1)
    ]
    return f"<g><title>{escape(printable_line(one.text))}</title>{shape}{''.join(words)}</g>"
