"""The failure probability over memory times: what independence of misses is worth."""

import math

import numpy as np

from pemviz.colors import PEM, PROPOSAL
from pemviz.reports.memory_curve import CURVE_NOTE, assumption_line, measured_names
from pemviz.reports.pictures.html import quiet, warning
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.runs.memory import RunMemory

TICKS_S = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
WIDTH, HEIGHT = 400, 170


def memory_curve(memory: RunMemory | None) -> str:
    """What the assumption is worth, in words and as a plot; empty without a curve."""
    line = assumption_line(memory)
    if memory is None or line is None:
        return ""
    return warning(line) + _plot(memory) + quiet(CURVE_NOTE)


def _plot(memory: RunMemory) -> str:
    points = [point for point in memory.curve if point.low and point.high and point.probability]
    if not points:
        return ""
    level = "" if any(point.caveats for point in points) else "95 % "
    x_label = f"memory time [s]; whiskers: {level}intervals"
    low = min(math.log10(point.low or 1.0) for point in points)
    plot = Plot(
        x=Axis(0.0, 1.02 * max(p.tau_s for p in points), x_label, ticks=TICKS_S),
        y=Axis(low - 0.5, 0.2, "", log10=True),
        width=WIDTH,
        height=HEIGHT,
        title="P(violation) if misses come in bursts",
    )
    tau_s = np.array([point.tau_s for point in points])
    log10 = np.log10([point.probability for point in points])
    plot.line(tau_s, log10, color=PROPOSAL, width=2.0, tip="failure probability")
    for point in points:
        ends = math.log10(point.low or 1.0), math.log10(point.high or 1.0)
        plot.whisker(point.tau_s, *ends, color=PROPOSAL)
    names = measured_names(memory)
    for place, (measured_s, name) in enumerate(sorted(names.items())):
        plot.ticks_at(np.array([measured_s]), y_px=(plot.top, plot.bottom), color=PEM)
        words = f"{measured_s:.2g} s: {name}, on video"
        plot.note(words, plot.px(max(names)) + 4.0, plot.bottom - 8.0 - 12.0 * place)
    return plot.text()
