"""``pemviz reproduce``: the paper's tables and figures beside the published numbers, and more."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.parsing import parse_arguments
from pemviz.cli.reproduce_progress import make_folder, reproduction_progress
from pemviz.cli.reproduce_scenarios import run as reproduce_scenarios
from pemviz.errors import EXIT_DONE, RunError
from pemviz.files.atomic import write_bytes
from pemviz.reproduce.carry_out import Reproduction, reproduce
from pemviz.reproduce.settings import PARTS, Part, Settings

Chosen = Literal["table1", "table2", "table3", "figures", "all"]

DESCRIPTION = (
    "Compute the paper's tables and figures anew and set them beside the published numbers: "
    "markdown, CSV, PNG and one recording. 'pemviz reproduce scenarios' is a study of its own, "
    "what memory and tracker are worth in each logical scenario: see its --help."
)
SCENARIOS_WORD = "scenarios"


@dataclass(frozen=True, kw_only=True)
class ReproduceArguments:
    """Options of ``pemviz reproduce``."""

    parts: tyro.conf.Positional[tuple[Chosen, ...]] = ("all",)
    """What: table1 (error models; needs --data), table2 (methods), table3 (metrics), figures,
    or all."""
    out: Path = Path("reproduction")
    """Folder for the files; made if need be, files of the same name are replaced."""
    repetitions: int = 10
    """Independent repetitions of every experiment; at least 1."""
    data: Path | None = None
    """The paper's training set for Table I: a folder with salient_inputs.txt and
    salient_labels.txt, or a table of `pemviz pem collect`."""
    seed: int = 0
    """Root of all randomness; 0 or more."""
    pem: str = "ml-nn"
    """Perception error model of Tables II and III and the figures: a shipped name or a file."""
    workers: int = 2
    """Processes; the results do not depend on it; at least 1."""
    no_recording: bool = False
    """Leave out reproduction.rrd."""


def run(words: Sequence[str]) -> int:
    """Carry out the command; of the paper all files are written at its end, or none.

    Raises:
        InputError: The arguments are wrong.
        RunError: Interrupted, or a file cannot be written.
    """
    if words and words[0] == SCENARIOS_WORD:
        return reproduce_scenarios(words[1:])
    arguments = parse_arguments(
        ReproduceArguments,
        words,
        command="reproduce",
        default=ReproduceArguments(),
        description=DESCRIPTION,
    )
    settings = _settings(arguments)
    make_folder(arguments.out)
    with stop_on_signals() as should_stop, reproduction_progress() as on_progress:
        made = reproduce(settings, on_progress=on_progress, should_stop=should_stop)
    _write(made, arguments.out, recording=not arguments.no_recording)
    print(made.page)
    print(f"pemviz: written to {arguments.out}", file=sys.stderr)
    return EXIT_DONE


def _settings(arguments: ReproduceArguments) -> Settings:
    chosen = arguments.parts or ("all",)
    parts: tuple[Part, ...] = tuple(part for part in PARTS if "all" in chosen or part in chosen)
    return Settings(
        parts=parts,
        repetitions=arguments.repetitions,
        seed=arguments.seed,
        pem=arguments.pem,
        data=arguments.data,
        workers=arguments.workers,
    )


def _write(made: Reproduction, out: Path, *, recording: bool) -> None:
    try:
        for name, content in made.files().items():
            write_bytes(out / name, content)
        if recording:
            from pemviz.reproduce.recording import write_recording  # noqa: PLC0415  rerun is slow

            write_recording(made, out / "reproduction.rrd")
    except OSError as error:
        message = f"out = {out}: cannot be written ({error})"
        raise RunError(message) from error
