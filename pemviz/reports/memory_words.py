"""How misses hang together: what the answer assumes of it, and what the assumption is worth.

A curve leads along one of two axes: :data:`BY_MEMORY_TIME`, :data:`BY_FRAILTY`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pemviz.pem.models.memory import FRAILTY_MEANS
from pemviz.pem.models.predictive_check import check_line
from pemviz.reports.document import Table
from pemviz.reports.estimate_words import end_text, range_text
from pemviz.runs.result import RunMemory, RunResult
from pemviz.runs.uncertainty import memory_option, visibility_option
from pemviz.sampling.bursts.curve import (
    ALIKE_S,
    MEASURED,
    MEASURED_FRAILTY,
    CurvePoint,
    measured_s,
)

MEMORY_TITLE = "Misses that follow each other"
OF_DETECTOR_ITSELF = "as the detector itself said of the rendered images, without an error model"
IN_IT = "(in which the correlation of outcomes falls to 37 %)"
"""What a memory time is, in brackets beside one."""
MEASURED_FOR = "measured on video of cars for"
MEASURED_TITLE = "With a memory of misses as measured on video"
TWO_TIMES = ", ".join(
    f"{time:g} in place of {MEASURED[one].tau_s:g} s" for one, time in ALIKE_S.items()
)
FITTED_TOGETHER = (
    "Memory time and frailty were fitted together. Where all objects are taken as equal a memory "
    f"time is longer ({TWO_TIMES}): then it stands for both."
)
ALL_EQUAL = f"all objects taken as equal; {TWO_TIMES} beside a frailty"
"""Why a time that was measured is another one here than in the answer."""
SAME = 0.01
"""What differs by less from the error model's own measured place is that of the same detector."""


@dataclass(frozen=True)
class CurveAxis:
    """What a curve leads along: its name, what 0 means, the unit after a number.

    Attributes:
        note: What stands beneath the curve and its table.
        shown: Of its places those that a small table shows beside the measured ones.
        measured: Places measured on video of two detectors, by name.
        own: The answer's own place.
        fitted: The error model's own place, measured on video; ``None`` if it has none.
    """

    head: str
    none: str
    unit: str
    title: str
    note: str
    shown: tuple[float, ...]
    measured: Callable[[RunMemory], Mapping[str, float]]
    place: Callable[[CurvePoint], float]
    points: Callable[[RunMemory], tuple[CurvePoint, ...]]
    own: Callable[[RunMemory], float]
    fitted: Callable[[RunMemory], float | None]


BY_MEMORY_TIME = CurveAxis(
    head="memory time",
    none="independent",
    unit=" s",
    title="If misses come in bursts, by memory time",
    note="Memory time: in it the correlation of one outcome with a later one falls to 37 %. The "
    "longer, the longer bursts of misses; how often it misses is about as before. Where the "
    f"frailty is 0, those measured on video are for objects that are all equal: {TWO_TIMES}, as "
    "fitted beside a frailty.",
    shown=(0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
    measured=lambda memory: measured_s(memory.frailty),
    place=lambda point: point.tau_s,
    points=lambda memory: memory.curve,
    own=lambda memory: memory.tau_s,
    fitted=lambda memory: None if memory.fitted is None else memory.fitted.tau_s,
)
BY_FRAILTY = CurveAxis(
    head="frailty",
    none="all equal",
    unit="",
    title="If some objects are harder to see all along, by frailty",
    note="Frailty: how much objects differ in being missed beyond what the state explains, each "
    "all along; how often it misses is as before. On video it was fitted beside a memory time.",
    shown=(0.0, 0.1, 0.2, 0.3, 0.5, 1.0),
    measured=lambda _: MEASURED_FRAILTY,
    place=lambda point: point.frailty,
    points=lambda memory: memory.frailty_curve,
    own=lambda memory: memory.frailty,
    fitted=lambda memory: None if memory.fitted is None else memory.fitted.frailty,
)
CURVE_AXES = (BY_MEMORY_TIME, BY_FRAILTY)


def curve_table(memory: RunMemory, axis: CurveAxis) -> Table | None:
    """A small table of a curve; ``None`` without one.

    The head of the intervals claims no level that not all of them have.
    """
    names = measured_names(memory, axis)
    shown = {*axis.shown, *names, axis.own(memory)}
    points = [point for point in axis.points(memory) if axis.place(point) in shown]
    rows: list[tuple[str, ...]] = []
    for point in points:
        place = axis.place(point)
        named = axis.none if place == 0.0 else f"{place:.3g}{axis.unit}"
        interval = "no violation was seen"
        if point.low is not None and point.high is not None:
            interval = f"{end_text(point.low)} to {end_text(point.high)}"
            if point.caveats:
                interval += f": not a 95 % interval, {point.caveats[0]}"
        rows.append((named, end_text(point.probability), interval, names.get(place, "")))
    level = "" if any(point.caveats for point in points) else "95 % "
    columns = (axis.head, "probability", f"{level}interval", MEASURED_FOR)
    table = Table(columns, tuple(rows), name=axis.title, note=axis.note, numbers=(0, 1))
    return table if rows else None


def measured_table(memory: RunMemory) -> Table | None:
    """The answer with memories that were measured on video; ``None`` without any."""
    rows: list[tuple[str, ...]] = []
    for one in memory.measured:
        point = one.point
        interval = range_text(point.low, point.high)
        if point.caveats:
            interval += f": not a 95 % interval, {point.caveats[0]}"
        place = (f"{point.tau_s:.2g} s", f"{point.frailty:.2g}")
        rows.append((one.name, *place, end_text(point.probability), interval))
    columns = (MEASURED_FOR, "memory time", "frailty", "probability", "interval")
    table = Table(
        columns, tuple(rows), name=MEASURED_TITLE, note=FITTED_TOGETHER, numbers=(1, 2, 3)
    )
    return table if rows else None


def measured_names(memory: RunMemory, axis: CurveAxis) -> dict[float, str]:
    """Places of an axis that were measured on video, and whose they are."""
    own = axis.fitted(memory)
    names = {} if own is None else {own: "this error model"}
    for name, place in axis.measured(memory).items():
        if own is None or abs(place - own) > SAME * own:
            names[place] = name
    return names


def assumption_lines(memory: RunMemory | None) -> list[str]:
    """What the answer's assumptions on how misses hang together are worth; empty without curves."""
    lines = (assumption_line(memory), frailty_line(memory))
    return [line for line in lines if line is not None]


def assumption_line(memory: RunMemory | None) -> str | None:
    """What the answer's assumption on bursts is worth; ``None`` without a curve."""
    if memory is None or not memory.curve:
        return None
    points = _by_place(memory, BY_MEMORY_TIME)
    here, others = points[memory.tau_s], _elsewhere(memory, BY_MEMORY_TIME)
    names = measured_names(memory, BY_MEMORY_TIME)
    if memory.tau_s == 0.0:
        given = "the state" if memory.frailty == 0.0 else "the state and the object"
        assumed = f"That misses are independent given {given} is an assumption"
        if memory.fitted is None:
            assumed += ": this error model says nothing of it, and single frames cannot tell"
        others.insert(0, f"{here.probability:.1g} without memory")
    else:
        assumed = f"A memory time of {memory.tau_s:.3g} s is an assumption"
        others.insert(0, f"{points[0.0].probability:.1g} if misses were independent")
    alike = memory.frailty == 0.0 and set(measured_s(0.0)) & set(names.values())
    note = f" ({ALL_EQUAL})" if alike else ""
    worth = _worth(memory, BY_MEMORY_TIME)
    return f"{assumed}. The failure probability is {', '.join(others)}{note}.{worth}"


def frailty_line(memory: RunMemory | None) -> str | None:
    """What the answer's assumption on how obstacles differ is worth; ``None`` without a curve."""
    if memory is None or not memory.frailty_curve:
        return None
    equal = _by_place(memory, BY_FRAILTY)[0.0].probability
    assumed = f"a frailty of {memory.frailty:.3g}: {equal:.1g} if objects are equal (0)"
    if memory.frailty == 0.0:
        assumed = f"that objects in the same state are equal (frailty 0): {equal:.1g} if they are"
    assumptions = ", ".join([assumed, *_elsewhere(memory, BY_FRAILTY)])
    return f"So is {assumptions}.{_worth(memory, BY_FRAILTY)}"


def check_lines(memory: RunMemory | None) -> list[str]:
    """What predictive checks found of the error model with this memory; empty without any."""
    if memory is None or memory.check is None:
        return []
    line = check_line(memory.check)
    return [f"{line[0].upper()}{line[1:]}."]


def _by_place(memory: RunMemory, axis: CurveAxis) -> dict[float, CurvePoint]:
    return {axis.place(point): point for point in axis.points(memory)}


def _elsewhere(memory: RunMemory, axis: CurveAxis) -> list[str]:
    points, own = _by_place(memory, axis), axis.own(memory)
    return [
        f"{points[place].probability:.1g} with that of {name} ({place:.2g}{axis.unit})"
        for place, name in sorted(measured_names(memory, axis).items())
        if place in points and place != own
    ]


def _worth(memory: RunMemory, axis: CurveAxis) -> str:
    """How many orders of magnitude lie between 0 and what was measured."""
    points = _by_place(memory, axis)
    none = points[0.0].probability
    reached = [points[p].probability for p in measured_names(memory, axis) if p in points]
    if none <= 0.0 or not reached or max(reached) <= none:
        return ""
    orders = math.log10(max(reached) / none)
    if orders < 1.0:
        return ""
    return f" The assumption changes the answer by {orders:.0f} orders of magnitude."


def not_looked_at(result: RunResult) -> str:
    """That a run says nothing of other memories, and what does."""
    return (
        "How far the assumption on how misses follow each other changes the answer was not looked "
        f"at in this run: {memory_option(result)} does. "
        "Detectors that were measured on video missed in bursts."
    )


def memory_text(result: RunResult) -> str:
    """How misses hang together in the answer, and in the video that the model was fitted to."""
    memory = result.memory
    if result.is_of_detector_itself:
        return OF_DETECTOR_ITSELF
    if memory is None or memory.is_independent:
        assumed = "independent of each other given the state: an assumption"
        if memory is None or not (memory.curve or memory.measured):
            assumed += f", and {memory_option(result)} shows what it changes"
    else:
        parts = [f"memory time {memory.tau_s:.3g} s {IN_IT}"] if memory.tau_s else []
        parts += [f"frailty {memory.frailty:.3g} ({FRAILTY_MEANS})"] if memory.frailty else []
        how = "hanging together by" if memory.hidden else "in bursts,"
        assumed = f"{how} {' and '.join([*parts, *memory.hidden])}"
    own = None if memory is None else memory.fitted
    other = ""
    if memory is not None and memory.left_out:
        other = f"; its other law, {memory.left_out}, is left out"
        if option := visibility_option(result):
            other += f": {option} has it"
    if memory is None or own is None:
        return f"{assumed}{other}"
    measured = f"{own.tau_s:.2g} s ({own.low_s:.2g} to {own.high_s:.2g})"
    if own.frailty is not None:
        measured += f", frailty {own.frailty:.2g}"
        if own.frailty_low is not None and own.frailty_high is not None:
            measured += f" ({own.frailty_low:.2g} to {own.frailty_high:.2g})"
    if memory.is_own_visibility:
        return f"{assumed}: the error model's own, measured on video; by its other law {measured}"
    if memory.is_own:
        return f"{assumed}: the error model's own, measured on video: {measured}{other}"
    return f"{assumed}; not the error model's own, which was measured on video: {measured}{other}"
