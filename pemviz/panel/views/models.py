"""The answer under other error models that learnt from the same data, one mark for each."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from pemviz.colors import BLUE, GREEN, ORANGE, VERMILLION
from pemviz.panel.views.learning import logs
from pemviz.reports.estimate_text import REFITS
from pemviz.reports.pictures.html import heading, number, quiet
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.runs.result import RunResult

TITLE = "The answer under other error models"
ROW_PX = 24
Row = tuple[str, str, list[float], list[str]]
"""Name, colour, decimal logarithms, and what each mark says."""


def models_part(result: RunResult) -> str:
    """The answers of the refits and of other families beside the run's own; empty without any."""
    rows = _rows(result)
    if len(rows) < 2:
        return ""
    every = [value for _, _, values, _ in rows for value in values]
    plot = Plot(
        title="",
        x=Axis(
            math.floor(min(every)) - 0.3, math.ceil(max(every)) + 0.3, "P(violation)", log10=True
        ),
        y=Axis(-0.6, len(rows) - 0.4, "", ticks=()),
        height=50 + ROW_PX * len(rows),
        left=118,
        top=6,
    )
    for place, (name, color, values, tips) in enumerate(reversed(rows)):
        plot.note(name, plot.left - 8, plot.py(place) + 3.5, anchor="end")
        plot.points(values, _spread(len(values), place), color=color, radius=3.6, tips=tips)
    _draw_range(plot, result, place=len(rows) - 2)
    return heading(TITLE) + plot.text() + quiet(_words(result))


def _rows(result: RunResult) -> list[Row]:
    estimate, interval = result.estimate, result.pem_interval
    rows: list[Row] = []
    own = logs(None if estimate is None else estimate.probability)
    if own:
        rows.append((f"{result.pem.name[:14]}, as shipped", BLUE, own, _tips("the answer", own)))
    refits = [] if interval is None else [v for v in interval.log10_answers if v is not None]
    if refits:
        rows.append((f"its {len(refits)} refits", ORANGE, refits, _tips("a refit", refits)))
    for family in result.families:
        value = [family.log10_probability]
        rough = "" if family.is_reliable else " (rough)"
        rows.append((family.name[:16] + rough, VERMILLION, value, _tips(family.name, value)))
    exact = logs(None if result.reference is None else result.reference.probability)
    if exact:
        rows.append(("reference", GREEN, exact, _tips("reference", exact)))
    return rows


def _tips(name: str, values: Sequence[float]) -> list[str]:
    return [f"{escape(name)}: {number(10.0**value)}" for value in values]


def _spread(count: int, place: int) -> list[float]:
    """Heights of marks of one row, up and down so that they hide each other less."""
    if count == 1:
        return [float(place)]
    return (place + 0.26 * np.sin(2.4 * np.arange(count))).tolist()


def _draw_range(plot: Plot, result: RunResult, *, place: int) -> None:
    """The range that the uncertainty budget shows, beneath the refits' marks."""
    interval = result.pem_interval
    ends = [] if interval is None else logs(interval.low, interval.high)
    if interval is not None and interval.log10_answers and len(ends) == 2:
        level = np.full(2, place - 0.42)
        plot.line(np.array(ends), level, color=ORANGE, width=3.0, tip="95 % of the refits")


def _words(result: RunResult) -> str:
    interval = result.pem_interval
    words = (
        "All from the same rollouts, with other weights. No one's labels say which model is right "
        "where there are none."
    )
    if interval is None:
        return words
    if not interval.log10_answers:
        words += " The refits' own answers were not kept by the version that made this run."
    return (
        f"Of {number(interval.members, 6)} {REFITS}, {100 * interval.confidence:.3g} % put "
        f"P(violation) between {number(interval.low, 2)} and {number(interval.high, 2)} (median "
        f"{number(interval.median, 2)}). {words}"
    )
