"""One rollout against time, with a cursor in step with the scene."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.charts.plot import Axis, Plot, svg, text
from pemviz.colors import BLUE, DETECTED, EGO, GREY, LEAD, MISSED, PEM, PROPOSAL, VERMILLION
from pemviz.config import ScenarioConfig
from pemviz.panel.ranking import RankedRow
from pemviz.panel.run_data import RunData, detection_probability
from pemviz.panel.views.elements import number
from pemviz.panel.views.page import PLOTS, SPEEDS
from pemviz.simulators.braking.contact import (
    CAMERA_TO_BUMPER_M,
    Contact,
    contact_text,
    first_contact,
)
from pemviz.simulators.braking.scenario import GAP, scenario_signals

PLOT_WIDTH, HEIGHT = 300, 190
CURSOR = "#111827"


@dataclass(frozen=True, eq=False)
class Track:
    """One rollout.

    Attributes:
        title: What it is, in words.
        scenario: The scenario that it ran in.
        gap_m: ``[T]``.
        ego_speed_mps: ``[T]``.
        lead_speed_mps: ``[T]``.
        detected: ``[T-1]`` perception's outcomes.
        pem_detection: ``[T-1]`` P(detected) under the error model.
        proposal_detection: ``[T-1]`` P(detected) under the proposal sampled from.
        violated: The verdict on the whole rollout.
        contact: Where the cars touch, if they do.
    """

    title: str
    scenario: ScenarioConfig
    gap_m: FloatArray
    ego_speed_mps: FloatArray
    lead_speed_mps: FloatArray
    detected: BoolArray
    pem_detection: FloatArray
    proposal_detection: FloatArray
    violated: bool
    contact: Contact | None = None

    @property
    def states(self) -> int:
        """Number of states T."""
        return int(self.gap_m.size)

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.scenario.dt_s

    @property
    def time_s(self) -> FloatArray:
        """Times ``[T]`` [s]."""
        return np.arange(self.states, dtype=np.float64) * self.scenario.dt_s


def track(run: RunData, entry: RankedRow) -> Track:
    """The rollout of a row of the ranking."""
    keys = {signal.name: signal.key for signal in scenario_signals(run.config.scenario)}
    table = run.steps([*keys.values(), "detected", "log_p", "log_q"], entry.index)
    signals = {name: np.asarray(table[key][0], dtype=np.float64) for name, key in keys.items()}
    detected = np.asarray(table["detected"][0], dtype=np.bool_)
    return Track(
        title=row_title(entry),
        scenario=run.config.scenario,
        gap_m=signals["gap"],
        ego_speed_mps=signals["ego_speed"],
        lead_speed_mps=signals["lead_speed"],
        detected=detected,
        pem_detection=detection_probability(table["log_p"][0], detected),
        proposal_detection=detection_probability(table["log_q"][0], detected),
        violated=entry.violated,
        contact=first_contact(signals[GAP], dt_s=run.config.scenario.dt_s),
    )


def row_title(entry: RankedRow) -> str:
    """A rollout in words."""
    verdict = "violates" if entry.violated else "does not violate"
    return (
        f"Rank {entry.rank}: robustness {number(entry.robustness)}, {verdict}, "
        f"{entry.misses} misses, stage {entry.stage}, rollout {entry.rollout}"
    )


def track_plots(chosen: Track) -> tuple[str, ...]:
    """The plots, each without its end, where :func:`with_cursor` puts a cursor."""
    names = (chosen.title, "Speeds", "Perception")
    return tuple(
        svg(plot.group() + "@@", width=PLOT_WIDTH, height=HEIGHT, title=name).split("@@")[0]
        for plot, name in zip(_plots(chosen), names, strict=True)
    )


def with_cursor(plots: Sequence[str], chosen: Track, step: int, *, speed: float) -> str:
    """The plots side by side with a cursor at a step, and the values there."""
    shown: list[str] = []
    values = _values(chosen, step, speed=speed)
    for place, (drawn, plot) in enumerate(zip(plots, _plots_axes(chosen), strict=True)):
        x = plot.px(float(chosen.time_s[step]))
        line = f"<path d='M{x:.1f} {plot.top}V{plot.bottom}' stroke='{CURSOR}' stroke-width='1.4'/>"
        words = text(values[place], plot.right, plot.top - 9, anchor="end", color=CURSOR)
        named = "" if place else f" data-cursor='{step}'"
        shown.append(f"{drawn}<g{named}>{line}{words}</g></svg>")
    gap, speeds, perception = shown
    middle = speeds.replace("<svg ", f"<svg class='{SPEEDS}' ", 1)
    return f"<div class='{PLOTS}'>{gap}{middle}{perception}</div>"


def _values(chosen: Track, step: int, *, speed: float) -> tuple[str, str, str]:
    time_s = chosen.time_s[step]
    outcome = "end"
    if step < chosen.detected.size:
        outcome = "detected" if chosen.detected[step] else "MISSED"
    if chosen.contact is not None and step >= chosen.contact.step:
        return (contact_text(chosen.contact), "after contact", f"played at {speed:g}x")
    return (
        f"{chosen.gap_m[step]:.2f} m at {time_s:.2f} s",
        f"ego {chosen.ego_speed_mps[step]:.1f}, lead {chosen.lead_speed_mps[step]:.1f}",
        f"{outcome}; played at {speed:g}x",
    )


def _plots_axes(chosen: Track) -> tuple[Plot, Plot, Plot]:
    end_s = float(chosen.time_s[-1])
    low = min(-1.0, float(np.min(chosen.gap_m)) - 0.5)
    high = max(float(np.max(chosen.gap_m)), chosen.scenario.emergency_gap_m) * 1.05
    fastest = 3.6 * max(float(np.max(chosen.ego_speed_mps)), float(np.max(chosen.lead_speed_mps)))
    time = Axis(0.0, end_s, "time [s]")
    size = {"width": PLOT_WIDTH, "height": HEIGHT, "left": 42, "right": 8, "top": 22}
    return (
        Plot(title="Gap", x=time, y=Axis(low, high, "gap [m]"), **size),
        Plot(title="Speeds", x=time, y=Axis(0.0, fastest / 3.6 * 1.08, "speed [m/s]"), **size),
        Plot(title="Perception", x=time, y=Axis(-0.22, 1.04, "P(detected)",
             ticks=(0.0, 0.5, 1.0)), **size),
    )  # fmt: skip


def _plots(chosen: Track) -> tuple[Plot, Plot, Plot]:
    gap, speed, perception = _plots_axes(chosen)
    time_s, steps_s = chosen.time_s, chosen.time_s[:-1]
    edge_m = chosen.scenario.emergency_gap_m
    gap.band(gap.y.low, CAMERA_TO_BUMPER_M, color=VERMILLION, opacity=0.10)
    gap.hline(
        CAMERA_TO_BUMPER_M,
        color=VERMILLION,
        label=f"{CAMERA_TO_BUMPER_M:g} m: bumpers touch",
        dash="",
        at_left=True,
    )
    gap.hline(edge_m, color=GREY, label=f"{edge_m:g} m: emergency braking")
    gap.line(time_s, chosen.gap_m, color=BLUE, width=2.2)
    speed.line(time_s, chosen.ego_speed_mps, color=EGO, width=2.2)
    speed.line(time_s, chosen.lead_speed_mps, color=LEAD, width=2.2, dash="6 3")
    speed.legend([("ego", EGO, ""), ("lead", LEAD, "6 3")], x=speed.left + 8, y=speed.bottom - 20)
    perception.line(steps_s, chosen.proposal_detection, color=PROPOSAL, width=1.8, dash="5 2")
    perception.line(steps_s, chosen.pem_detection, color=PEM, width=1.8)
    perception.legend(
        [("error model", PEM, ""), ("proposal", PROPOSAL, "5 2")],
        x=perception.right - 92,
        y=perception.py(0.5) - 4,
    )
    hit, miss = steps_s[chosen.detected], steps_s[~chosen.detected]
    base = perception.bottom
    perception.ticks_at(hit, y_px=(base - 9, base - 1), color=DETECTED)
    perception.ticks_at(miss, y_px=(base - 21, base - 12), color=MISSED)
    for label, y in (("hit", base - 2), ("miss", base - 13)):
        perception.note(label, perception.left - 4, y, anchor="end")
    if chosen.contact is not None:
        gap.veil(chosen.contact.time_s, label="contact")
        speed.veil(chosen.contact.time_s, label=f"{chosen.contact.impact_speed_mps:.1f} m/s impact")
        perception.veil(chosen.contact.time_s)
    return gap, speed, perception
