"""Controls of a logical scenario: what there is to choose of it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import viser

from pemviz.config import ExperimentConfig, StartChoice
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, EncounterConfig
from pemviz.config.rule_words import read_starts
from pemviz.panel.fields import field_docs
from pemviz.runs.back_ends import build_back_end, check_method_fits
from pemviz.runs.experiment import build_simulator
from pemviz.simulators.registry import build_encounter_simulator
from pemviz.types import Simulator

SIDES = ("left", "right")
DRAWN_BACK_END = "vectorized"
STARTS_HINT = (
    "Start values with other distributions than those below, a line NAME = DISTRIBUTION each: a "
    "number, which fixes it, normal(mean, sd), lognormal(median, spread), uniform(low, high), and "
    "'in [low, high]' behind one to cut it. Empty: all as below."
)


class EncounterControls:
    """Shown while the settings are those of a logical scenario."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[Any], None]) -> None:
        """Add the controls.

        Args:
            gui: Where.
            changed: Called when a person has changed one.
        """
        docs = field_docs(EncounterConfig)
        self._base = EncounterConfig()
        self.side = gui.add_dropdown("Side", SIDES, hint=docs["side"])
        self.neighbour = gui.add_checkbox("Neighbour", False, hint=docs["neighbour"])
        self.starts = gui.add_text("Start values", "", multiline=True, hint=STARTS_HINT)
        for control in (self.side, self.neighbour, self.starts):
            control.on_update(changed)

    @property
    def chosen(self) -> bool:
        """Whether there is a logical scenario."""
        return self._base.logical_scenario != NO_LOGICAL_SCENARIO

    def fill(self, config: ExperimentConfig) -> None:
        """Show what a configuration says."""
        self._base = config.encounter
        self.side.value, self.neighbour.value = self._base.side, self._base.neighbour
        self.starts.value = "\n".join(f"{one.name} = {one.distribution}" for one in config.start)
        for control in (self.side, self.neighbour, self.starts):
            if control.visible != self.chosen:
                control.visible = self.chosen

    def into(self, config: ExperimentConfig) -> ExperimentConfig:
        """A configuration with what the controls say.

        Raises:
            InputError: A line is no start value with a distribution.
        """
        if not self.chosen:
            return config
        lines = [line for line in self.starts.value.splitlines() if line.strip()]
        start = tuple(StartChoice(*choice) for choice in read_starts(lines).items())
        side = cast(Any, self.side.value)
        encounter = replace(self._base, side=side, neighbour=self.neighbour.value)
        return replace(config, encounter=encounter, start=start)


def asked_simulator(config: ExperimentConfig) -> Simulator:
    """The scenario whose signals a specification is about."""
    plain = replace(config, rules=(), simulator=DRAWN_BACK_END)
    if config.encounter.logical_scenario == NO_LOGICAL_SCENARIO:
        return build_simulator(plain)
    return cast(Simulator, build_encounter_simulator(plain))


def check_encounter(config: ExperimentConfig) -> None:
    """Refuse what cannot be had of a logical scenario.

    Raises:
        InputError: The line says what.
    """
    if config.encounter.logical_scenario != NO_LOGICAL_SCENARIO:
        check_method_fits(config, build_back_end(config))
