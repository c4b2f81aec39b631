"""One rollout of any scenario that tells where its cars are, against time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.charts.plot import Axis, Plot, svg, text
from pemviz.colors import BLUE, DETECTED, GREY, MISSED, car_color
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData
from pemviz.panel.views.page import PLOTS, SPEEDS
from pemviz.panel.views.rollout import CURSOR, HEIGHT, PLOT_WIDTH, row_title
from pemviz.runs.drawn_rollout import (
    NOT_ASKED,
    RIGHT,
    WRONG,
    DrawnRollout,
    answer_words,
    drawn_rollout,
    remembered,
)
from pemviz.simulators.episodic import episodic
from pemviz.simulators.scene import drawn_tracks
from pemviz.types import Signal

NAME_CHARACTERS = 16
MARGIN = 8
MOST_INSIDE = 3
"""Cars whose names have room among the lines of their speeds; of more they stand beside these."""
LEGEND_BESIDE, BESIDE_CHARACTERS = 96, 12
SHADES = {NOT_ASKED: GREY, RIGHT: DETECTED, WRONG: MISSED}


@dataclass(frozen=True, eq=False)
class RoadTrack:
    """One rollout.

    Attributes:
        title: What it is, in words.
        drawn: Where its cars are, and what perception told.
        asked: The signal that the specification is about first.
        values: ``[T]`` of that signal.
        violated: The verdict on the whole rollout.
    """

    title: str
    drawn: DrawnRollout
    asked: Signal
    values: FloatArray
    violated: bool

    @property
    def states(self) -> int:
        """Number of states T."""
        return self.drawn.count

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.drawn.dt_s

    @property
    def time_s(self) -> FloatArray:
        """Times ``[T]`` [s]."""
        return np.arange(self.states, dtype=np.float64) * self.dt_s

    @property
    def interesting_step(self) -> int:
        """Where the eye should land: contact, else where the asked signal is least."""
        contact = self.drawn.contact_step
        return int(np.argmin(self.values)) if contact is None else contact


def road_track(run: RunData, entry: RankedRow) -> RoadTrack | None:
    """The rollout of a row of the ranking; ``None`` for the braking scenario, drawn by its gap."""
    if run.own is None:
        return None
    index, simulator = entry.index, run.own
    signals = {name: values[0] for name, values in run.signals(index).items()}
    detected = np.asarray(run.steps(["detected"], index)["detected"][0], dtype=np.bool_)
    memory = {}
    if drawn_tracks(simulator) is not None and episodic(simulator) is None:
        latents = run.latents(index)
        start = None if latents is None else latents.start[0]
        noise = None if latents is None else latents.noise[0]
        memory = remembered(simulator, detected=detected, start=start, noise=noise)
    drawn = drawn_rollout(simulator, signals=signals, detected=detected, memory=memory)
    if drawn is None:
        return None
    asked = run.charted
    return RoadTrack(
        title=row_title(entry),
        drawn=drawn,
        asked=asked,
        values=signals[asked.name],
        violated=entry.violated,
    )


def road_plots(chosen: RoadTrack) -> tuple[str, ...]:
    """The plots, each without its end, where :func:`road_plots_at` puts a cursor."""
    names = (chosen.title, "Speeds", "Perception")
    return tuple(
        svg(plot.group() + "@@", width=PLOT_WIDTH, height=HEIGHT, title=name).split("@@")[0]
        for plot, name in zip(_plots(chosen), names, strict=True)
    )


def road_plots_at(plots: Sequence[str], chosen: RoadTrack, step: int, *, speed: float) -> str:
    """The plots side by side with a cursor at a step, and the values there."""
    shown: list[str] = []
    values = _values(chosen, step, speed=speed)
    for place, (drawn, plot) in enumerate(zip(plots, _axes(chosen), strict=True)):
        x = plot.px(float(chosen.time_s[step]))
        line = f"<path d='M{x:.1f} {plot.top}V{plot.bottom}' stroke='{CURSOR}' stroke-width='1.4'/>"
        end = PLOT_WIDTH - MARGIN
        words = text(values[place], end, plot.top - 9, anchor="end", color=CURSOR)
        named = "" if place else f" data-cursor='{step}'"
        shown.append(f"{drawn}<g{named}>{line}{words}</g></svg>")
    asked, speeds, perception = shown
    middle = speeds.replace("<svg ", f"<svg class='{SPEEDS}' ", 1)
    return f"<div class='{PLOTS}'>{asked}{middle}{perception}</div>"


def step_words(chosen: RoadTrack, step: int) -> str:
    """What perception errs about at a step."""
    drawn = chosen.drawn
    if drawn.contact_step is not None and step >= drawn.contact_step:
        return "after contact"
    if step >= len(drawn.answers):
        return "end"
    wrong = [
        f"{slot.name} {answer_words(slot, WRONG)}"
        for slot, answer in zip(drawn.slots, drawn.answers[step], strict=True)
        if answer == WRONG
    ]
    return ", ".join(wrong) or "no error"


def _values(chosen: RoadTrack, step: int, *, speed: float) -> tuple[str, str, str]:
    states, unit = chosen.drawn.states, chosen.asked.unit
    shown = f"{chosen.values[step]:.2f} {unit} at {chosen.time_s[step]:.2f} s"
    return (
        shown.replace("  ", " "),
        f"ego {states.speed_mps[step, 0]:.1f}; played at {speed:g}x",
        step_words(chosen, step),
    )


def _axes(chosen: RoadTrack) -> tuple[Plot, Plot, Plot]:
    drawn = chosen.drawn
    time = Axis(0.0, max(float(chosen.time_s[-1]), chosen.dt_s), "time [s]")
    low, high = float(np.min(chosen.values)), float(np.max(chosen.values))
    margin = 0.08 * (high - low) or 1.0
    unit = f" [{chosen.asked.unit}]" if chosen.asked.unit else ""
    name = chosen.asked.name.replace("_", " ")
    fastest = max(float(np.max(drawn.states.speed_mps, initial=0.0)), 1.0)
    rows = Axis(len(drawn.slots) + 0.5, 0.5, "", ticks=())
    size = {"width": PLOT_WIDTH, "height": HEIGHT, "left": 42, "right": MARGIN, "top": 22}
    beside = LEGEND_BESIDE if len(drawn.cars) > MOST_INSIDE else MARGIN
    return (
        Plot(
            title=name.capitalize(), x=time, y=Axis(low - margin, high + margin, name + unit),
            **size,
        ),
        Plot(
            title="Speeds", x=time, y=Axis(0.0, fastest * 1.08, "speed [m/s]"),
            **(size | {"right": beside}),
        ),
        Plot(title="Perception", x=time, y=rows, **(size | {"left": 100, "title_at": 4})),
    )  # fmt: skip


def _plots(chosen: RoadTrack) -> tuple[Plot, Plot, Plot]:
    asked, speeds, perception = _axes(chosen)
    drawn, time_s = chosen.drawn, chosen.time_s
    asked.line(time_s, chosen.values, color=BLUE, width=2.2)
    entries: list[tuple[str, str, str]] = []
    for car, shape in enumerate(drawn.cars):
        there = np.where(drawn.states.present[:, car], drawn.states.speed_mps[:, car], np.nan)
        dash = "" if car == 0 else "6 3"
        speeds.line(time_s, there, color=car_color(car), width=2.2, dash=dash)
        entries.append((_short(shape.name), car_color(car), dash))
    if len(entries) > MOST_INSIDE:
        short = [
            (_short(name, most=BESIDE_CHARACTERS), color, dash) for name, color, dash in entries
        ]
        speeds.legend(short, x=speeds.right + 4, y=speeds.top + 8)
    else:
        speeds.legend(entries, x=speeds.left + 8, y=speeds.bottom - 6 - 14 * len(entries))
    _draw_answers(perception, chosen)
    if drawn.contact_step is not None:
        at_s = drawn.contact_step * drawn.dt_s
        impact = drawn.impact_speed_mps
        asked.veil(at_s, label="contact")
        speeds.veil(at_s, label="" if impact is None else f"{impact:.1f} m/s impact")
        perception.veil(at_s)
    return asked, speeds, perception


def _draw_answers(plot: Plot, chosen: RoadTrack) -> None:
    """A row for each slot: strokes at errors, lower ones where there is none, none if absent."""
    drawn = chosen.drawn
    row_px = (plot.bottom - plot.top) / len(drawn.slots)
    for place, slot in enumerate(drawn.slots):
        middle = plot.top + (place + 0.5) * row_px
        answers = drawn.answers[:, place]
        tall = min(0.34 * row_px, 16.0)
        for answer, half in ((RIGHT, 0.35 * tall), (WRONG, tall)):
            at_s = chosen.time_s[:-1][answers == answer] + drawn.dt_s / 2
            plot.ticks_at(at_s, y_px=(middle - half, middle + half), color=SHADES[answer])
        if not np.any(answers):
            plot.note(answer_words(slot, NOT_ASKED), plot.left + 4, middle + 4)
        plot.note(_short(slot.name), plot.left - 4, middle + 4, anchor="end")


def _short(name: str, *, most: int = NAME_CHARACTERS) -> str:
    return name if len(name) <= most else f"{name[: most - 1]}\N{HORIZONTAL ELLIPSIS}"
