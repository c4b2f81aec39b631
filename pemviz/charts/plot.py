"""Plots as SVG text, piece by piece: axes with units, lines, marks, bars, legends."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from pemviz.arrays import FloatArray

INK = "#1f2933"
FAINT = "#5f6b7a"
GRID = "#e4e7eb"
FONT = "font-family='system-ui, sans-serif'"


@dataclass(frozen=True)
class Axis:
    """An axis.

    Attributes:
        low: Value at its start.
        high: Value at its end.
        label: With unit.
        log10: Values are decimal logarithms; ticks are labelled as powers of ten.
        ticks: Where ticks are; chosen if ``None``.
    """

    low: float
    high: float
    label: str
    log10: bool = False
    ticks: tuple[float, ...] | None = None

    def tick_values(self, *, count: int) -> list[float]:
        """Tick positions, about ``count`` of them."""
        if self.ticks is not None:
            return list(self.ticks)
        return nice_ticks(self.low, self.high, count=count, whole=self.log10)

    def tick_text(self, value: float) -> str:
        """A tick's label, as SVG text."""
        if not self.log10:
            return f"{value:g}".replace("-", "\N{MINUS SIGN}")
        return power(value)


def power(exponent: float) -> str:
    """A power of ten, as SVG text."""
    words = f"{exponent:g}".replace("-", "\N{MINUS SIGN}")
    return f"10<tspan dy='-4' font-size='8'>{words}</tspan>"


def nice_ticks(low: float, high: float, *, count: int, whole: bool = False) -> list[float]:
    """Round tick positions in ``[low, high]``."""
    span = high - low
    if not span > 0.0 or not math.isfinite(span):
        return [low]
    raw = span / max(count, 1)
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= raw * 0.999)
    if whole:
        step = max(1.0, round(step))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [0.0 if index == 0 else index * step for index in range(first, last + 1)]


class Plot:
    """A plot under construction; ``text`` gives the SVG."""

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
        share = (value - self.x.low) / (self.x.high - self.x.low)
        return self.left + share * (self.right - self.left)

    def py(self, value: float) -> float:
        """Vertical pixel of a value."""
        share = (value - self.y.low) / (self.y.high - self.y.low)
        return self.bottom - share * (self.bottom - self.top)

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
        for px, py in zip(self._xs(x), self._ys(y), strict=True):
            if not (math.isfinite(px) and math.isfinite(py)):
                pen_up = True
                continue
            pieces.append(f"{'M' if pen_up else 'L'}{px:.1f} {py:.1f}")
            pen_up = False
        self._clipped(
            f"<path d='{''.join(pieces)}' fill='none' stroke='{color}' stroke-width='{width}'"
            f" stroke-opacity='{opacity:.2f}' stroke-linejoin='round'{_dash(dash)}>"
            f"{_tip(tip)}</path>"
        )

    def steps(self, x: FloatArray, y: FloatArray, **style: str | float) -> None:
        """A step line: value ``y[i]`` holds from ``x[i]`` to ``x[i+1]``."""
        self.line(np.repeat(x, 2)[1:-1], np.repeat(y, 2)[: 2 * x.size - 2], **style)  # pyright: ignore[reportArgumentType]

    def points(
        self,
        x: Sequence[float],
        y: Sequence[float],
        *,
        color: str,
        radius: float = 3.0,
        tips: Sequence[str] = (),
        cross: bool = False,
    ) -> None:
        """Discs, or crosses."""
        for place, (vx, vy) in enumerate(zip(x, y, strict=True)):
            px, py = self.px(vx), self.py(min(max(vy, self.y.low), self.y.high))
            tip = _tip(tips[place]) if tips else ""
            if cross:
                r = radius
                shape = (
                    f"<path d='M{px - r:.1f} {py - r:.1f}l{2 * r} {2 * r}"
                    f"m0 {-2 * r}l{-2 * r} {2 * r}' stroke='{color}' stroke-width='1.6'"
                    f" fill='none'>{tip}</path>"
                )
            else:
                place_and_size = f"cx='{px:.1f}' cy='{py:.1f}' r='{radius}'"
                shape = f"<circle {place_and_size} fill='{color}'>{tip}</circle>"
            self._parts.append(shape)

    def ticks_at(self, x: FloatArray, *, y_px: tuple[float, float], color: str) -> None:
        """Short vertical strokes at values ``[N]``, between two pixel rows."""
        path = "".join(f"M{px:.1f} {y_px[0]}V{y_px[1]}" for px in self._xs(x))
        self._parts.append(f"<path d='{path}' stroke='{color}' stroke-width='2'/>")

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
        self._parts.append(
            f"<path d='M{self.left} {py:.1f}H{self.right}' stroke='{color}'{_dash(dash)}/>"
        )
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
        self._parts.append(
            f"<path d='M{px:.1f} {self.top}V{self.bottom}' stroke='{color}'{_dash(dash)}/>"
        )
        if label:
            room = self.right - px > 6.0 * len(label)
            at, anchor = (px + 4, "start") if room else (px - 4, "end")
            up = self.bottom - 5 - 12 * above
            self._over.append(text(label, at, up, anchor=anchor, color=color))

    def band(self, low: float, high: float, *, color: str, opacity: float = 0.18) -> None:
        """A horizontal band."""
        top, bottom = self.py(min(high, self.y.high)), self.py(max(low, self.y.low))
        self._parts.append(
            f"<rect x='{self.left}' width='{self.right - self.left}' y='{top:.1f}'"
            f" height='{max(bottom - top, 1):.1f}' fill='{color}' fill-opacity='{opacity}'/>"
        )

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
            self._over.append(
                text(label, px + (4 if room else -4), self.bottom - 5,
                     anchor="start" if room else "end", color=INK)
            )  # fmt: skip

    def bars(
        self,
        edges: FloatArray,
        heights: FloatArray,
        *,
        color: str,
        opacity: float = 0.85,
        tips: Sequence[str] = (),
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
                f" fill-opacity='{opacity}'>{_tip(tips[place]) if tips else ''}</rect>"
            )

    def legend(self, entries: Sequence[tuple[str, str, str]], *, x: float, y: float) -> None:
        """Lines of (label, colour, dash), from pixel (x, y) downwards."""
        for place, (label, color, dash) in enumerate(entries):
            row = y + 13 * place
            self._over.append(
                f"<path d='M{x} {row - 3.5}h16' stroke='{color}' stroke-width='2'{_dash(dash)}/>"
            )
            self._over.append(text(label, x + 20, row, color=INK))

    def note(self, words: str, x: float, y: float, *, anchor: str = "start") -> None:
        """Words at a pixel position."""
        self._over.append(text(words, x, y, anchor=anchor, color=FAINT))

    def group(self, *, dx: float = 0.0, dy: float = 0.0) -> str:
        """The plot as an SVG group, moved."""
        clip = f"c{self.left}-{self.right}-{self.top}-{self.bottom}"
        body = "".join(self._parts).replace("url(#clip)", f"url(#{clip})")
        return (
            f"<g transform='translate({dx} {dy})'><clipPath id='{clip}'><rect x='{self.left}'"
            f" y='{self.top}' width='{self.right - self.left}' height='{self.bottom - self.top}'/>"
            f"</clipPath>{self._frame()}{body}{''.join(self._over)}</g>"
        )

    def text(self, *, extra: str = "") -> str:
        """The plot as one SVG document, with more SVG over it."""
        body = self.group() + extra
        return svg(body, width=self.width, height=self.height, title=self._title)

    def _frame(self) -> str:
        parts = [
            text(self._title, self._title_at, self.top - 9, color=INK, weight="600", size=11.5),
            f"<path d='M{self.left} {self.bottom}H{self.right}' stroke='{FAINT}'/>",
        ]
        for value in self.y.tick_values(count=max(3, (self.bottom - self.top) // 30)):
            py = self.py(value)
            parts.append(f"<path d='M{self.left} {py:.1f}H{self.right}' stroke='{GRID}'/>")
            parts.append(
                text(self.y.tick_text(value), self.left - 5, py + 3.5, anchor="end", raw=True)
            )
        for value in self.x.tick_values(count=max(2, (self.right - self.left) // 55)):
            px = self.px(value)
            parts.append(f"<path d='M{px:.1f} {self.bottom}v3' stroke='{FAINT}'/>")
            label = self.x.tick_text(value)
            parts.append(text(label, px, self.bottom + 13, anchor="middle", raw=True))
        middle = (self.left + self.right) / 2
        parts.append(text(self.x.label, middle, self.bottom + 26, anchor="middle"))
        parts.append(
            f"<g transform='translate(11 {(self.top + self.bottom) / 2:.1f}) rotate(-90)'>"
            f"{text(self.y.label, 0, 0, anchor='middle')}</g>"
        )
        return "".join(parts)

    def _clipped(self, shape: str) -> None:
        self._parts.append(f"<g clip-path='url(#clip)'>{shape}</g>")

    def _xs(self, values: FloatArray) -> list[float]:
        share = (np.asarray(values, dtype=np.float64) - self.x.low) / (self.x.high - self.x.low)
        return (self.left + share * (self.right - self.left)).tolist()

    def _ys(self, values: FloatArray) -> list[float]:
        share = (np.asarray(values, dtype=np.float64) - self.y.low) / (self.y.high - self.y.low)
        limited = np.clip(share, -10.0, 10.0)
        return (self.bottom - limited * (self.bottom - self.top)).tolist()


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


def svg(body: str, *, width: int, height: int, title: str) -> str:
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
