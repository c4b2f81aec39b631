"""``pemviz reproduce``: the paper's tables and figures beside the published numbers."""

import sys
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from pemviz.bars import jobs_progress
from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.parsing import parse_arguments
from pemviz.errors import EXIT_DONE, ConfigError, RunError
from pemviz.files.atomic import write_bytes
from pemviz.reproduce.carry_out import reproduce
from pemviz.reproduce.experiments import PARTS, Part, Settings

Chosen = Literal["table1", "table2", "table3", "figures", "all"]

DESCRIPTION = (
    "Compute the paper's tables and figures anew and set them beside the published numbers: "
    "markdown, CSV, PNG and one recording."
)


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
    """Carry out the command; all files are written at its end, or none.

    Raises:
        InputError: The arguments are wrong.
        RunError: Interrupted, or a file cannot be written.
    """
    arguments = parse_arguments(
        ReproduceArguments,
        words,
        command="reproduce",
        default=ReproduceArguments(),
        description=DESCRIPTION,
    )
    settings = _settings(arguments)
    make_folder(arguments.out)
    with stop_on_signals() as should_stop, jobs_progress() as on_progress:
        made = reproduce(settings, on_progress=on_progress, should_stop=should_stop)
    with writable(arguments.out):
        write_files(made.files(), arguments.out)
        if not arguments.no_recording:
            from pemviz.reproduce.recording import write_recording  # noqa: PLC0415  rerun is slow

            write_recording(made, arguments.out / "reproduction.rrd")
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


def make_folder(out: Path) -> None:
    """Make the folder that files are written to, if need be.

    Raises:
        ConfigError: It cannot be.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"out = {out}: no folder can be made there ({error.strerror or error})"
        raise ConfigError(message) from error


def write_files(contents: Mapping[str, bytes], out: Path) -> None:
    """Write files by name to a folder, each whole or not at all."""
    for name, content in contents.items():
        write_bytes(out / name, content)


@contextmanager
def writable(out: Path) -> Generator[None]:
    """What cannot be written to a folder is said of the folder.

    Raises:
        RunError: A file cannot be written.
    """
    try:
        yield
    except OSError as error:
        message = f"out = {out}: cannot be written ({error})"
        raise RunError(message) from error
