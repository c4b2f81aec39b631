"""A study of logical scenarios: probability against memory, by tracker, a panel a scenario."""

import io
from collections.abc import Sequence
from typing import Any

from pemviz.colors import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION
from studies.logical_scenarios.answers import Answer
from studies.logical_scenarios.page import SHOWN, TITLES, CellAnswer
from studies.logical_scenarios.settings import Cell, ScenarioStudySettings, tracker_words

COLORS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, GREY)
MARKERS = ("o", "s", "D", "^", "P", "X", "*")
DOTS_PER_INCH = 150
APART = 0.16
"""Between trackers at one memory time, as a share of the distance between two."""


def picture_png(settings: ScenarioStudySettings, answers: Sequence[CellAnswer]) -> bytes:
    """Intervals on a logarithmic axis; an arrow down where there is but an upper bound."""
    from matplotlib.figure import Figure  # noqa: PLC0415  slow to import

    by_cell = {(one.cell, one.rule): one.answer for one in answers}
    columns, rows = len(settings.logical_scenarios), len(SHOWN)
    figure = Figure(
        figsize=(2.2 + 2.8 * columns, 2.6 * rows + 0.8), dpi=DOTS_PER_INCH, layout="constrained"
    )
    grid = figure.subplots(rows, columns, sharex=True, sharey="row", squeeze=False)
    for row, rule in enumerate(SHOWN):
        for column, logical_scenario in enumerate(settings.logical_scenarios):
            axes = grid[row][column]
            for number, tracker in enumerate(settings.trackers):
                shift = APART * (number - (len(settings.trackers) - 1) / 2)
                cells = [Cell(logical_scenario, one, tracker) for one in settings.memories_s]
                _series(axes, [by_cell[cell, rule] for cell in cells], number, shift)
            axes.set_yscale("log")
            axes.grid(axis="y", color=GREY, alpha=0.25, linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
            if row == 0:
                axes.set_title(logical_scenario, loc="left")
            if column == 0:
                axes.set_ylabel(f"P({TITLES[rule]})\nper encounter")
    places = range(len(settings.memories_s))
    for axes in grid[-1]:
        axes.set_xticks(places, [f"{one:g} s" for one in settings.memories_s])
        axes.set_xlim(-0.5, len(settings.memories_s) - 0.5)
        axes.set_xlabel("memory of misses")
    _legend(figure, settings)
    stream = io.BytesIO()
    # no software version inside: the same figures give the same bytes
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _series(axes: Any, answers: Sequence[Answer], number: int, shift: float) -> None:
    """One tracker's answers against memory."""
    color, marker = COLORS[number % len(COLORS)], MARKERS[number % len(MARKERS)]
    for place, one in enumerate(answers):
        x = place + shift
        if one.probability is None:
            axes.plot([x], [one.high], marker=marker, color=color, fillstyle="none", markersize=5)
            axes.annotate("", (x, one.high), xytext=(0, -16), textcoords="offset points",
                          arrowprops={"arrowstyle": "<-", "color": color})  # fmt: skip
            continue
        axes.plot([x, x], [one.low, one.high], color=color, linewidth=1.4)
        fill = "full" if one.basis == "counted" else "none"
        axes.plot([x], [one.probability], marker=marker, color=color, markersize=5, fillstyle=fill)


def _legend(figure: Any, settings: ScenarioStudySettings) -> None:
    from matplotlib.lines import Line2D  # noqa: PLC0415  slow to import

    handles = [
        Line2D([], [], color=COLORS[n % len(COLORS)], marker=MARKERS[n % len(MARKERS)], label=label)
        for n, label in enumerate(map(tracker_words, settings.trackers))
    ]
    full: Any = "full"
    none: Any = "none"
    for fill, label in (
        (full, "counted ten times or more"),
        (none, "counted fewer times, or mixture's"),
        (none, "with an arrow: upper bound, not seen"),
    ):
        handles.append(
            Line2D([], [], color=GREY, marker="o", linestyle="", fillstyle=fill, label=label)
        )
    columns = min(len(settings.logical_scenarios), 3)
    figure.legend(handles=handles, loc="outside lower left", ncols=columns, frameon=False)
