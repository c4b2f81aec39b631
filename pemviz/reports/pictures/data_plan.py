"""What to measure next, drawn: P(missed) required beside P(missed) now, by distance."""

import math
from html import escape

import numpy as np

from pemviz.analysis.label_plan import BandPlan, LabelPlan
from pemviz.colors import BLACK, PURPLE, VERMILLION
from pemviz.reports.data_plan_text import (
    BAND_COLUMNS,
    BAND_NOTE,
    PLAN_TITLE,
    band_rows,
    plan_sentences,
    z_text,
)
from pemviz.reports.pictures.html import grid, heading, quiet
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.runs.result import RunResult

LINES = (
    ("labels so far allow", PURPLE, "5 3"),
    ("required", VERMILLION, ""),
    ("error model", BLACK, "1.5 2.5"),
)
"""What is drawn in every band, from the top as a rule."""
WIDTH, HEIGHT = 400, 190
NBSP = "\N{NO-BREAK SPACE}"
MARGIN_M = 2.0
LEAST = 1e-12
"""Probabilities below are drawn as this."""


def plan_part(result: RunResult) -> str:
    """Sentences, picture and table; empty without a plan."""
    plan = result.plan
    if plan is None:
        return ""
    parts = [heading(PLAN_TITLE), sentence_list(result)]
    if plan.labels is not None:
        rows = [[escape(cell).replace(" ", NBSP) for cell in row] for row in band_rows(plan.labels)]
        header = [escape(column) for column in BAND_COLUMNS]
        parts += [requirement_plot(plan.labels), grid(header, rows, name=PLAN_TITLE)]
        parts.append(quiet(BAND_NOTE))
    return "".join(parts)


def sentence_list(result: RunResult) -> str:
    """The plan's sentences, one below the other."""
    items = "".join(f"<li>{escape(words)}</li>" for words in plan_sentences(result))
    return f"<ul style='margin:0;padding-left:18px'>{items}</ul>"


def requirement_plot(labels: LabelPlan, *, width: int = WIDTH, height: int = HEIGHT) -> str:
    """P(missed) over z: what the labels allow, what is required, what the error model says."""
    if not labels.bands:
        return ""
    lowest = min(min(band.required, band.model) for band in labels.bands)
    floor = math.floor(math.log10(max(lowest, LEAST)) - 0.2)
    ends = [_ends(band) for band in labels.bands]
    plot = Plot(
        title=f"P(missed): required for {labels.target:.2g}, and now",
        x=Axis(ends[0][0] - 0.3, ends[-1][1] + 0.3, "z, camera to the obstacle's centre [m]"),
        y=Axis(floor, 0.15, "P(missed)", log10=True, ticks=tuple(range(floor, 1))),
        width=width,
        height=height,
        bottom=50,
    )
    for band, (low, high) in zip(labels.bands, ends, strict=True):
        for (name, color, dash), value in zip(
            LINES, (band.allowed, band.required, band.model), strict=True
        ):
            level = math.log10(max(value, LEAST))
            plot.line(
                np.array([low + 0.06, high - 0.06]),
                np.array([level, level]),
                color=color,
                width=2.6,
                dash=dash,
                tip=f"{z_text(band)}: {name} {value:.2g}",
            )
    for x, entry in zip((0, 140, 222), LINES, strict=True):
        plot.legend([entry], x=plot.left + x, y=height - 8)
    return plot.text()


def _ends(band: BandPlan) -> tuple[float, float]:
    """Where the band is drawn; one without an edge is drawn so far beyond its other one."""
    low = band.low_m if band.low_m is not None else (band.high_m or 0.0) - MARGIN_M
    return low, band.high_m if band.high_m is not None else low + MARGIN_M
