"""The failure probability over memory times, in words and rows, the same in every view."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pemviz.reports.digits import end_text
from pemviz.runs.memory import RunMemory
from pemviz.sampling.bursts.curve import MEASURED_S, CurvePoint

SHOWN_S = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of the curve's memory times, those that a small table shows beside the measured ones [s]."""


CURVE_NOTE = (
    "Memory time: in it the correlation of one outcome with a later one falls to 37 %. The longer, "
    "the longer bursts of misses; how often it misses is about as before."
)
"""What stands beneath the curve and its table."""


@dataclass(frozen=True)
class CurveRow:
    """One memory time in words.

    Attributes:
        tau: The memory time.
        probability: The failure probability.
        interval: Its interval, and why that is no 95 % interval where it is none.
        measured: Whose memory time it is; empty where nobody's.
    """

    tau: str
    probability: str
    interval: str
    measured: str


def curve_columns(memory: RunMemory) -> tuple[str, str, str, str]:
    """Heads of the small table: the interval's claims no level that not all of them have."""
    level = "" if any(point.caveats for point in _shown(memory)) else "95 % "
    return ("memory time", "probability", f"{level}interval", "measured on video for")


def curve_rows(memory: RunMemory) -> list[CurveRow]:
    """A small table of the curve; empty without one."""
    names = measured_names(memory)
    return [
        CurveRow(
            tau="independent" if point.tau_s == 0.0 else f"{point.tau_s:.3g} s",
            probability=end_text(point.probability),
            interval=_interval(point),
            measured=names.get(point.tau_s, ""),
        )
        for point in _shown(memory)
    ]


def _shown(memory: RunMemory) -> Sequence[CurvePoint]:
    shown = {*SHOWN_S, *measured_names(memory), memory.tau_s}
    return [point for point in memory.curve if point.tau_s in shown]


def measured_names(memory: RunMemory) -> dict[float, str]:
    """Memory times measured on video [s], and whose they are."""
    names = {tau_s: name for name, tau_s in MEASURED_S.items()}
    if memory.fitted is not None:
        names[memory.fitted.tau_s] = "this error model"
    return names


def assumption_line(memory: RunMemory | None) -> str | None:
    """What the answer's assumption on bursts is worth; ``None`` without a curve."""
    if memory is None or not memory.curve:
        return None
    points = {point.tau_s: point for point in memory.curve}
    here = points[memory.tau_s]
    others = [
        f"{points[tau_s].probability:.1g} with that of {name} ({tau_s:.2g} s)"
        for tau_s, name in sorted(measured_names(memory).items())
        if tau_s in points and tau_s != memory.tau_s
    ]
    if memory.tau_s == 0.0:
        assumed = "That misses are independent given the state is an assumption"
        if memory.fitted is None:
            assumed += ": this error model was fitted to single frames, which cannot tell"
        others.insert(0, f"{here.probability:.1g} without memory")
    else:
        assumed = f"A memory time of {memory.tau_s:g} s is an assumption"
        others.insert(0, f"{points[0.0].probability:.1g} if misses were independent")
    return f"{assumed}. The failure probability is {', '.join(others)}.{_worth(points, memory)}"


def assumption_worth(memory: RunMemory | None) -> str:
    """The assumption and what it is worth, in one short sentence; empty without a curve."""
    if memory is None or not memory.curve:
        return ""
    words = "Misses are taken as independent given the state."
    if memory.tau_s > 0.0:
        words = f"A memory time of {memory.tau_s:g} s is an assumption."
    return words + _worth({point.tau_s: point for point in memory.curve}, memory)


def _worth(points: dict[float, CurvePoint], memory: RunMemory) -> str:
    """How many orders of magnitude lie between independence and a detector's memory."""
    independent = points[0.0].probability
    reached = [points[t].probability for t in measured_names(memory) if t in points]
    if independent <= 0.0 or not reached or max(reached) <= independent:
        return ""
    orders = math.log10(max(reached) / independent)
    return f" The assumption is worth {orders:.0f} orders of magnitude." if orders >= 1.0 else ""


def _interval(point: CurvePoint) -> str:
    if point.low is None or point.high is None:
        return "no violation was seen"
    words = f"{end_text(point.low)} to {end_text(point.high)}"
    return f"{words}: not a 95 % interval, {point.caveats[0]}" if point.caveats else words
