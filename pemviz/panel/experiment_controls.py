"""Controls of a logical scenario, of trackers and of position errors; hints for all controls."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast, get_args, get_type_hints

import viser

from pemviz.config import SHIPPED_SIMULATORS, ExperimentConfig, ScenarioConfig, StartChoice
from pemviz.config.encounters import NO_LOGICAL_SCENARIO, EncounterConfig
from pemviz.config.ranges import Range, field_docs
from pemviz.config.rule_words import read_starts
from pemviz.config.tracker_text import (
    NO_TRACKER,
    FilterName,
    TrackerSettings,
    read_tracker,
    tracker_options,
)
from pemviz.errors import ConfigError
from pemviz.pem import shipped_position_errors
from pemviz.runs.back_ends import build_back_end, check_method_fits
from pemviz.simulators.registry import build_encounter_simulator, build_named_simulator
from pemviz.types import Simulator

SIDES = ("left", "right")
DRAWN_BACK_END = "vectorized"
STARTS_HINT = (
    "Start values with other distributions than those below, a line NAME = DISTRIBUTION each: a "
    "number, which fixes it, normal(mean, sd), lognormal(median, spread), uniform(low, high), and "
    "'in [low, high]' behind one to cut it. Empty: all as below."
)
FOLDER = "Tracker and position errors"
NONE, COUNTED, FROM_FILE = "none", "M/N", "a file"
FIRST = TrackerSettings(hits=2, window=3, coast=0.5)
"""What the controls hold before a tracker is chosen."""
COAST_STEP_S = 0.05
HITS_HINT = "M: detections among the last N outcomes that make the lead car tracked."
WINDOW_HINT = "N: outcomes over which detections are counted."
COAST_HINT = "How long a tracked car stays so without a detection [s]."
FILTER_HINT = "Of the gap and its change, while the lead car is tracked."
OPTIONS_HINT = (
    "NAME=VALUE, separated by commas: alpha, beta of alpha-beta; position-sd [m], acceleration-sd "
    "[m/s^2], speed-sd [m/s] of kalman. Empty: the filter's own."
)
FILE_HINT = "Path of a file of 'pemviz pem fit --position-errors', where the panel runs."


def limits(name: str, *, step: float, kind: type = ExperimentConfig) -> tuple[float, float]:
    """Bounds of a number field; an open bound is moved inwards by a step.

    Raises:
        ValueError: The field declares no bounds.
    """
    annotation = get_type_hints(kind, include_extras=True)[name]
    arms = (annotation, *get_args(annotation))  # what may be left out is a union with None
    for limit in (part for arm in arms for part in get_args(arm)):
        if isinstance(limit, Range) and limit.low is not None and limit.high is not None:
            low = limit.low + (step if limit.low_open else 0.0)
            return low, limit.high - (step if limit.high_open else 0.0)
    message = f"{name} declares no bounds"
    raise ValueError(message)


def hint(name: str) -> str:
    """What a field of the experiment means, with unit and range."""
    return field_docs(ExperimentConfig)[name]


class EncounterControls:
    """Shown while the settings are those of a logical scenario."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[Any], None]) -> None:
        """Add the controls; ``changed`` is called when a person has changed one."""
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


def plain_simulator(config: ExperimentConfig) -> Simulator:
    """The scenario whose signals a specification is about."""
    plain = replace(config, rules=(), simulator=DRAWN_BACK_END)
    if config.encounter.logical_scenario == NO_LOGICAL_SCENARIO:
        return build_named_simulator(plain.simulator, plain.scenario, carla=plain.carla)
    return cast(Simulator, build_encounter_simulator(plain))


def check_back_end(config: ExperimentConfig) -> None:
    """Refuse what cannot be had of a logical scenario, or with errors of measured positions.

    Raises:
        InputError: The line says what.
    """
    logical = config.encounter.logical_scenario != NO_LOGICAL_SCENARIO
    if logical or config.position_errors is not None:
        check_method_fits(config, build_back_end(config))


class PerceptionControls:
    """A folder, folded away at first; shown for the shipped simulators alone, which take both."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[Any], None]) -> None:
        """Add the controls; ``changed`` is called when a person has changed one."""
        self._base = ScenarioConfig()
        self._takes_errors = True
        self._folder = gui.add_folder(FOLDER, expand_by_default=False)
        with self._folder:
            self._add_tracker(gui)
            self.errors = gui.add_dropdown(
                "Position errors", [NONE, *shipped_position_errors(), FROM_FILE],
                hint=hint("position_errors"),
            )  # fmt: skip
            self.file = gui.add_text("Errors file", "", hint=FILE_HINT)
        for control in (*self._counted, self.options, self.kind, self.errors, self.file):
            control.on_update(changed)

    def fill(self, config: ExperimentConfig) -> None:
        """Show what a configuration says."""
        self._base = config.scenario
        settings = read_tracker(config.scenario.tracker)
        self.kind.value = NONE if settings is None else COUNTED
        if settings is not None:
            self.hits.value, self.window.value = settings.hits, settings.window
            self.coast.value, self.filter.value = settings.coast, settings.filter
            self.options.value = ",".join(tracker_options(settings))
        named = config.position_errors
        shipped = named in shipped_position_errors()
        self.errors.value = NONE if named is None else named if shipped else FROM_FILE
        self.file.value = "" if named is None or shipped else named

    def offer(self, simulator: str, *, errors: bool = True) -> None:
        """Show what a simulator takes, ``errors`` too or not, and what the choices need."""
        self._takes_errors = errors
        counted = self.kind.value == COUNTED
        filtered = counted and self.filter.value != NO_TRACKER
        for control, shown in (
            (self._folder, simulator in SHIPPED_SIMULATORS),
            *((control, counted) for control in self._counted),
            (self.options, filtered),
            (self.errors, errors),
            (self.file, errors and self.errors.value == FROM_FILE),
        ):
            control.visible = shown

    def into(self, config: ExperimentConfig) -> ExperimentConfig:
        """A configuration with what the controls say; without errors where they are not offered."""
        if config.simulator not in SHIPPED_SIMULATORS:
            return replace(config, position_errors=None)
        chosen = self.errors.value
        chosen = chosen if self._takes_errors else NONE
        named = {NONE: None, FROM_FILE: self.file.value.strip()}.get(chosen, chosen)
        scenario = replace(config.scenario, tracker=self._tracker())
        return replace(config, position_errors=named, scenario=scenario)

    def _add_tracker(self, gui: viser.GuiApi) -> None:
        self.kind = gui.add_dropdown(
            "Tracker", [NONE, COUNTED], hint=field_docs(ScenarioConfig)["tracker"]
        )
        low, high = map(int, limits("hits", step=1, kind=TrackerSettings))
        self.hits = gui.add_number("Hits M", FIRST.hits, min=low, max=high, step=1, hint=HITS_HINT)
        self.window = gui.add_number(
            "Outcomes N", FIRST.window, min=low, max=high, step=1, hint=WINDOW_HINT
        )
        low, high = limits("coast", step=COAST_STEP_S, kind=TrackerSettings)
        self.coast = gui.add_number(
            "Coasting [s]", FIRST.coast, min=low, max=high, step=COAST_STEP_S, hint=COAST_HINT
        )
        self.filter = gui.add_dropdown("Filter", get_args(FilterName), hint=FILTER_HINT)
        self.options = gui.add_text("Filter options", "", hint=OPTIONS_HINT)
        self._counted = (self.hits, self.window, self.coast, self.filter)

    def _tracker(self) -> str:
        """The tracker as options have it; as it was filled in where it says the same."""
        if self.kind.value == NONE:
            return NO_TRACKER
        words = [f"{self.hits.value}/{self.window.value}"]
        words += [f"coast={self.coast.value}"] * (self.coast.value != 0.0)
        filtered = self.filter.value != NO_TRACKER
        words += [f"filter={self.filter.value}"] * filtered
        words += [self.options.value.strip()] * bool(filtered and self.options.value.strip())
        return same_tracker(",".join(words), self._base.tracker)


def same_tracker(typed: str, before: str) -> str:
    """The tracker typed; in its words before where it means the same."""
    try:
        return before if read_tracker(typed) == read_tracker(before) else typed
    except ConfigError:  # told when the configuration is checked
        return typed
