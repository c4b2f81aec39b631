"""Charts as matplotlib figures, for notebooks and papers."""

import io
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from pemviz.charts import chart as marks
from pemviz.charts.chart import (
    DASHED,
    DOTTED,
    SOLID,
    Axis,
    Chart,
    IntervalChart,
    PlaneChart,
    axis_decades,
)
from pemviz.colors import BLACK, GREY

WIDTH_IN = 7.0
DOTS_PER_INCH = 90
STYLES = {SOLID: "-", DASHED: "--", DOTTED: ":"}


class RunFigure(Figure):
    """A matplotlib figure that shows itself in a notebook without pyplot."""

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DOTS_PER_INCH)
        return picture.getvalue()


def empty_figure(height_in: float, *, rows: int = 1) -> tuple[RunFigure, Any]:
    """A figure and its axes, one below the other."""
    figure = RunFigure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True)
    for each in np.atleast_1d(axes):
        each.spines[["top", "right"]].set_visible(False)
    return figure, axes


def drawing(chart: Chart) -> RunFigure:
    """A chart as a figure of its own."""
    if isinstance(chart, IntervalChart):
        return _intervals(chart)
    figure, axes = empty_figure(WIDTH_IN * chart.height / chart.width)
    for mark in chart.marks:
        _draw(axes, chart, mark)
    for axis, name in ((chart.x, "x"), (chart.y, "y")):
        _set(axes, axis, name)
    axes.set_title(chart.title, loc="left")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=8)
    return figure


def _intervals(chart: IntervalChart) -> RunFigure:
    """A bar a row; figures stand above it, at its left end."""
    figure, axes = empty_figure(0.5 * len(chart.rows) + 1.0)
    first, last = (10.0**end for end in axis_decades(chart))
    for place, row in enumerate(chart.rows):
        if row.low is not None and row.high is not None:
            ends = [max(row.low, first), max(row.high, first)]
            style = "-" if row.holds else (0, (1.0, 0.6))
            axes.plot(
                ends, [place] * 2, color=row.color, linewidth=6.0, linestyle=style,
                solid_capstyle="butt", dash_capstyle="butt", marker="|",
            )  # fmt: skip
        if row.values:
            axes.plot(row.values, [place] * len(row.values), "o", color=row.color, markersize=5.0)
        known = [max(end, first) for end in (row.low, *row.values) if end is not None]
        left = min(known, default=first)
        anchor = "left" if left < (first * last) ** 0.5 else "right"
        at = left if anchor == "left" else max(known)
        axes.text(
            at, place - 0.2, row.figures, color=BLACK, fontsize=8, ha=anchor, va="bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )  # fmt: skip
    for rule in chart.rules:
        axes.axvline(rule.at, color=rule.color, linewidth=1.2, zorder=0.5)
    axes.set_yticks(range(len(chart.rows)), [row.name for row in chart.rows])
    axes.set(xscale="log", xlim=(first, last), xlabel=chart.label)
    axes.set_title(chart.title, loc="left")
    axes.set_ylim(len(chart.rows) - 0.5, -0.7)
    return figure


def _set(axes: Any, axis: Axis, name: str) -> None:
    scale = {f"{name}scale": "log"} if axis.log10 else {}
    axes.set(**scale, **{f"{name}lim": (axis.low, axis.high), f"{name}label": axis.label})
    if axis.ticks is not None:
        set_ticks = axes.set_xticks if name == "x" else axes.set_yticks
        set_ticks(list(axis.ticks), labels=list(axis.words) or None)


def _draw(axes: Any, chart: PlaneChart, mark: marks.Mark) -> None:
    match mark:
        case marks.Line():
            axes.plot(
                mark.x, mark.y, color=mark.color, linewidth=mark.width, alpha=mark.opacity,
                linestyle=STYLES.get(mark.dash, "--"), label=mark.label or None,
            )  # fmt: skip
        case marks.Points():
            if mark.joined:
                axes.plot(mark.x, mark.y, color=mark.color, linewidth=1.0)
            areas = (1.6 * np.asarray(mark.radius)) ** 2
            axes.scatter(
                mark.x, mark.y, s=areas, color=mark.color, label=mark.label or None, zorder=3,
                marker="x" if mark.crosses else "o",
            )  # fmt: skip
        case marks.Strokes():
            axes.vlines(
                mark.x, mark.y - mark.below, mark.y + mark.above, color=mark.color,
                label=mark.label or None,
            )  # fmt: skip
        case marks.Band():
            axes.axhspan(
                mark.low, mark.high, facecolor=(mark.color, 0.13), edgecolor=mark.color,
                linestyle="-" if mark.holds else ":", label=mark.label or None,
            )  # fmt: skip
        case marks.Veil():
            axes.axvspan(mark.at, chart.x.high, color="white", alpha=0.72, zorder=4)
            axes.axvline(mark.at, color=BLACK, linestyle=":", label=None)
            axes.annotate(mark.label, (mark.at, chart.y.low), fontsize=8, zorder=5)
        case marks.Whiskers():
            ends = zip(mark.x, mark.low, mark.high, mark.holds, strict=True)
            for place, (x, low, high, holds) in enumerate(ends):
                axes.plot(
                    [x] * 2, [low, high], color=mark.color, linestyle="-" if holds else ":",
                    marker="_", label=mark.label or None if place == 0 else None,
                )  # fmt: skip
        case marks.Bars():
            axes.bar(
                mark.edges[:-1], mark.heights, width=np.diff(mark.edges), align="edge",
                color=mark.color, edgecolor="white", label=mark.label or None,
            )  # fmt: skip
        case marks.Cells():
            _shade(axes, chart, mark)
        case marks.Box():
            axes.plot(
                [mark.low_x, mark.high_x, mark.high_x, mark.low_x, mark.low_x],
                [mark.low_y, mark.low_y, mark.high_y, mark.high_y, mark.low_y],
                color=mark.color, linestyle="--", linewidth=1.0, label=mark.label or None,
            )  # fmt: skip
        case marks.Rule():
            _rule(axes, mark)


def _rule(axes: Any, mark: marks.Rule) -> None:
    across = axes.axvline if mark.upright else axes.axhline
    named = mark.label if mark.label_at == "legend" else None
    style = STYLES.get(mark.dash, "--")
    across(mark.at, color=mark.color, linewidth=1.0, linestyle=style, label=named)
    if named:
        return
    if mark.upright:
        axes.text(
            mark.at, 0.03, f" {mark.label}", transform=axes.get_xaxis_transform(), rotation=90,
            fontsize=8, ha="right",
        )  # fmt: skip
    else:
        axes.text(
            1.0, mark.at, mark.label, transform=axes.get_yaxis_transform(), fontsize=8, ha="right",
            va="bottom", color=mark.color,
        )  # fmt: skip


def _shade(axes: Any, chart: PlaneChart, mark: marks.Cells) -> None:
    """A level a colour, with a bar that names them."""
    levels = np.full(mark.values.shape, np.nan)
    known = np.isfinite(mark.values)
    for place, level in reversed(list(enumerate(mark.levels))):
        levels[known & (mark.values >= level.low)] = place
    levels[known & np.isnan(levels)] = len(mark.levels) - 1
    rows, columns = mark.values.shape
    edges = (
        np.linspace(chart.x.low, chart.x.high, columns + 1),
        np.linspace(chart.y.low, chart.y.high, rows + 1),
    )
    axes.set_facecolor(mark.unknown)
    drawn = axes.pcolormesh(
        *edges, levels, cmap=ListedColormap([level.color for level in mark.levels]),
        vmin=-0.5, vmax=len(mark.levels) - 0.5,
    )  # fmt: skip
    bar = axes.figure.colorbar(drawn, ax=axes, label=f"{mark.title} (grey: not known)")
    bar.set_ticks(range(len(mark.levels)), labels=[level.words for level in mark.levels])
    bar.ax.invert_yaxis()
    bar.outline.set_edgecolor(GREY)
