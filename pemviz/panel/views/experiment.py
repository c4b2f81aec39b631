"""Texts of the Experiment tab."""

from pemviz.config import ScenarioConfig
from pemviz.panel.views.words import block, good, quiet, warning


def scenario_text(scenario: ScenarioConfig) -> str:
    """The scenario in a sentence."""
    end_s = (scenario.states - 1) * scenario.dt_s
    return block(
        quiet(
            f"Scenario: both cars drive {scenario.initial_speed_kmh:g} km/h, "
            f"{scenario.initial_gap_m:g} m apart, when the lead car brakes at "
            f"{scenario.lead_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. A detection below "
            f"{scenario.emergency_gap_m:g} m makes the ego brake at "
            f"{scenario.emergency_deceleration_mps2:g} m/s\N{SUPERSCRIPT TWO}. "
            f"{scenario.states} states, {scenario.dt_s:g} s apart ({end_s:.2f} s)."
        )
    )


def spec_verdict(complaint: str | None, *, spec: str) -> str:
    """What the parser says of a specification; the text itself is not repeated."""
    if complaint is None:
        return block(good("The specification is understood."))
    message = complaint.removeprefix(f"spec = {spec!r}: ")
    return block(f"<div role='alert'>{warning(message)}</div>")
