"""What is simulated, in words."""

from html import escape
from pathlib import Path

from pemviz.config import ExperimentConfig
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, start_values
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.panel.views.elements import block, grid, quiet

WORDS = {
    "braking": "a lead car brakes",
    "cut-in": "a car cuts in ahead of the ego",
    "cut-out": "a lead car leaves the lane and reveals a slower one",
}


def scenario_text(config: ExperimentConfig) -> str:
    """The scenario in a sentence."""
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        return encounter_text(config)
    scenario, errors = config.scenario, config.position_errors
    end_s = (scenario.states - 1) * scenario.dt_s
    measured = "" if errors is None else f", measured with errors of {Path(errors).name},"
    follows = "" if scenario.tracker == NO_TRACKER else f", by a tracker ({scenario.tracker}),"
    return block(
        quiet(
            f"Scenario: both cars drive {scenario.initial_speed_kmh:g} km/h, "
            f"{scenario.initial_gap_m:g} m apart, when the lead car brakes at "
            f"{scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. "
            f"A detection{follows} below {scenario.emergency_gap_m:g} m{measured} makes the ego "
            f"brake at {scenario.emergency_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. "
            f"{scenario.states} states, {scenario.dt_s:g} s apart ({end_s:.2f} s)."
        )
    )


def encounter_text(config: ExperimentConfig) -> str:
    """The logical scenario in a sentence, and what is drawn for each encounter."""
    encounter, chosen = config.encounter, {one.name: one.distribution for one in config.start}
    tracker = config.scenario.tracker
    tracked = "" if tracker == NO_TRACKER else f" It acts on a tracker ({tracker})."
    end_s = (encounter.states - 1) * encounter.dt_s
    lines = [
        [
            value.name.replace("_", " "),
            escape(chosen.get(value.name, value.distribution)),
            value.unit,
        ]
        for value in start_values(encounter)
    ]
    return block(
        quiet(
            f"Logical scenario {encounter.logical_scenario}: "
            f"{WORDS[encounter.logical_scenario]}. The ego "
            "keeps its speed and a gap, and brakes hard at "
            f"{encounter.hard_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO} when the time to "
            f"collision is too small.{tracked} {encounter.states} states, {encounter.dt_s:g} s "
            f"apart ({end_s:.1f} s). Drawn for each encounter:"
        )
        + grid(["start value", "distribution", ""], lines, name="Start values")
    )
