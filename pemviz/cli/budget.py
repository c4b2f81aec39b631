"""``pemviz budget``: a risk budget held against the run folders that it names."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pemviz.cli.parsing import parse_arguments
from pemviz.errors import EXIT_DONE, EXIT_GATE_TRIPPED, EXIT_GATE_UNDECIDED
from pemviz.files.atomic import check_place, write_named

if TYPE_CHECKING:
    from pemviz.runs.risk_budget import Outcome

DESCRIPTION = (
    "Hold a risk budget (TOML) against run folders: accepted harm an hour, and for each hazard "
    "encounters an hour x P(violation) x P(harm | violation), each with its interval and source. "
    "Exit codes: 0 met, 1 not met, 2 bad input, 4 not known."
)
EXIT_CODES: "Mapping[Outcome, int]" = {
    "met": EXIT_DONE,
    "not met": EXIT_GATE_TRIPPED,
    "not known": EXIT_GATE_UNDECIDED,
}


@dataclass(frozen=True, kw_only=True)
class BudgetArguments:
    """Options of ``pemviz budget``."""

    budget: tyro.conf.Positional[Path]
    """The budget (TOML); run folders that it names are seen from its own folder."""
    json: bool = False
    """Print one JSON object and nothing else."""
    verbose: bool = False
    """Print sources, all factors and how they are combined too."""
    chart: Path | None = None
    """Draw harm an hour of each hazard beside what is accepted, as SVG, to this file."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The budget or a run cannot be read, or the chart not be written there.
    """
    arguments = parse_arguments(BudgetArguments, words, command="budget", description=DESCRIPTION)
    if arguments.chart is not None:
        check_place("chart", arguments.chart)
    # --help answers without it
    from pemviz.charts.svg import svg  # noqa: PLC0415
    from pemviz.reports.budget_document import (  # noqa: PLC0415
        budget_chart,
        budget_document,
        budget_json,
    )
    from pemviz.reports.terminal import print_document  # noqa: PLC0415
    from pemviz.runs.risk_budget import judge_budget  # noqa: PLC0415

    judged = judge_budget(arguments.budget)
    chart = budget_chart(judged)
    if arguments.chart is not None and chart is not None:
        write_named("chart", arguments.chart, svg(chart))
    if arguments.json:
        print(json.dumps(budget_json(judged), allow_nan=False))
    else:
        print_document(budget_document(judged), verbose=arguments.verbose)
    return EXIT_CODES[judged.outcome]
