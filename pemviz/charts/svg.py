"""Charts as SVG within pages: readable at any width, with what pointers and clicks need.

Drawn by hand and not by matplotlib: the panel redraws charts while a person waits and adds a
cursor at every step that is played; a chart here takes 1 ms. :func:`svg` draws a chart, with a
:class:`Plot` piece by piece.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from itertools import pairwise

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.charts import chart as marks
from pemviz.charts.chart import (
    Axis,
    Chart,
    IntervalChart,
    PlaneChart,
    axis_decades,
    decade,
    nice_ticks,
)

INK = "#1f2933"
FAINT = "#5f6b7a"
GRID = "#e4e7eb"
FONT = "font-family='system-ui, sans-serif'"
INTERVAL_PX, ROW_PX, TOP_PX, BOTTOM_PX, EDGE_PX = 360, 26, 18, 32, 4
LEGEND_ROW_PX, LEVELS_PX = 14, 128
CHARACTER_PX = 5.4
"""How wide a character of a legend is, on average."""

WORDS_EDGE_PX = 12
"""Left of the words at an axis' ticks."""

Entry = tuple[str, str, str]
"""Of a legend: label, colour, and how its line is dashed or which of these signs it has."""
DISC, CROSS, STROKE = "disc", "cross", "stroke"


def svg(chart: Chart, *, act: str = "") -> str:
    """A chart as one SVG element.

    Args:
        chart: What to draw.
        act: Attributes of what holds points with a ``data-number`` each, for clicks on them.
    """
    return _intervals(chart) if isinstance(chart, IntervalChart) else _plane(chart, act=act)


class Plot:
    """A plot under construction; ``text`` gives the SVG.

    Values, and the ends of axes, are decimal logarithms where an axis says ``log10``.
    """

    def __init__(
        self,
        *,
        x: Axis,
        y: Axis,
        width: int = 400,
        height: int = 180,
        title: str = "",
        left: int = 46,
        right: int = 10,
        top: int = 24,
        bottom: int = 34,
        title_at: int | None = None,
    ) -> None:
        self.x, self.y = x, y
        self.width, self.height = width, height
        self.left, self.right = left, width - right
        self.top, self.bottom = top, height - bottom
        self._title = title
        self._title_at = left if title_at is None else title_at
        self._parts: list[str] = []
        self._over: list[str] = []

    def px(self, value: float) -> float:
        """Horizontal pixel of a value."""
        return self.left + self.x.share(value) * (self.right - self.left)

    def py(self, value: float) -> float:
        """Vertical pixel of a value."""
        return self.bottom - self.y.share(value) * (self.bottom - self.top)

    def line(
        self,
        x: FloatArray,
        y: FloatArray,
        *,
        color: str,
        width: float = 1.6,
        opacity: float = 1.0,
        dash: str = "",
        tip: str = "",
    ) -> None:
        """A line through points ``[N]``; NaN breaks it."""
        pieces: list[str] = []
        pen_up = True
        # limited, so that what is infinitely far up or down has a place too
        shares = np.clip(self.y.share(np.asarray(y, dtype=np.float64)), -10.0, 10.0)
        ys = (self.bottom - shares * (self.bottom - self.top)).tolist()
        for px, py in zip(self._xs(x), ys, strict=True):
            if not (math.isfinite(px) and math.isfinite(py)):
                pen_up = True
                continue
            pieces.append(f"{'M' if pen_up else 'L'}{px:.1f} {py:.1f}")
            pen_up = False
        self._parts.append(
            f"<g clip-path='url(#clip)'><path d='{''.join(pieces)}' fill='none' stroke='{color}'"
            f" stroke-width='{width}' stroke-opacity='{opacity:.2f}' stroke-linejoin='round'"
            f"{_dash(dash)}>{_tip(tip)}</path></g>"
        )

    def strokes(self, x: FloatArray, low: FloatArray, high: FloatArray, *, color: str) -> None:
        """Short vertical strokes at ``[N]`` places, between values of y."""
        ends = zip(self._xs(x), low.tolist(), high.tolist(), strict=True)
        path = "".join(f"M{px:.1f} {self.py(a):.1f}V{self.py(b):.1f}" for px, a, b in ends)
        self._parts.append(f"<path d='{path}' stroke='{color}' stroke-width='2'/>")

    def band(self, low: float, high: float, *, color: str, dash: str = "") -> None:
        """A horizontal range: both ends and a shade between them."""
        top, bottom = self.py(min(high, self.y.high)), self.py(max(low, self.y.low))
        self._parts.append(
            f"<rect x='{self.left}' width='{self.right - self.left}' y='{top:.1f}'"
            f" height='{max(bottom - top, 1.0):.1f}' fill='{color}' fill-opacity='0.13'/>"
            f"<path d='M{self.left} {top:.1f}H{self.right}M{self.left} {bottom:.1f}H{self.right}'"
            f" stroke='{color}' stroke-opacity='0.7' fill='none'{_dash(dash)}/>"
        )

    def whisker(self, x: float, low: float, high: float, *, color: str, dash: str = "") -> None:
        """A vertical interval."""
        px, top, bottom = self.px(x), self.py(min(high, self.y.high)), self.py(max(low, self.y.low))
        self._parts.append(
            f"<path d='M{px:.1f} {top:.1f}V{bottom:.1f}M{px - 4:.1f} {top:.1f}h8"
            f"M{px - 4:.1f} {bottom:.1f}h8' stroke='{color}' stroke-width='1.6' fill='none'"
            f"{_dash(dash)}/>"
        )

    def hline(
        self, y: float, *, color: str, label: str = "", dash: str = "4 3", at_left: bool = False
    ) -> None:
        """A horizontal line, labelled at its right end, or at its left."""
        if not self.y.low <= y <= self.y.high:
            return
        py = self.py(y)
        line = f"<path d='M{self.left} {py:.1f}H{self.right}' stroke='{color}'{_dash(dash)}/>"
        self._parts.append(line)
        if label:
            x, anchor = (self.left + 3, "start") if at_left else (self.right - 3, "end")
            self._over.append(text(label, x, py - 3, anchor=anchor, color=color))

    def vline(
        self, x: float, *, color: str, label: str = "", dash: str = "4 3", above: int = 0
    ) -> None:
        """A vertical line, labelled at its lower end, ``above`` so many other labels."""
        if not self.x.low <= x <= self.x.high:
            return
        px = self.px(x)
        line = f"<path d='M{px:.1f} {self.top}V{self.bottom}' stroke='{color}'{_dash(dash)}/>"
        self._parts.append(line)
        if label:
            room = self.right - px > 6.0 * len(label)
            at, anchor = (px + 4, "start") if room else (px - 4, "end")
            up = self.bottom - 5 - 12 * above
            self._over.append(text(label, at, up, anchor=anchor, color=color))

    def veil(self, x: float, *, label: str = "") -> None:
        """What lies beyond a value of x, made faint; the value is marked, and labelled below."""
        px = min(max(self.px(x), self.left), self.right)
        self._parts.append(
            f"<rect x='{px:.1f}' width='{self.right - px:.1f}' y='{self.top}'"
            f" height='{self.bottom - self.top}' fill='#ffffff' fill-opacity='0.72'/>"
        )
        self._over.append(
            f"<path d='M{px:.1f} {self.top}V{self.bottom}' stroke='{INK}' stroke-dasharray='2 2'/>"
        )
        if label:
            room = self.right - px > 7.0 * len(label) / 1.2
            at, anchor = (px + 4, "start") if room else (px - 4, "end")
            self._over.append(text(label, at, self.bottom - 5, anchor=anchor, color=INK))

    def bars(
        self, edges: FloatArray, heights: FloatArray, *, color: str, tips: Sequence[str] = ()
    ) -> None:
        """Bars between edges ``[N+1]`` up to heights ``[N]``; NaN leaves one out."""
        for place, height in enumerate(heights.tolist()):
            if not math.isfinite(height):
                continue
            left, right = self.px(float(edges[place])), self.px(float(edges[place + 1]))
            top = self.py(min(height, self.y.high))
            self._parts.append(
                f"<rect x='{left + 0.5:.1f}' width='{max(right - left - 1, 0.5):.1f}' y='{top:.1f}'"
                f" height='{max(self.bottom - top, 0):.1f}' fill='{color}'"
                f" fill-opacity='0.85'>{_tip(tips[place]) if tips else ''}</rect>"
            )

    def legend(self, entries: Sequence[Entry], *, x: float, y: float) -> None:
        """Entries beside each other, from pixel (x, y) on."""
        for label, color, kind in entries:
            sign = {
                DISC: f"<circle cx='{x + 8}' cy='{y - 3.5}' r='3' fill='{color}'/>",
                CROSS: _cross(x + 8, y - 3.5, 3.4, color=color),
                STROKE: f"<path d='M{x + 8} {y - 9}v9' stroke='{color}' stroke-width='2'/>",
            }.get(kind)
            line = f"<path d='M{x} {y - 3.5}h16' stroke='{color}' stroke-width='2'{_dash(kind)}/>"
            self._over += [sign or line, text(label, x + 20, y, color=INK)]
            x += _entry_px((label, color, kind))

    def group(self) -> str:
        """The plot as an SVG group."""
        clip = f"c{self.left}-{self.right}-{self.top}-{self.bottom}"
        body = "".join(self._parts).replace("url(#clip)", f"url(#{clip})")
        return (
            f"<g transform='translate(0.0 0.0)'><clipPath id='{clip}'><rect x='{self.left}'"
            f" y='{self.top}' width='{self.right - self.left}' height='{self.bottom - self.top}'/>"
            f"</clipPath>{self._frame()}{body}{''.join(self._over)}</g>"
        )

    def text(self, *, extra: str = "") -> str:
        """The plot as one SVG document, with more SVG over it."""
        body = self.group() + extra
        return svg_element(body, width=self.width, height=self.height, title=self._title)

    def _frame(self) -> str:
        parts = [
            text(self._title, self._title_at, self.top - 9, color=INK, weight="600", size=11.5),
            f"<path d='M{self.left} {self.bottom}H{self.right}' stroke='{FAINT}'/>",
        ]
        for value, words in _ticks(self.y, count=max(3, (self.bottom - self.top) // 19)):
            py = self.py(value)
            parts.append(f"<path d='M{self.left} {py:.1f}H{self.right}' stroke='{GRID}'/>")
            parts.append(text(words, self.left - 5, py + 3.5, anchor="end", raw=True))
        for value, words in _ticks(self.x, count=max(2, (self.right - self.left) // 55)):
            px = self.px(value)
            parts.append(f"<path d='M{px:.1f} {self.bottom}v3' stroke='{FAINT}'/>")
            parts.append(text(words, px, self.bottom + 13, anchor="middle", raw=True))
        middle = (self.left + self.right) / 2
        parts.append(text(self.x.label, middle, self.bottom + 26, anchor="middle"))
        up, most = self.y.label, int(self.height / CHARACTER_PX)
        up = up if len(up) <= most else f"{up[: most - 1]}\N{HORIZONTAL ELLIPSIS}"
        parts.append(
            f"<g transform='translate(11 {(self.top + self.bottom) / 2:.1f}) rotate(-90)'>"
            f"{text(up, 0, 0, anchor='middle')}</g>"
        )
        return "".join(parts)

    def _xs(self, values: FloatArray) -> list[float]:
        share = self.x.share(np.asarray(values, dtype=np.float64))
        return (self.left + share * (self.right - self.left)).tolist()


def _ticks(axis: Axis, *, count: int) -> list[tuple[float, str]]:
    """Values of about ``count`` ticks, with their labels as SVG text."""
    values = axis.ticks
    if values is None:
        values = nice_ticks(axis.low, axis.high, count=count, whole=axis.log10)
    if axis.words:
        return [(value, escape(words)) for value, words in zip(values, axis.words, strict=True)]
    return [(value, _power(value) if axis.log10 else _signed(value)) for value in values]


def _signed(value: float) -> str:
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")


def _power(exponent: float) -> str:
    return f"10<tspan dy='-4' font-size='8'>{_signed(exponent)}</tspan>"


def text(
    words: str,
    x: float,
    y: float,
    *,
    anchor: str = "start",
    color: str = FAINT,
    size: float = 10.5,
    weight: str = "400",
    raw: bool = False,
) -> str:
    """A piece of text; ``raw`` text is SVG already."""
    return (
        f"<text x='{x:.1f}' y='{y:.1f}' text-anchor='{anchor}' fill='{color}' font-size='{size}'"
        f" font-weight='{weight}'>{words if raw else escape(words)}</text>"
    )


def svg_element(body: str, *, width: int, height: int, title: str) -> str:
    """An SVG document that fills the width it is given."""
    return (
        f"<svg viewBox='0 0 {width} {height}' width='100%' role='img'"
        f" aria-label='{escape(title, quote=True)}' xmlns='http://www.w3.org/2000/svg' {FONT}"
        f" style='display:block;max-width:{1.3 * width:.0f}px'>{body}</svg>"
    )


def _dash(dash: str) -> str:
    return f" stroke-dasharray='{dash}'" if dash else ""


def _tip(words: str) -> str:
    return f"<title>{escape(words)}</title>" if words else ""


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
    for tick in nice_ticks(low, high, count=5, whole=True):
        x = px(10.0**tick)
        anchor = "start" if x < 3 * EDGE_PX else "end" if x > right - 3 * EDGE_PX else "middle"
        parts.append(f"<path d='M{x:.1f} {TOP_PX}V{bottom}' stroke='{GRID}'/>")
        parts.append(text(_power(tick), x, bottom + 12, anchor=anchor, size=9, raw=True))
    parts.append(text(chart.label, (EDGE_PX + right) / 2, height - 4, anchor="middle", size=9.5))
    for rule in chart.rules:
        line = f"<path d='M{px(rule.at):.1f} {TOP_PX}V{bottom}' stroke='{rule.color}'"
        parts.append(f"{line} stroke-dasharray='{rule.dash}'>{_tip(rule.label)}</path>")
    for place, row in enumerate(chart.rows):
        parts.append(_row(row, TOP_PX + ROW_PX * place, px, right))
    return svg_element("".join(parts), width=INTERVAL_PX, height=height, title=chart.title)


def _row(row: marks.Row, top: float, px: Callable[[float], float], right: float) -> str:
    middle = top + 19.0
    words = text(row.name, 0, top + 11, color=INK) + text(
        row.figures, right, top + 11, anchor="end"
    )
    parts = [f"<g stroke='#ffffff' stroke-width='3' style='paint-order:stroke'>{words}</g>"]
    if row.low is not None and row.high is not None:
        start, end = px(row.low), px(row.high)
        if row.holds:
            parts.append(
                f"<rect x='{start:.1f}' y='{middle - 3:.1f}' width='{max(end - start, 3.0):.1f}' "
                f"height='6' rx='2' fill='{row.color}' fill-opacity='0.8'/>"
            )
        else:
            line = f"<path d='M{start:.1f} {middle}H{max(end, start + 3.0):.1f}'"
            dotted = _dash(marks.DOTTED)
            parts.append(f"{line} stroke='{row.color}' stroke-width='4'{dotted}/>")
    elif not row.values:
        line = f"<path d='M{EDGE_PX} {middle}H{right}' stroke='{row.color}'"
        parts.append(f"{line} stroke-width='1.5' stroke-dasharray='2 4'/>")
    for value in row.values:
        spot = f"<circle cx='{px(value):.1f}' cy='{middle}' r='3.4' fill='{row.color}'"
        parts.append(f"{spot} stroke='#ffffff'/>")
    return f"<g>{_tip(row.tip or row.name)}{''.join(parts)}</g>"


def plot_of(chart: PlaneChart) -> Plot:
    """The plot of a chart with nothing on it yet: where its axes lie."""
    rows = _legend_rows(_entries(chart), chart.width - 60)
    shaded = any(isinstance(mark, marks.Cells) for mark in chart.marks)
    longest = max(map(len, chart.y.words), default=0)
    left = WORDS_EDGE_PX + round(CHARACTER_PX * longest) if longest else 52
    return Plot(
        title=chart.title,
        x=_in_places(chart.x),
        y=_in_places(chart.y),
        width=chart.width,
        height=chart.height + LEGEND_ROW_PX * len(rows),
        left=left,
        right=LEVELS_PX if shaded else 10,
        bottom=34 + LEGEND_ROW_PX * len(rows),
        title_at=EDGE_PX if longest else left,
    )


def _plane(chart: PlaneChart, *, act: str) -> str:
    drawn = plot_of(chart)
    over = "".join(_draw(drawn, chart, mark, act=act) for mark in chart.marks)
    for place, row in enumerate(_legend_rows(_entries(chart), chart.width - 60)):
        drawn.legend(row, x=42, y=drawn.bottom + 42 + LEGEND_ROW_PX * place)
    for mark in chart.marks:
        if isinstance(mark, marks.Cells):
            over += _levels(drawn, mark)
    return drawn.text(extra=over)


def _entries(chart: PlaneChart) -> list[Entry]:
    """What the legend names: marks that have a label and do not bear it themselves."""
    return [
        (mark.label, mark.color, _legend_kind(mark))
        for mark in chart.marks
        if not isinstance(mark, marks.Cells | marks.Veil) and mark.label
        if not isinstance(mark, marks.Rule) or mark.label_at == "legend"
    ]


def _in_places(axis: Axis) -> Axis:
    if not axis.log10:
        return axis
    ticks = None if axis.ticks is None else tuple(map(decade, axis.ticks))
    return replace(axis, low=decade(axis.low), high=decade(axis.high), ticks=ticks)


def _places(axis: Axis, values: FloatArray) -> FloatArray:
    return np.array([decade(v) for v in np.asarray(values).tolist()]) if axis.log10 else values


def _draw(drawn: Plot, chart: PlaneChart, mark: marks.Mark, *, act: str) -> str:  # noqa: PLR0912
    """Put a mark on the plot; what has to lie over it comes back."""
    x, y = chart.x, chart.y
    match mark:
        case marks.Line():
            drawn.line(
                _places(x, mark.x), _places(y, mark.y), color=mark.color, width=mark.width,
                dash=mark.dash, opacity=mark.opacity, tip=mark.tip,
            )  # fmt: skip
        case marks.Points():
            at, up = _places(x, mark.x), _places(y, mark.y)
            if mark.joined:
                drawn.line(at, up, color=mark.color)
            return _points(drawn, at, up, mark, act=act)
        case marks.Strokes():
            ends = mark.y - mark.below, mark.y + mark.above
            drawn.strokes(_places(x, mark.x), *ends, color=mark.color)
        case marks.Band():
            low, high = _places(y, np.array([mark.low, mark.high])).tolist()
            drawn.band(low, high, color=mark.color, dash="" if mark.holds else marks.DOTTED)
        case marks.Veil():
            drawn.veil(mark.at, label=mark.label)
        case marks.Whiskers():
            at, low, high = _places(x, mark.x), _places(y, mark.low), _places(y, mark.high)
            for place, holds in enumerate(mark.holds):
                dash = "" if holds else marks.DOTTED
                drawn.whisker(at[place], low[place], high[place], color=mark.color, dash=dash)
        case marks.Bars():
            drawn.bars(_places(x, mark.edges), mark.heights, color=mark.color, tips=mark.tips)
        case marks.Rule():
            axis = x if mark.upright else y
            at = decade(mark.at) if axis.log10 else mark.at
            if not mark.upright:
                label = "" if mark.label_at == "legend" else mark.label
                at_left = mark.label_at == "start"
                drawn.hline(at, color=mark.color, label=label, dash=mark.dash, at_left=at_left)
                return ""
            upright = [m for m in chart.marks if isinstance(m, marks.Rule) and m.upright]
            above = len(upright) - 1 - upright.index(mark)
            drawn.vline(at, color=mark.color, label=mark.label, dash=mark.dash, above=above)
        case marks.Cells():
            return _shades(drawn, mark)
        case marks.Box():
            left, right = drawn.px(mark.low_x), drawn.px(mark.high_x)
            bottom, top = drawn.py(mark.low_y), drawn.py(mark.high_y)
            return (
                f"<rect x='{left:.1f}' y='{top:.1f}' width='{right - left:.1f}' "
                f"height='{bottom - top:.1f}' fill='none' stroke='{mark.color}' "
                f"stroke-dasharray='{marks.DASHED}'/>"
            )
    return ""


def _points(drawn: Plot, x: FloatArray, y: FloatArray, mark: marks.Points, *, act: str) -> str:
    """Points over all else, with a wider ring that a pointer finds; none beyond the axes."""
    tips = mark.tips or ("",) * x.size
    numbers = mark.numbers or (None,) * x.size
    radii = np.broadcast_to(np.asarray(mark.radius, dtype=np.float64), x.shape).tolist()
    shapes: list[str] = []
    for at, up, radius, tip, number in zip(
        x.tolist(), y.tolist(), radii, tips, numbers, strict=True
    ):
        px, py = drawn.px(at), drawn.py(min(max(up, drawn.y.low), drawn.y.high))
        if not (math.isfinite(py) and drawn.left - 1 <= px <= drawn.right + 1):
            continue
        spot = (
            _cross(px, py, radius, color=mark.color)
            if mark.crosses
            else f"<circle cx='{px:.1f}' cy='{py:.1f}' r='{radius}' fill='{mark.color}'"
            " stroke='#ffffff' stroke-width='0.6'/>"
        )
        ring = f"<circle cx='{px:.1f}' cy='{py:.1f}' r='{radius + 3:g}' fill='transparent'/>"
        numbered = "" if number is None else f" data-number='{number}'"
        shapes.append(f"<g{numbered}>{_tip(tip)}{spot}{ring}</g>")
    clicks = f" {act} style='cursor:pointer'" if act and mark.numbers else ""
    return f"<g{clicks}>{''.join(shapes)}</g>"


def _cross(x: float, y: float, reach: float, *, color: str) -> str:
    """A diagonal cross around a pixel position."""
    across = f"l{2 * reach:.1f} {2 * reach:.1f}m0 {-2 * reach:.1f}l{-2 * reach:.1f} {2 * reach:.1f}"
    path = f"<path d='M{x - reach:.1f} {y - reach:.1f}{across}'"
    return f"{path} stroke='{color}' stroke-width='1.5' fill='none'/>"


def _shades(drawn: Plot, mark: marks.Cells) -> str:
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


def _shade(mark: marks.Cells, value: float) -> str:
    if not math.isfinite(value):
        return mark.unknown
    found = (level.color for level in mark.levels if value >= level.low)
    return next(found, mark.levels[-1].color)


def _levels(drawn: Plot, cells: marks.Cells) -> str:
    """A swatch a level beside the plot, the highest on top, and what is not known."""
    x, y = drawn.right + 10, drawn.top + 4
    parts = [text(cells.title, x, y + 4, color=INK, weight="600", size=10)]
    entries = [(level.words, level.color) for level in cells.levels]
    for place, (words, color) in enumerate([*entries, ("not known", cells.unknown)]):
        top = y + 13 + 17 * place
        swatch = f"<rect x='{x}' y='{top}' width='13' height='13' fill='{color}'"
        parts.append(f"{swatch} stroke='{FAINT}' stroke-width='0.5'/>")
        parts.append(text(words, x + 17, top + 10, size=9.5))
    return "".join(parts)


def _legend_kind(mark: marks.Mark) -> str:  # noqa: PLR0911  one a kind
    match mark:
        case marks.Line() | marks.Rule():
            return mark.dash
        case marks.Whiskers():
            return "" if all(mark.holds) else marks.DOTTED
        case marks.Band():
            return "" if mark.holds else marks.DOTTED
        case marks.Box():
            return marks.DASHED
        case marks.Points():
            return CROSS if mark.crosses else DISC
        case marks.Strokes():
            return STROKE
        case _:
            return ""


def _legend_rows(entries: list[Entry], room_px: float) -> list[list[Entry]]:
    """Entries in as few rows as they fit into."""
    rows: list[list[Entry]] = []
    left_px = 0.0
    for entry in entries:
        if not rows or left_px < _entry_px(entry):
            rows.append([])
            left_px = room_px
        rows[-1].append(entry)
        left_px -= _entry_px(entry)
    return rows


def _entry_px(entry: Entry) -> float:
    return 30.0 + CHARACTER_PX * len(entry[0])
