"""How violations happen, drawn: the gap of the likeliest ones, and when misses fall."""

from collections.abc import Sequence

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.colors import BLUE, MISSED
from pemviz.reports.pictures.svg import Axis, Plot

WIDTH, HEIGHT = 460, 230


def gap_plot(gap_m: FloatArray, missed: BoolArray, share: FloatArray, *, dt_s: float) -> str:
    """Gaps ``[V, T]`` [m] over time, darker the likelier, with dots where outcomes are missed.

    Args:
        gap_m: Of violating rollouts, the likeliest first.
        missed: Their outcomes ``[V, T-1]``; those of the likeliest are drawn.
        share: How likely each is given a violation, ``[V]``.
        dt_s: Time step [s].
    """
    time_s = np.arange(gap_m.shape[1]) * dt_s
    low, high = min(0.0, float(gap_m.min())), float(gap_m.max())
    plot = Plot(
        title="Gap in the likeliest violations",
        x=Axis(0.0, float(time_s[-1]), "time [s]"),
        y=Axis(low - 0.5, high + 0.5, "gap [m]"),
        width=WIDTH,
        height=HEIGHT,
        bottom=50,
    )
    for gaps, part in zip(gap_m[::-1], share[::-1].tolist(), strict=True):
        tip = f"{part:.0%} of the weight"
        plot.line(time_s, gaps, color=BLUE, opacity=0.25 + 0.6 * min(part / share[0], 1.0), tip=tip)
    steps = np.flatnonzero(missed[0])
    plot.points(time_s[steps].tolist(), gap_m[0][steps].tolist(), color=MISSED, radius=2.6)
    plot.legend([("a violation", BLUE, "")], x=plot.left, y=HEIGHT - 8)
    plot.legend([("missed, in the likeliest", MISSED, "2 2")], x=plot.left + 110, y=HEIGHT - 8)
    return plot.text()


def misses_over_time(probability: Sequence[float], *, dt_s: float) -> str:
    """P(a miss that matters at each step, given a violation)."""
    values = 100.0 * np.asarray(probability, dtype=np.float64)
    edges = dt_s * np.arange(values.size + 1, dtype=np.float64)
    plot = Plot(
        title="Misses that matter, given a violation",
        x=Axis(0.0, float(edges[-1]), "time [s]"),
        y=Axis(0.0, 100.0, "missed [%]", ticks=(0.0, 25.0, 50.0, 75.0, 100.0)),
        width=WIDTH,
        height=HEIGHT,
    )
    plot.bars(edges, values, color=MISSED)
    return plot.text()
