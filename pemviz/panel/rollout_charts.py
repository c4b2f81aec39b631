"""One rollout: what is drawn of it, and its charts against time."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pemviz import stl
from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.charts.chart import SOLID, Axis, Line, Mark, PlaneChart, Points, Rule, Strokes, Veil
from pemviz.colors import BLUE, DETECTED, MISSED, PEM, PROPOSAL, VERMILLION, car_color
from pemviz.config import ExperimentConfig
from pemviz.panel.pieces import number, signal_label, signal_name
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData, detection_probability
from pemviz.runs.drawn_rollout import (
    NOT_EVALUATED,
    RIGHT,
    WHOLE,
    WRONG,
    DrawnRollout,
    answer_words,
    drawn_rollout,
    remembered,
    slot_answers,
    slots_of,
)
from pemviz.simulators.braking.contact import CAMERA_TO_BUMPER_M
from pemviz.simulators.braking.vectorized import GAP
from pemviz.simulators.episodic import episodic
from pemviz.simulators.latents import within
from pemviz.simulators.scene import DrawsTracks
from pemviz.simulators.slots import Slot
from pemviz.stl.formulas import Constant, Predicate
from pemviz.stl.formulas import Signal as SignalOf
from pemviz.types import Signal

HEIGHT, LOWEST = 150, 110
"""Of a chart without its legend, and at least where several share the place of the scene [px]."""
NAME_CHARACTERS = 16
AS_LARGE = 1.08
"""Of what is drawn, an axis."""
OUTCOME_REACH, SLOT_REACH = 0.09, 0.34
"""How long strokes are, in values of the axis."""


@dataclass(frozen=True, eq=False)
class Track:
    """One rollout of T states with K slots.

    Attributes:
        drawn: Where its cars are; ``None`` where the scenario does not tell.
        charted: The signal that the specification is about first.
        charted_words: What that signal is.
        signals: ``[T]`` of each signal, the charted one first.
        limits: What the specification compares signals with, ascending.
        slots: The K slots; one, named ``perception``, where a scenario has none.
        answers: ``[T-1, K]``, see :mod:`pemviz.runs.drawn_rollout`.
        dt_s: Time step [s].
        detection: ``[2, T-1]`` P(detected) under the error model, and under the proposal sampled
            from; ``None`` where perception answers several things at a step.
        observed: Whether answers are those of the detector itself.
    """

    title: str
    drawn: DrawnRollout | None
    charted: Signal
    charted_words: str
    signals: Mapping[Signal, FloatArray]
    limits: Mapping[Signal, tuple[float, ...]]
    slots: tuple[Slot, ...]
    answers: IntArray
    dt_s: float
    detection: FloatArray | None = None
    observed: bool = False

    @property
    def values(self) -> FloatArray:
        """``[T]`` of the charted signal."""
        return self.signals[self.charted]

    @property
    def count(self) -> int:
        """Number of states T."""
        return len(self.answers) + 1

    @property
    def time_s(self) -> FloatArray:
        """Times ``[T]`` [s]."""
        return np.arange(self.count, dtype=np.float64) * self.dt_s

    @property
    def contact_step(self) -> int | None:
        """The state in which the ego first touches a car, as far as that is known."""
        return None if self.drawn is None else self.drawn.contact_step

    @property
    def missed(self) -> BoolArray:
        """``[T-1]`` whether perception errs about any slot, until contact."""
        missed: BoolArray = np.any(self.answers == WRONG, axis=1)
        if self.contact_step is not None:
            missed[self.contact_step :] = False
        return missed

    @property
    def interesting_step(self) -> int:
        """Where the eye should land: contact, else where the signal is least."""
        contact = self.contact_step
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
    sampled = (detection_probability(table[name], detected) for name in ("log_p", "log_q"))
    verdict = "violates" if entry.violated else "does not violate"
    others = (signal for signal in simulator.signals if signal != run.charted)
    return Track(
        title=f"Rank {entry.rank}: robustness {number(entry.robustness)}, {verdict}, "
        f"{entry.misses} misses, stage {entry.stage}, rollout {entry.rollout}",
        drawn=drawn,
        charted=run.charted,
        charted_words=_charted_words(run),
        signals={signal: signals[signal.name] for signal in (run.charted, *others)},
        limits={signal: _limits(run.config, signal) for signal in simulator.signals},
        slots=slots_of(simulator) or (WHOLE,),
        answers=slot_answers(simulator, signals=signals, detected=detected),
        dt_s=simulator.dt_s,
        detection=np.stack(list(sampled)) if detected.ndim == 1 else None,
        observed=run.result.is_of_detector_itself,
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


def step_words(chosen: Track, step: int) -> str:
    """What perception errs about at a step."""
    if chosen.contact_step is not None and step >= chosen.contact_step:
        return "after contact"
    if step >= len(chosen.answers):
        return "end"
    if chosen.detection is not None:
        return answer_words(chosen.slots[0], int(chosen.answers[step, 0]))
    wrong = [
        f"{slot.name} {answer_words(slot, WRONG)}"
        for slot, answer in zip(chosen.slots, chosen.answers[step], strict=True)
        if answer == WRONG
    ]
    return ", ".join(wrong) or "no error"


def stage_charts(chosen: Track, *, width: int, height: int) -> tuple[PlaneChart, ...]:
    """Each signal against time, in the place of a scene of this size, if there is none."""
    if chosen.drawn is not None:
        return ()
    each = max(height // len(chosen.signals), LOWEST)
    return tuple(
        replace(signal_chart(chosen, signal, width=width), height=each) for signal in chosen.signals
    )


def track_charts(chosen: Track, *, width: int) -> tuple[PlaneChart, ...]:
    """What else is drawn against time: the charted signal and speeds beside a scene; perception."""
    perception = _answers_chart if chosen.detection is None else _detection_chart
    charts = [perception(chosen, width=width)]
    if chosen.drawn is not None:
        speeds = _speed_chart(chosen, chosen.drawn, width=width)
        charts = [signal_chart(chosen, chosen.charted, width=width), speeds, *charts]
    return tuple(charts)


def signal_chart(chosen: Track, signal: Signal, *, width: int) -> PlaneChart:
    """A signal, what it is compared with, and where perception errs."""
    values, limits = chosen.signals[signal], chosen.limits[signal]
    missed = np.flatnonzero(chosen.missed)
    low, high = (float(end([*values, *limits])) for end in (np.min, np.max))
    margin = 0.08 * (high - low) or 1.0
    rules = (
        Rule(limit, f"{limit:g} {signal.unit}".strip() + ": limit", VERMILLION, SOLID,
            upright=False, label_at="start")
        for limit in limits
    )  # fmt: skip
    name = signal_name(signal)
    return PlaneChart(
        chosen.charted_words if signal == chosen.charted else name.capitalize(),
        x=_time_axis(chosen),
        y=Axis(low - margin, high + margin, signal_label(signal)),
        marks=(
            *rules,
            Line(chosen.time_s, values, BLUE, width=2.2, name=name),
            Points(chosen.time_s[missed], values[missed], MISSED, radius=2.6, name="missed"),
            *_contact(chosen, "contact"),
        ),
        width=width,
        height=HEIGHT,
    )


def _speed_chart(chosen: Track, drawn: DrawnRollout, *, width: int) -> PlaneChart:
    fastest = max(float(np.max(drawn.states.speed_mps, initial=0.0)), 1.0)
    lines = [
        Line(
            chosen.time_s,
            np.where(drawn.states.present[:, car], drawn.states.speed_mps[:, car], np.nan),
            car_color(car), _short(shape.name), width=2.2, dash="6 3" if car else "",
        )
        for car, shape in enumerate(drawn.cars)
    ]  # fmt: skip
    impact_mps = drawn.impact_speed_mps
    words = "" if impact_mps is None else f"{impact_mps:.1f} m/s impact"
    return PlaneChart(
        "Speeds",
        x=_time_axis(chosen),
        y=Axis(0.0, fastest * AS_LARGE, "speed [m/s]"),
        marks=(*lines, *_contact(chosen, words)),
        width=width,
        height=HEIGHT,
    )


def _answers_chart(chosen: Track, *, width: int) -> PlaneChart:
    """A row for each slot: strokes at errors, lower ones where there is none, none if absent."""
    names = [
        _short(slot.name) if np.any(chosen.answers[:, place]) else
        f"{_short(slot.name)}: {answer_words(slot, NOT_EVALUATED)}"
        for place, slot in enumerate(chosen.slots)
    ]  # fmt: skip
    strokes: list[Mark] = []
    for answer, color, label, part in (
        (RIGHT, DETECTED, "no error", 0.35), (WRONG, MISSED, "error", 1.0),
    ):  # fmt: skip
        step, slot = np.nonzero(chosen.answers == answer)
        reach = part * SLOT_REACH
        at = chosen.time_s[step] + chosen.dt_s / 2
        strokes.append(
            Strokes(at, slot.astype(np.float64) + 1.0, color, label, above=reach, below=reach)
        )
    places = tuple(float(place) for place in range(1, len(names) + 1))
    return PlaneChart(
        "Perception",
        x=_time_axis(chosen),
        y=Axis(len(names) + 0.5, 0.5, "", ticks=places, words=tuple(names)),
        marks=(*strokes, *_contact(chosen)),
        width=width,
        height=HEIGHT,
    )


def _detection_chart(chosen: Track, *, width: int) -> PlaneChart:
    """P(detected) of the error model and of the proposal; above and below, what came of it.

    That alone where it was observed.
    """
    assert chosen.detection is not None  # noqa: S101  asked for with it alone
    pem, proposal = chosen.detection
    steps_s, answers = chosen.time_s[:-1], chosen.answers[:, 0]
    hits_s, misses_s = steps_s[answers == RIGHT], steps_s[answers == WRONG]
    reach = OUTCOME_REACH
    lines = (
        Line(steps_s, proposal, PROPOSAL, "proposal", dash="5 2"),
        Line(steps_s, pem, PEM, "error model"),
    )
    label, ticks = ("", ()) if chosen.observed else ("P(detected)", (0.0, 0.5, 1.0))
    return PlaneChart(
        "Perception",
        x=_time_axis(chosen),
        y=Axis(-reach - 0.02, 1.02 + reach, label, ticks=ticks),
        marks=(
            Strokes(hits_s, np.ones(hits_s.size), DETECTED, "detected", above=reach),
            Strokes(misses_s, np.zeros(misses_s.size), MISSED, "missed", below=reach),
            *(() if chosen.observed else lines),
            *_contact(chosen),
        ),
        width=width,
        height=HEIGHT,
    )


def _time_axis(chosen: Track) -> Axis:
    return Axis(0.0, max(float(chosen.time_s[-1]), chosen.dt_s), "time [s]")


def _contact(chosen: Track, words: str = "") -> tuple[Veil, ...]:
    """What comes after contact is faint."""
    step = chosen.contact_step
    return () if step is None else (Veil(step * chosen.dt_s, words),)


def _short(name: str) -> str:
    cut = f"{name[: NAME_CHARACTERS - 1]}\N{HORIZONTAL ELLIPSIS}"
    return name if len(name) <= NAME_CHARACTERS else cut
