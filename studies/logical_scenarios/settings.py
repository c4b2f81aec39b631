"""What logical scenarios are compared with, and with what effort."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from pemviz.config import ExperimentConfig
from pemviz.config.encounters import LOGICAL_SCENARIOS
from pemviz.config.ranges import Range, check_value
from pemviz.config.toml_files import load_preset
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.errors import ConfigError
from pemviz.pem import load_pem

WEIGHTED, PLAIN = METHODS = ("mixture", "monte-carlo")
"""What every cell is answered by."""
ANY = "any rule"
"""What breaks at least one of the rules."""
EXPLORATION_SHARE = 20
"""One of so many rollouts is in a stage of mixture, as in the logical scenarios' presets."""
MOST_CELLS = 1000
Rollouts = Annotated[int, Range(low=200, high=1_000_000)]
PlainRollouts = Annotated[int, Range(low=100, high=10_000_000)]
Workers = Annotated[int, Range(low=1, high=1024)]


@dataclass(frozen=True)
class Cell:
    """A logical scenario under one detector and one tracker.

    Attributes:
        logical_scenario: Its preset.
        memory_s: Memory time of misses [s].
        tracker: As ``ScenarioConfig.tracker``.
    """

    logical_scenario: str
    memory_s: float
    tracker: str

    @property
    def label(self) -> str:
        """In words."""
        return f"{self.logical_scenario}, memory {self.memory_s:g} s, {tracker_words(self.tracker)}"


@dataclass(frozen=True, kw_only=True)
class ScenarioStudySettings:
    """Which cells, and the effort for each.

    Attributes:
        logical_scenarios: By name; each once.
        memories_s: Memory times of the detector's misses [s]; each once.
        trackers: As ``ScenarioConfig.tracker``; each once.
        rollouts: Of mixture for each cell, stages and all.
        plain_rollouts: Of plain Monte Carlo for each cell.
        seed: Root of all randomness.
        pem: Perception error model: a shipped name or a file.
        workers: Processes; the results do not depend on them.
    """

    logical_scenarios: tuple[str, ...] = LOGICAL_SCENARIOS
    memories_s: tuple[float, ...] = (0.0, 0.15, 0.25)
    trackers: tuple[str, ...] = (NO_TRACKER, "2/3", "3/5")
    rollouts: int = 2400
    plain_rollouts: int = 100_000
    seed: int = 0
    pem: str = "ml-nn"
    workers: int = 2

    @property
    def cells(self) -> tuple[Cell, ...]:
        """All cells, logical scenarios first, then trackers."""
        return tuple(
            Cell(logical_scenario, memory_s, tracker)
            for logical_scenario in self.logical_scenarios
            for tracker in self.trackers
            for memory_s in self.memories_s
        )

    def config(self, cell: Cell, method: str) -> ExperimentConfig:
        """What is asked of a cell by one of the two methods."""
        base = load_preset(cell.logical_scenario)
        exploration = self.rollouts // EXPLORATION_SHARE
        final = self.rollouts - (base.stages + 1) * exploration
        return replace(
            base,
            method=method,
            pem=self.pem,
            memory_s=cell.memory_s,
            seed=self.seed,
            rollouts=exploration,
            final_rollouts=final if method == WEIGHTED else self.plain_rollouts,
            scenario=replace(base.scenario, tracker=cell.tracker),
        )

    def validate(self) -> None:
        """Check everything before anything is simulated.

        Raises:
            InputError: One line that names what is wrong and what is allowed.
        """
        for name, value, allowed in (
            ("rollouts", self.rollouts, Rollouts),
            ("plain_rollouts", self.plain_rollouts, PlainRollouts),
            ("workers", self.workers, Workers),
        ):
            check_value(name=name, value=value, annotation=allowed)
        _check_each_once("logical_scenarios", self.logical_scenarios)
        _check_each_once("memories_s", self.memories_s)
        _check_each_once("trackers", self.trackers)
        for logical_scenario in self.logical_scenarios:
            if logical_scenario not in LOGICAL_SCENARIOS:
                known = ", ".join(LOGICAL_SCENARIOS)
                message = f"logical_scenarios = {logical_scenario!r}: must be of {known}"
                raise ConfigError(message)
        if len(self.cells) > MOST_CELLS:
            message = (
                f"logical_scenarios: {len(self.cells)} cells are asked for; at most {MOST_CELLS}"
            )
            raise ConfigError(message)
        for cell in self.cells:
            self.config(cell, WEIGHTED).validate()
        load_pem(self.pem)


def tracker_words(tracker: str) -> str:
    """A tracker for people: ``2/3`` is 2 of 3."""
    if tracker == NO_TRACKER:
        return "no tracker"
    confirmed, *options = tracker.split(",")
    return ", ".join([f"tracker {confirmed.strip().replace('/', ' of ')}", *options])


def _check_each_once(name: str, values: Sequence[object]) -> None:
    if not values or len(set(values)) < len(values):
        given = ", ".join(map(str, values)) or "nothing"
        message = f"{name} = {given}: must be at least one, each once"
        raise ConfigError(message)
