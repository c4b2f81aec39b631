"""``python -m benchmarks accuracy``: methods times seeds on scenarios with known answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from benchmarks.accuracy import (
    Accuracy,
    Case,
    accuracy_table,
    known_probability,
    measure,
    with_budget,
)
from benchmarks.accuracy_report import write_accuracy
from pemviz.config import ExperimentConfig, MethodName, ScenarioConfig
from pemviz.config.ranges import Range, check_fields
from pemviz.config.toml_files import load_preset
from pemviz.errors import ConfigError

PAPER = ScenarioConfig()
SCENARIOS: Mapping[str, ScenarioConfig] = {
    "paper": PAPER,
    "ego brakes 7.5 m/s2": replace(PAPER, emergency_deceleration_mps2=7.5),
    "ego brakes 9 m/s2": replace(PAPER, emergency_deceleration_mps2=9.0),
    "lead brakes 3.3 m/s2": replace(PAPER, lead_deceleration_mps2=3.3),
    "gap 17 m": replace(PAPER, initial_gap_m=17.0),
}
"""``paper`` and variations whose probability is exact, between 1e-18 and 1e-8."""


@dataclass(frozen=True, kw_only=True)
class AccuracyStudy:
    """What is measured."""

    methods: tuple[MethodName, ...] = ("zero-variance", "mixture", "adaptive")
    """Methods to compare, shipped or registered."""
    rollouts: tuple[int, ...] = (1200,)
    """Budgets: rollouts of one run, all stages; at least 24 for methods that learn. Splitting is
    given so many particles, at least 20; to cut and continue them comes on top."""
    scenarios: tuple[str, ...] = tuple(SCENARIOS)
    """Scenarios, by the names of the study."""
    seeds: Annotated[int, Range(low=1, high=100_000)] = 50
    """Runs of each method on each scenario; 1 to 100000."""
    workers: Annotated[int, Range(low=1, high=256)] = 2
    """Processes; the figures do not depend on it; 1 to 256."""
    pem: str = "ml-nn"
    """Perception error model: a shipped name or a file."""
    out: Path = field(default=Path("accuracy"))
    """Folder for accuracy.md, accuracy.json and accuracy.png."""


def run_study(study: AccuracyStudy) -> Sequence[Accuracy]:
    """Measure and write the report.

    Raises:
        InputError: A value is out of range, or a scenario is unknown.
        OSError: The folder cannot be written.
    """
    check_study(study)
    base = replace(load_preset("paper"), pem=study.pem, plan=False)
    cases: list[Case] = []
    for name in study.scenarios:
        config: ExperimentConfig = replace(base, scenario=SCENARIOS[name])
        truth = known_probability(config)
        cases += [
            Case(name, with_budget(config, method=method, rollouts=rollouts), truth)
            for method in study.methods
            for rollouts in study.rollouts
        ]
    rows = accuracy_table(measure(cases, seeds=study.seeds, workers=study.workers))
    write_accuracy(rows, study.out)
    return rows


def check_study(study: AccuracyStudy) -> None:
    """Refuse what cannot be measured.

    Raises:
        InputError: One line that names field, value and what is allowed.
    """
    check_fields(_Numbers(seeds=study.seeds, workers=study.workers))
    for name in study.scenarios:
        if name not in SCENARIOS:
            message = f"scenarios = {name!r}: must be one of {', '.join(SCENARIOS)}"
            raise ConfigError(message)
    for method in study.methods:
        for rollouts in study.rollouts:
            with_budget(load_preset("paper"), method=method, rollouts=rollouts)


@dataclass(frozen=True, kw_only=True)
class _Numbers:
    seeds: Annotated[int, Range(low=1, high=100_000)]
    workers: Annotated[int, Range(low=1, high=256)]


if __name__ == "__main__":
    import sys

    import tyro

    from benchmarks.accuracy_report import accuracy_lines

    sys.stdout.write("\n".join(accuracy_lines(run_study(tyro.cli(AccuracyStudy)))) + "\n")
