"""The plane of two start values: how likely an encounter that starts there is a violation."""

import math
from collections.abc import Sequence
from html import escape
from itertools import pairwise

import numpy as np

from pemviz.analysis.starts import DangerousStarts, StartMap, StartValue
from pemviz.colors import BLACK, GREY
from pemviz.reports.pictures.html import clickable_points
from pemviz.reports.pictures.svg import Axis, Plot, text

WIDTH, HEIGHT, LEGEND_PX = 440, 300, 128
SHADES = ("#5b1a00", "#b23a00", "#ec7014", "#fdae5b", "#fdd9a0", "#fff4d6")
"""From the likeliest level down."""
UNKNOWN = "#e9ecef"
OVERLAP_PX = 0.6
HALF = math.log10(0.5)


def start_plane(found: DangerousStarts, *, target: str = "") -> str:
    """The picture; empty where the violations are too few for it.

    Args:
        found: Of one rule or of all.
        target: Element id of the input that a click on a rollout writes its number into, counted
            from 1 in ``found.points``.
    """
    plane = found.plane
    if plane is None:
        return ""
    values = {one.name: one for one in found.values}
    whose = "" if found.rule is None else f" of {found.rule}"
    plot = _axes(plane, values, title=f"P(violation{whose}) by start")
    levels = level_ends(plane)
    shapes = _cells(plot, plane, levels) + _usual(plot, values[plane.across], values[plane.up])
    points = "".join(_point(plot, found, place) for place in range(len(found.points)))
    act = f" {clickable_points(target=target)} style='cursor:pointer'" if target else ""
    return plot.text(
        extra=f"{shapes}<g{act}>{points}</g>{_legend(plot, levels, with_points=bool(points))}"
    )


def level_ends(plane: StartMap) -> tuple[float, ...]:
    """Lower ends of the levels, decimal logarithms, from the likeliest down: decades, and 0.5.

    As many as there are values for; the last of all shades has whatever lies below too.
    """
    known = [value for row in plane.log10_probability for value in row if value is not None]
    if not known:
        return ()
    highest = max(known)
    ends = [HALF] if highest >= HALF else []
    first = math.floor(highest - 1e-9) if highest < HALF else -1
    ends += [first - step for step in range(len(SHADES) - len(ends))]
    needed = next((i + 1 for i, end in enumerate(ends) if end <= min(known)), len(ends))
    return tuple(ends[:needed])


def level_of(log10: float, levels: Sequence[float]) -> int:
    """The place of a value's level; the last also has what lies below."""
    return next((i for i, end in enumerate(levels) if log10 >= end), len(levels) - 1)


def _axes(plane: StartMap, values: dict[str, StartValue], *, title: str) -> Plot:
    columns = len(plane.log10_probability[0])
    half_across = (plane.across_high - plane.across_low) / (columns - 1) / 2.0
    half_up = (plane.up_high - plane.up_low) / (len(plane.log10_probability) - 1) / 2.0
    return Plot(
        title=title,
        x=Axis(
            plane.across_low - half_across, plane.across_high + half_across,
            _label(values[plane.across]),
        ),
        y=Axis(plane.up_low - half_up, plane.up_high + half_up, _label(values[plane.up])),
        width=WIDTH,
        height=HEIGHT,
        right=LEGEND_PX,
    )  # fmt: skip


def _label(value: StartValue) -> str:
    name = value.name.replace("_", " ")
    return f"{name} at the start [{value.unit}]" if value.unit else f"{name} at the start"


def _cells(plot: Plot, plane: StartMap, levels: Sequence[float]) -> str:
    """Neighbours of a row with the same level as one rectangle."""
    shapes: list[str] = []
    rows = len(plane.log10_probability)
    height = (plot.bottom - plot.top) / rows
    for row, values in enumerate(plane.log10_probability):
        width = (plot.right - plot.left) / len(values)
        shades = [UNKNOWN if v is None else SHADES[level_of(v, levels)] for v in values]
        edges = [0, *np.flatnonzero(np.array(shades[1:]) != np.array(shades[:-1])) + 1, len(values)]
        for first, last in pairwise(edges):
            shapes.append(
                f"<rect x='{plot.left + first * width:.2f}' width='{(last - first) * width:.2f}' "
                f"y='{plot.bottom - (row + 1) * height:.2f}' height='{height + OVERLAP_PX:.2f}' "
                f"fill='{shades[first]}' shape-rendering='crispEdges'/>"
            )
    return "".join(shapes)


def _usual(plot: Plot, across: StartValue, up: StartValue) -> str:
    """The box of the middle 80 % of all starts, each way."""
    left, right = (plot.px(across.all_starts[place]) for place in (0, -1))
    bottom, top = (plot.py(up.all_starts[place]) for place in (0, -1))
    return (
        f"<rect x='{left:.1f}' y='{top:.1f}' width='{right - left:.1f}' "
        f"height='{bottom - top:.1f}' fill='none' stroke='{BLACK}' stroke-dasharray='4 3'/>"
    )


def _point(plot: Plot, found: DangerousStarts, place: int) -> str:
    one = found.points[place]
    x, y = plot.px(one.across), plot.py(one.up)
    if not (plot.left <= x <= plot.right and plot.top <= y <= plot.bottom):
        return ""
    across, up = found.plane.across if found.plane else "", found.plane.up if found.plane else ""
    tip = f"stage {one.stage}, rollout {one.rollout}: {across} {one.across:.4g}, {up} {one.up:.4g}"
    return (
        f"<g data-number='{place + 1}'><circle cx='{x:.1f}' cy='{y:.1f}' r='1.7' fill='{BLACK}' "
        f"stroke='#ffffff' stroke-width='0.6'/><circle cx='{x:.1f}' cy='{y:.1f}' r='4' "
        f"fill='transparent'/><title>{escape(tip)}</title></g>"
    )


def _legend(plot: Plot, levels: Sequence[float], *, with_points: bool) -> str:
    """A swatch a level, the likeliest on top, and what grey means."""
    x, y = plot.right + 10, plot.top + 4
    words = [f"{_power(end)} and more" for end in levels[:1]]
    words += [f"from {_power(end)}" for end in levels[1:]]
    if len(levels) == len(SHADES):
        words[-1] = f"below {_power(levels[-2])}"
    entries = [*zip(words, SHADES, strict=False), ("not known", UNKNOWN)]
    parts = [text("P(violation)", x, y + 4, color=BLACK, weight="600", size=10)]
    for place, (label, color) in enumerate(entries):
        row = y + 14 + 17 * place
        parts.append(
            f"<rect x='{x}' y='{row - 1}' width='13' height='13' fill='{color}' "
            f"stroke='{GREY}' stroke-width='0.5'/>"
            f"{text(label, x + 17, row + 9, raw=True, size=9.5)}"
        )
    y += 14 + 17 * len(entries) + 10
    box = f"<path d='M{x} {y - 3}h13' stroke='{BLACK}' stroke-dasharray='4 3'/>"
    dot = f"<circle cx='{x + 6.5}' cy='{y + 13}' r='1.7' fill='{BLACK}'/>"
    parts += [box, text("80 % of all, each way", x + 17, y, size=9.5)]
    if with_points:
        parts += [dot, text("a violation drawn", x + 17, y + 16.5, size=9.5)]
    return "".join(parts)


def _power(log10: float) -> str:
    if log10 >= -3.0:
        return f"{10.0**log10:g}"
    power = f"{log10:g}".replace("-", "\N{MINUS SIGN}")
    return f"10<tspan dy='-3.5' font-size='8'>{power}</tspan><tspan dy='3.5'> </tspan>"
