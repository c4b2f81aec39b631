"""The failure probability over memory times and frailties: what independence is worth."""

import math
from dataclasses import dataclass

import numpy as np

from pemviz.colors import PEM, PROPOSAL
from pemviz.reports.memory_curve import (
    BY_FRAILTY,
    BY_MEMORY_TIME,
    CurveAxis,
    assumption_line,
    frailty_line,
    measured_names,
)
from pemviz.reports.pictures.html import quiet, warning
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.runs.memory import RunMemory

WIDTH, HEIGHT = 400, 170
NOTE_PX = 230.0
"""Room that a measured place's full name takes."""


@dataclass(frozen=True)
class _Look:
    """What a curve's plot says and how its axis is marked."""

    title: str
    x_label: str
    ticks: tuple[float, ...]


TAU = _Look(
    "P(violation) if misses come in bursts", "memory time [s]", (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
)
FRAILTY = _Look(
    "P(violation) if some obstacles are harder to see",
    "frailty",
    (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2),
)


def memory_curve(memory: RunMemory | None) -> str:
    """What the assumptions are worth, in words and as plots; empty without a curve."""
    return "".join(memory_curves(memory))


def memory_curves(memory: RunMemory | None) -> tuple[str, str]:
    """What the assumptions on bursts and on how obstacles differ are worth; each empty without."""
    bursts, obstacles = assumption_line(memory), frailty_line(memory)
    return (
        "" if memory is None or bursts is None else _told(memory, bursts, BY_MEMORY_TIME, TAU),
        ""
        if memory is None or obstacles is None
        else _told(memory, obstacles, BY_FRAILTY, FRAILTY),
    )


def _told(memory: RunMemory, line: str, axis: CurveAxis, look: _Look) -> str:
    return warning(line) + _plot(memory, axis, look) + quiet(axis.note)


def _plot(memory: RunMemory, axis: CurveAxis, look: _Look) -> str:
    points = [p for p in axis.points(memory) if p.low and p.high and p.probability]
    if not points:
        return ""
    level = "" if any(point.caveats for point in points) else "95 % "
    places = np.array([axis.place(point) for point in points])
    low = min(math.log10(point.low or 1.0) for point in points)
    plot = Plot(
        x=Axis(
            0.0, 1.02 * max(places), f"{look.x_label}; whiskers: {level}intervals", ticks=look.ticks
        ),
        y=Axis(low - 0.5, 0.2, "", log10=True),
        width=WIDTH,
        height=HEIGHT,
        title=look.title,
    )
    log10 = np.log10([point.probability for point in points])
    plot.line(places, log10, color=PROPOSAL, width=2.0, tip="failure probability")
    for place, point in zip(places, points, strict=True):
        ends = math.log10(point.low or 1.0), math.log10(point.high or 1.0)
        plot.whisker(place, *ends, color=PROPOSAL)
    _mark_measured(plot, measured_names(memory, axis), unit=axis.unit)
    return plot.text()


def _mark_measured(plot: Plot, names: dict[float, str], *, unit: str) -> None:
    """Whose places on the axis were measured: in full where there is room right of them."""
    last = plot.px(max(names))
    roomy = plot.right - last > NOTE_PX
    for number, (place, name) in enumerate(sorted(names.items())):
        plot.ticks_at(np.array([place]), y_px=(plot.top, plot.bottom), color=PEM)
        words = f"{place:.2g}{unit}: {name if roomy else name.split(',')[0]}, on video"
        y = plot.bottom - 8.0 - 12.0 * number
        if roomy:
            plot.note(words, last + 4.0, y)
        else:
            plot.note(words, plot.px(min(names)) - 4.0, y, anchor="end")
