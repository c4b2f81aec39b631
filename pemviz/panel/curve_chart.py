"""Lines over one axis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.charts.svg import Axis, Plot
from pemviz.panel.run_data import RunData
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.types import Signal

RUN_DASHES = ((), (6, 3), (2, 3), (9, 3, 2, 3), (12, 4), (4, 4))
"""Of runs side by side, beside their colours: as many as can be told apart."""
LEGEND_ROW_PX = 13


@dataclass(frozen=True, eq=False)
class Line:
    """One line ``[X]``, NaN where there is none; lengths drawn and left out in pixels."""

    name: str
    values: FloatArray
    color: str
    width: float = 1.8
    dash: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Curves:
    """Lines over one ascending axis ``[X]``; without ``y_range`` as high as they need."""

    title: str
    x: FloatArray
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    y_range: tuple[float, float] | None = None


def signal_name(signal: Signal) -> str:
    """A signal in words."""
    return signal.name.replace("_", " ")


def signal_label(signal: Signal) -> str:
    """A signal in words with its unit."""
    return signal_name(signal) + (f" [{signal.unit}]" if signal.unit else "")


def over_common(x: FloatArray, own_x: FloatArray, y: FloatArray) -> FloatArray:
    """A line ``(own_x, y)`` on a common axis; NaN beyond its ends and where it has no value."""
    known = np.isfinite(y)
    if not np.any(known):
        return np.full(x.size, np.nan)
    return np.interp(x, own_x[known], y[known], left=np.nan, right=np.nan)


def over_time(run: RunData, title: str, lines: Sequence[Line], *, touch_color: str) -> Curves:
    """The charted signal of rollouts against time, and where bumpers touch, if that is told."""
    touch: list[Line] = []
    if run.own is None:
        values = np.full(run.time_s.size, CAMERA_TO_BUMPER_M)
        touch = [Line("bumpers touch [m]", values, touch_color, width=1.0)]
    return Curves(title, run.time_s, "time [s]", signal_label(run.charted), (*lines, *touch))


def curves_svg(curves: Curves, *, width: int = 420, height: int = 240) -> str:
    """Curves as a picture, with a legend beneath."""
    finite = [line.values[np.isfinite(line.values)] for line in curves.lines]
    known = np.concatenate([*finite, np.zeros(1)]) if curves.y_range is None else np.zeros(1)
    low, high = curves.y_range or (float(known.min()), float(known.max()))
    room = 0.06 * (high - low) or 1.0
    rows = len(curves.lines)
    plot = Plot(
        title=curves.title,
        x=Axis(float(curves.x[0]), float(curves.x[-1]), curves.x_label),
        y=Axis(low, high + room, curves.y_label),
        width=width,
        height=height + LEGEND_ROW_PX * rows,
        bottom=LEGEND_ROW_PX * rows + 40,
    )
    entries: list[tuple[str, str, str]] = []
    for line in curves.lines:
        dash = " ".join(f"{length:g}" for length in line.dash)
        plot.line(curves.x, line.values, color=line.color, width=line.width, dash=dash)
        entries.append((line.name, line.color, dash))
    plot.legend(entries, x=plot.left, y=plot.bottom + 44)
    return plot.text()
