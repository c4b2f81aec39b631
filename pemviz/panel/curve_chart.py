"""Lines over one axis, in a chart whose values are read off with the pointer (uPlot in viser)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from viser import uplot

from pemviz.arrays import FloatArray
from pemviz.colors import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from pemviz.panel.browser import Browser
from pemviz.types import Signal

RUN_COLORS = (VERMILLION, BLUE, GREEN, PURPLE, ORANGE, SKY)
RUN_DASHES = ((), (6, 3), (2, 3), (9, 3, 2, 3), (12, 4), (4, 4))
"""Of runs side by side, in their order: as many as can be told apart."""


@dataclass(frozen=True, eq=False)
class Line:
    """One line.

    Attributes:
        name: In the legend.
        values: ``[X]``; NaN where there is none.
        color: ``#rrggbb``.
        width: In pixels.
        dash: Lengths drawn and left out, in pixels; empty: unbroken.
    """

    name: str
    values: FloatArray
    color: str
    width: float = 1.8
    dash: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Curves:
    """Lines over one axis.

    Attributes:
        title: What is shown.
        x: ``[X]`` ascending.
        x_label: With unit.
        y_label: With unit.
        lines: Each over ``x``.
        y_range: Ends of the vertical axis; ``None``: what the lines need.
    """

    title: str
    x: FloatArray
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    y_range: tuple[float, float] | None = None


def signal_name(signal: Signal) -> str:
    """A signal in words."""
    return signal.name.replace("_", " ")


def in_brackets(unit: str) -> str:
    """A unit behind words; nothing without one."""
    return f" [{unit}]" if unit else ""


def signal_label(signal: Signal) -> str:
    """A signal in words with its unit."""
    return signal_name(signal) + in_brackets(signal.unit)


def over_common(x: FloatArray, grids: Sequence[tuple[FloatArray, FloatArray]]) -> list[FloatArray]:
    """Lines ``(x, y)`` on a common axis; NaN beyond their ends and where they have none."""
    shown: list[FloatArray] = []
    for own_x, y in grids:
        known = np.isfinite(y)
        if not np.any(known):
            shown.append(np.full(x.size, np.nan))
            continue
        shown.append(np.interp(x, own_x[known], y[known], left=np.nan, right=np.nan))
    return shown


HEIGHT_PX = 250
PADDING_PX = (10, 14, 0, 0)
INK, GRID = "#1f2933", "#e4e7eb"
FONT = "11px system-ui, sans-serif"


class Chart:
    """A place in a tab where curves are shown; empty while there are none."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._place = browser.client.gui.add_folder(None)
        self._drawn: viser.GuiUplotHandle | None = None
        self._shown: Curves | None = None

    def show(self, curves: Curves | None) -> None:
        """Show other curves; what was enlarged stays so where the same lines get new values."""
        before, self._shown = self._shown, curves
        if curves is before:
            return
        if self._drawn is not None:
            if curves is not None and before is not None and _same_frame(before, curves):
                self._drawn.data = _data(curves)
                return
            self._drawn.remove()
            self._drawn = None
        if curves is not None:
            with self._place:
                self._drawn = _draw(self._browser.client.gui, curves)


def _same_frame(first: Curves, second: Curves) -> bool:
    """Whether two charts differ in their values alone."""
    return _frame(first) == _frame(second)


def _frame(curves: Curves) -> tuple[object, ...]:
    lines = tuple((line.name, line.color, line.width, line.dash) for line in curves.lines)
    return (curves.title, curves.x_label, curves.y_label, curves.y_range, lines)


def _data(curves: Curves) -> tuple[FloatArray, ...]:
    return (curves.x, *(np.asarray(line.values, dtype=np.float64) for line in curves.lines))


def _draw(gui: viser.GuiApi, curves: Curves) -> viser.GuiUplotHandle:
    scales: dict[str, uplot.Scale] = {"x": {"time": False}}
    if curves.y_range is not None:
        scales["y"] = {"range": curves.y_range}
    return gui.add_uplot(
        data=_data(curves),
        series=(uplot.Series(label=curves.x_label), *map(_series, curves.lines)),
        title=curves.title,
        scales=scales,
        axes=(_axis(curves.x_label, size=34), _axis(curves.y_label, size=44)),
        height=HEIGHT_PX,
        padding=PADDING_PX,
    )


def _series(line: Line) -> uplot.Series:
    return uplot.Series(
        label=line.name, stroke=line.color, width=line.width, dash=line.dash, points={"show": False}
    )


def _axis(label: str, *, size: int) -> uplot.Axis:
    lines: uplot.Axis_Grid = {"stroke": GRID, "width": 1}
    return uplot.Axis(
        label=label, labelFont=FONT, font=FONT, labelSize=18, labelGap=2, size=size, stroke=INK,
        grid=lines, ticks={"stroke": GRID, "width": 1, "size": 4},
    )  # fmt: skip
