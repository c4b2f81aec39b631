"""One rollout: what is drawn of it, and its charts against time."""

from dataclasses import dataclass

import numpy as np

from pemviz import stl
from pemviz.arrays import FloatArray
from pemviz.charts.svg import Axis, Plot, svg_element
from pemviz.colors import BLUE, DETECTED, GREY, MISSED, PEM, PROPOSAL, VERMILLION, car_color
from pemviz.config import ExperimentConfig
from pemviz.panel.curve_chart import signal_label, signal_name
from pemviz.panel.pieces import number
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData, detection_probability
from pemviz.runs.drawn_rollout import (
    NOT_EVALUATED,
    RIGHT,
    WRONG,
    DrawnRollout,
    answer_words,
    drawn_rollout,
    remembered,
)
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.vectorized import GAP
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import within
from pemviz.simulators.scene import DrawsTracks
from pemviz.stl.formulas import Constant, Predicate
from pemviz.stl.formulas import Signal as SignalOf
from pemviz.types import Signal

HEIGHT = 190
NAME_CHARACTERS = 16
MARGIN = 8
MOST_INSIDE = 3
"""Cars whose names have room among the lines of their speeds; of more they stand beside these."""
LEGEND_BESIDE, BESIDE_CHARACTERS = 96, 12
SHADES = {NOT_EVALUATED: GREY, RIGHT: DETECTED, WRONG: MISSED}


@dataclass(frozen=True, eq=False)
class Track:
    """One rollout.

    Attributes:
        charted: The signal that the specification is about first.
        values: ``[T]`` of that signal.
        charted_words: What that signal is.
        limits: What the specification compares that signal with.
        detection: ``[2, T-1]`` P(detected) under the error model, and under the proposal sampled
            from; ``None`` where perception answers several things at a step.
    """

    title: str
    drawn: DrawnRollout
    charted: Signal
    charted_words: str
    values: FloatArray
    limits: tuple[float, ...]
    detection: FloatArray | None = None

    @property
    def time_s(self) -> FloatArray:
        """Times ``[T]`` [s]."""
        return np.arange(self.drawn.count, dtype=np.float64) * self.drawn.dt_s

    @property
    def interesting_step(self) -> int:
        """Where the eye should land: contact, else where the signal is least."""
        contact = self.drawn.contact_step
        return int(np.argmin(self.values)) if contact is None else contact


def track(run: RunData, entry: RankedRow) -> Track:
    """The rollout of a row of the ranking."""
    index, simulator = entry.index, run.simulator
    signals = {name: values[0] for name, values in run.signals(index).items()}
    table = {n: values[0] for n, values in run.steps(["detected", "log_p", "log_q"], index).items()}
    detected = np.asarray(table["detected"], dtype=np.bool_)
    memory = {}
    if within(simulator, DrawsTracks) is not None and episodic(simulator) is None:
        latents = run.latents(index)
        start = None if latents is None else latents.start[0]
        noise = None if latents is None else latents.noise[0]
        memory = remembered(simulator, detected=detected, start=start, noise=noise)
    drawn = drawn_rollout(simulator, signals=signals, detected=detected, memory=memory)
    assert drawn is not None  # noqa: S101  asked for by run_data.own_scenario
    sampled = (detection_probability(table[name], detected) for name in ("log_p", "log_q"))
    verdict = "violates" if entry.violated else "does not violate"
    return Track(
        title=f"Rank {entry.rank}: robustness {number(entry.robustness)}, {verdict}, "
        f"{entry.misses} misses, stage {entry.stage}, rollout {entry.rollout}",
        drawn=drawn,
        charted=run.charted,
        charted_words=_charted_words(run),
        values=signals[run.charted.name],
        limits=_limits(run.config, run.charted),
        detection=np.stack(list(sampled)) if detected.ndim == 1 else None,
    )


def _charted_words(run: RunData) -> str:
    words = signal_name(run.charted).capitalize()
    if run.own is None and run.charted.name == GAP:
        return f"{words}, from the ego's camera: bumpers touch at {CAMERA_TO_BUMPER_M:g} m"
    return words


def _limits(config: ExperimentConfig, signal: Signal) -> tuple[float, ...]:
    """What the specification, or its rules, compare a signal with, ascending."""
    limits: set[float] = set()
    for formula in [rule.formula for rule in config.rules] or [config.spec]:
        for part in stl.parse(formula).walk():
            if isinstance(part, Predicate) and part.left == SignalOf(signal.name):
                limits |= {part.right.value} if isinstance(part.right, Constant) else set()
    return tuple(sorted(limits))


def track_plots(chosen: Track, *, width: int) -> tuple[str, ...]:
    """The charted signal, speeds and perception against time."""
    names = (chosen.title, "Speeds", "Perception")
    return tuple(
        svg_element(plot.group(), width=width, height=HEIGHT, title=name)
        for plot, name in zip(_plots(chosen, width=width), names, strict=True)
    )


def step_words(chosen: Track, step: int) -> str:
    """What perception errs about at a step."""
    drawn = chosen.drawn
    if drawn.contact_step is not None and step >= drawn.contact_step:
        return "after contact"
    if step >= len(drawn.answers):
        return "end"
    if chosen.detection is not None:
        return answer_words(drawn.slots[0], int(drawn.answers[step, 0]))
    wrong = [
        f"{slot.name} {answer_words(slot, WRONG)}"
        for slot, answer in zip(drawn.slots, drawn.answers[step], strict=True)
        if answer == WRONG
    ]
    return ", ".join(wrong) or "no error"


def track_axes(chosen: Track, *, width: int) -> tuple[Plot, Plot, Plot]:
    """The plots with nothing on them: where their axes lie."""
    drawn, signal = chosen.drawn, chosen.charted
    time = Axis(0.0, max(float(chosen.time_s[-1]), drawn.dt_s), "time [s]")
    low, high = (float(end([*chosen.values, *chosen.limits])) for end in (np.min, np.max))
    margin = 0.08 * (high - low) or 1.0
    value = Axis(low - margin, high + margin, signal_label(signal))
    fastest = max(float(np.max(drawn.states.speed_mps, initial=0.0)), 1.0)
    speed = Axis(0.0, fastest * 1.08, "speed [m/s]")
    size = {"width": width, "height": HEIGHT, "left": 42, "right": MARGIN, "top": 22}
    beside = LEGEND_BESIDE if len(drawn.cars) > MOST_INSIDE else MARGIN
    answers = Axis(-0.22, 1.04, "P(detected)", ticks=(0.0, 0.5, 1.0))
    room = {}
    if chosen.detection is None:
        answers = Axis(len(drawn.slots) + 0.5, 0.5, "", ticks=())
        room = {"left": 100, "title_at": 4}
    return (
        Plot(title=chosen.charted_words, x=time, y=value, **size),
        Plot(title="Speeds", x=time, y=speed, **(size | {"right": beside})),
        Plot(title="Perception", x=time, y=answers, **(size | room)),
    )


def _plots(chosen: Track, *, width: int) -> tuple[Plot, Plot, Plot]:
    charted, speeds, perception = track_axes(chosen, width=width)
    drawn, time_s = chosen.drawn, chosen.time_s
    for limit in chosen.limits:
        label = f"{limit:g} {chosen.charted.unit}".strip() + ": limit"
        charted.hline(limit, color=VERMILLION, label=label, dash="", at_left=True)
    charted.line(time_s, chosen.values, color=BLUE, width=2.2)
    inside = len(drawn.cars) <= MOST_INSIDE
    most = NAME_CHARACTERS if inside else BESIDE_CHARACTERS
    entries: list[tuple[str, str, str]] = []
    for car, shape in enumerate(drawn.cars):
        there = np.where(drawn.states.present[:, car], drawn.states.speed_mps[:, car], np.nan)
        dash = "" if car == 0 else "6 3"
        speeds.line(time_s, there, color=car_color(car), width=2.2, dash=dash)
        entries.append((_short(shape.name, most=most), car_color(car), dash))
    if inside:
        speeds.legend(entries, x=speeds.left + 8, y=speeds.bottom - 6 - 14 * len(entries))
    else:
        speeds.legend(entries, x=speeds.right + 4, y=speeds.top + 8)
    draw = _draw_answers if chosen.detection is None else _draw_detection
    draw(perception, chosen)
    if drawn.contact_step is not None:
        at_s = drawn.contact_step * drawn.dt_s
        impact = drawn.impact_speed_mps
        charted.veil(at_s, label="contact")
        speeds.veil(at_s, label="" if impact is None else f"{impact:.1f} m/s impact")
        perception.veil(at_s)
    return charted, speeds, perception


def _draw_answers(plot: Plot, chosen: Track) -> None:
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
            plot.note(answer_words(slot, NOT_EVALUATED), plot.left + 4, middle + 4)
        plot.note(_short(slot.name), plot.left - 4, middle + 4, anchor="end")


def _draw_detection(plot: Plot, chosen: Track) -> None:
    """P(detected) of the error model and of the proposal; under them strokes, misses higher."""
    assert chosen.detection is not None  # noqa: S101  asked for with it alone
    pem, proposal = chosen.detection
    steps_s, answers = chosen.time_s[:-1], chosen.drawn.answers[:, 0]
    plot.line(steps_s, proposal, color=PROPOSAL, width=1.8, dash="5 2")
    plot.line(steps_s, pem, color=PEM, width=1.8)
    names = [("error model", PEM, ""), ("proposal", PROPOSAL, "5 2")]
    plot.legend(names, x=plot.right - 92, y=plot.py(0.5) - 4)
    base = plot.bottom
    plot.ticks_at(steps_s[answers == RIGHT], y_px=(base - 9, base - 1), color=DETECTED)
    plot.ticks_at(steps_s[answers == WRONG], y_px=(base - 21, base - 12), color=MISSED)
    for label, y in (("hit", base - 2), ("miss", base - 13)):
        plot.note(label, plot.left - 4, y, anchor="end")


def _short(name: str, *, most: int = NAME_CHARACTERS) -> str:
    return name if len(name) <= most else f"{name[: most - 1]}\N{HORIZONTAL ELLIPSIS}"
