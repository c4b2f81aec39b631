"""A chart in which values are read off, and parts enlarged, with the pointer (uPlot in viser)."""

import numpy as np
import viser
from viser import uplot

from pemviz.arrays import FloatArray
from pemviz.panel.browser import Browser
from pemviz.panel.views.curves import Curves, Line

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
