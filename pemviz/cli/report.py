"""``pemviz report``: one page for a safety case from runs that were kept."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import Range, check_value
from pemviz.errors import ConfigError, InputError
from pemviz.files.atomic import is_folder, write_text

DESCRIPTION = (
    "Write one self-contained HTML page from run folders, or from a sweep's folder: claim, "
    "argument, evidence with pictures, assumptions with what each is worth, data and model, "
    "provenance; several runs side by side. It fetches nothing and prints well."
)
ClaimBelow = Annotated[float, Range(low=0.0, low_open=True, high=1.0)]


@dataclass(frozen=True, kw_only=True)
class ReportArguments:
    """Options of ``pemviz report``."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders of sweeps; at least one."""
    out: Path = Path("report.html")
    """The page; one that is there is replaced when the new one is whole."""
    claim_below: ClaimBelow | None = None
    """The failure probability that is to be claimed, judged by all that leaves the answer open;
    above 0, at most 1. Left out: the runs' own target, if they have the same."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: A run cannot be read, or the page cannot be written there.
    """
    arguments = parse_arguments(ReportArguments, words, command="report", description=DESCRIPTION)
    if arguments.claim_below is not None:
        check_value(name="claim-below", value=arguments.claim_below, annotation=ClaimBelow)
    if not arguments.runs:
        message = "runs = none: name at least one run folder"
        raise ConfigError(message)
    _check_place(arguments.out)
    # --help answers without it
    from pemviz.reports.case_runs import read_case_run, run_folders  # noqa: PLC0415
    from pemviz.reports.safety_case import safety_case_page  # noqa: PLC0415

    runs = [read_case_run(folder) for folder in run_folders(arguments.runs)]
    below = arguments.claim_below
    targets = {one.result.config.target for one in runs}
    if below is None and len(targets) == 1:
        below = targets.pop()
    page = safety_case_page(runs, below=below)
    try:
        write_text(arguments.out, page)
    except OSError as error:
        message = f"out = {arguments.out}: cannot be written ({error.strerror or error})"
        raise InputError(message) from error
    print(f"report: {arguments.out}")
    return 0


def _check_place(path: Path) -> None:
    if is_folder(path):
        message = f"out = {path}: must be a file, is a folder"
        raise ConfigError(message)
    if not is_folder(path.parent):
        message = f"out = {path}: must lie in a folder that exists"
        raise ConfigError(message)
