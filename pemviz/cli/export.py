"""``pemviz export``: a rollout of a run as a file for other tools."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import Range, check_value

DESCRIPTION = (
    "Write one rollout of a run folder, by its rank, for other tools: csv and parquet hold all "
    "signals and outcomes of any run; openscenario (an .xosc file and its road, an .xodr file) and "
    "commonroad hold both cars' trajectories in runs of the shipped scenario, and need "
    "pip install 'pemviz[export]'."
)
Rank = Annotated[int, Range(low=1)]


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Options of ``pemviz export``."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    format: Literal["openscenario", "commonroad", "csv", "parquet"]
    """The file's format."""
    rank: Rank = 1
    """Which rollout: 1 is the least robust of those that carry the answer, as in the summary's
    list, and the panel's where the least robust come first; then the others; at least 1."""
    out: Path | None = None
    """The file; the folder must be there. Left out: <run>-rank-<rank> with the format's ending,
    here."""
    force: bool = False
    """Replace files that are there."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The run cannot be read, has no such rollout, or cannot be told of in the
            format; a package is not installed; or the file cannot be written there.
    """
    arguments = parse_arguments(ExportArguments, words, command="export", description=DESCRIPTION)
    check_value(name="rank", value=arguments.rank, annotation=Rank)
    from pemviz.export.formats import (  # noqa: PLC0415  --help answers without it
        FORMATS,
        check_place,
        write_rollout,
    )
    from pemviz.runs.kept_rollout import read_kept_rollout  # noqa: PLC0415  as above

    chosen = FORMATS[arguments.format]
    chosen.check_installed(arguments.format)
    name = f"{arguments.run.resolve().name}-rank-{arguments.rank}{chosen.endings[0]}"
    out = Path(name) if arguments.out is None else arguments.out
    paths = check_place(out, form=arguments.format, force=arguments.force)
    rollout = read_kept_rollout(arguments.run, rank=arguments.rank)
    write_rollout(rollout, paths, form=arguments.format)
    for path in paths:
        print(f"{arguments.format}: {path}")
    return 0
