"""``python -m studies.logical_scenarios``: what memory and tracker change in each of them."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pemviz.bars import jobs_progress
from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.main import carry_out
from pemviz.cli.parsing import Processes, parse_arguments
from pemviz.cli.reproduce import make_folder, writable, write_files
from pemviz.errors import EXIT_DONE
from studies.logical_scenarios import ScenarioStudySettings, study_scenarios

DESCRIPTION = (
    "Run every logical scenario with every memory time and every tracker, by mixture and by "
    "plain Monte Carlo, and tell how likely each rule is broken and how much memory and tracker "
    "change that: markdown, CSV and PNG. What is done is kept: the same command goes on."
)
CELLS = "cells"


@dataclass(frozen=True, kw_only=True)
class ScenariosArguments:
    """Options of ``python -m studies.logical_scenarios``."""

    out: Path = Path("scenarios")
    """Folder for the files; made if need be, files of the same name are replaced."""
    logical_scenarios: tuple[str, ...] = ScenarioStudySettings.logical_scenarios
    """Which: braking, cut-in, cut-out."""
    memories_s: tuple[float, ...] = ScenarioStudySettings.memories_s
    """Memory times of misses [s]; 0 to 60."""
    trackers: tuple[str, ...] = ScenarioStudySettings.trackers
    """Trackers, each as --tracker of 'pemviz record'; others are compared with the first."""
    rollouts: int = ScenarioStudySettings.rollouts
    """Rollouts of mixture in each cell; at least 200."""
    plain_rollouts: int = ScenarioStudySettings.plain_rollouts
    """Rollouts of plain Monte Carlo in each cell; at least 100."""
    seed: int = ScenarioStudySettings.seed
    """Root of all randomness; 0 or more."""
    pem: str = ScenarioStudySettings.pem
    """Perception error model: a shipped name or a file."""
    workers: Processes = ScenarioStudySettings.workers
    """Processes; the results do not depend on it; 1 to 1024."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Carry out the command line and return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return carry_out("studies.logical_scenarios", run, words)


def run(words: Sequence[str]) -> int:
    """Carry out the command.

    Raises:
        InputError: The arguments are wrong; nothing was simulated.
        RunError: Interrupted, or a file cannot be written.
    """
    arguments = parse_arguments(
        ScenariosArguments,
        words,
        command="studies.logical_scenarios",
        program="python -m",
        default=ScenariosArguments(),
        description=DESCRIPTION,
    )
    settings = ScenarioStudySettings(
        logical_scenarios=arguments.logical_scenarios,
        memories_s=arguments.memories_s,
        trackers=arguments.trackers,
        rollouts=arguments.rollouts,
        plain_rollouts=arguments.plain_rollouts,
        seed=arguments.seed,
        pem=arguments.pem,
        workers=arguments.workers,
    )
    settings.validate()
    out = arguments.out
    make_folder(out / CELLS)
    with stop_on_signals() as should_stop, jobs_progress() as on_progress:
        made = study_scenarios(
            settings, out / CELLS, on_progress=on_progress, should_stop=should_stop
        )
    with writable(out):
        write_files(made.files(), out)
    print(made.page)
    print(f"pemviz: written to {out}", file=sys.stderr)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
