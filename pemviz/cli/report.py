"""``pemviz report``: one page for a safety case from runs that were kept, its argument as data."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pemviz.cli.help import HelpPage
from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import Range, check_value
from pemviz.errors import EXIT_DONE, EXIT_GATE_TRIPPED, ConfigError
from pemviz.files.atomic import check_place, write_named

PAGE = HelpPage(
    text="""
usage: pemviz report RUN [RUN ...] [OPTIONS]
One self-contained HTML page from run folders, or from a sweep's folder: claim,
argument with a picture, evidence, assumptions with what each is worth, data,
provenance; several runs side by side. It fetches nothing and prints well.

Question
  --claim-below P       the failure probability that is to be claimed
  --budget BUDGET.toml  a risk budget stands first.
Output
  --out FILE            the page [report.html, or none with --gsn]
  --gsn FILE            the argument as data: Goal Structuring Notation in
                        gsn2x's YAML; solutions name files by digest
Again
  --check FILE          judge such a file anew, in place of RUN
  --update              and make goals undeveloped whose claims do not hold
Examples
  pemviz report recordings/RUN --claim-below 1e-6 --out case.html
  pemviz report --budget budget.toml --out case.html --gsn case.gsn.yaml
  pemviz report --check case.gsn.yaml
Exit codes: 0 done, or every claim holds; 1 --check: one does not; 2 bad input
More: --help OPTION, such as --help gsn; --help-all for everything""",
)
ClaimBelow = Annotated[float, Range(low=0.0, low_open=True, high=1.0)]
DEFAULT_OUT = Path("report.html")


@dataclass(frozen=True, kw_only=True)
class ReportArguments:
    """Options of ``pemviz report``."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders of sweeps; at least one, but for --budget, whose own are taken if
    none is named."""
    out: Path | None = None
    """The page; one that is there is replaced when the new one is whole. Left out: report.html, or
    none if --gsn is given."""
    claim_below: ClaimBelow | None = None
    """The failure probability that is to be claimed, judged by all that leaves the answer open;
    above 0, at most 1. Left out: the runs' own target, if they have the same."""
    budget: Path | None = None
    """A risk budget (TOML, see 'pemviz budget'), which the page and the argument are then about."""
    gsn: Path | None = None
    """Write the argument to this file: Goal Structuring Notation in the YAML of gsn2x. Solutions
    name the runs' files by SHA-256; a claim that does not hold is an undeveloped goal."""
    check: Path | None = None
    """Judge such a file again, from the runs and the budget that it names, in place of RUNS;
    nothing is written."""
    update: bool = False
    """With --check: make goals whose claims do not hold undeveloped in the file."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: A run, budget or argument cannot be read, or nothing be written there.
    """
    arguments = parse_arguments(ReportArguments, words, command="report", page=PAGE)
    if arguments.claim_below is not None:
        check_value(name="claim-below", value=arguments.claim_below, annotation=ClaimBelow)
    if arguments.check is not None:
        return _check(arguments, arguments.check)
    if arguments.update:
        message = "update: only with --check FILE"
        raise ConfigError(message)
    if not arguments.runs and arguments.budget is None:
        message = "runs = none: name at least one run folder"
        raise ConfigError(message)
    return _write(arguments)


def _write(arguments: ReportArguments) -> int:
    """The page, and the argument if it is asked for."""
    out = arguments.out or (DEFAULT_OUT if arguments.gsn is None else None)
    for name, path in (("out", out), ("gsn", arguments.gsn)):
        if path is not None:
            check_place(name, path)
    # --help answers without it
    from pemviz.reports.argument import argument_of_budget, argument_of_runs  # noqa: PLC0415
    from pemviz.reports.case_runs import read_case_run, run_folders  # noqa: PLC0415
    from pemviz.reports.gsn_file import write_gsn  # noqa: PLC0415
    from pemviz.reports.safety_case import safety_case_page  # noqa: PLC0415
    from pemviz.runs.risk_budget import judge_budget  # noqa: PLC0415

    judged = None if arguments.budget is None else judge_budget(arguments.budget)
    folders = run_folders(arguments.runs)
    if judged is not None and not folders:
        folders = list(dict.fromkeys(run.folder for one in judged.hazards for run in one.runs))
    runs = [read_case_run(folder) for folder in folders]
    below = arguments.claim_below
    targets = {one.result.config.target for one in runs}
    if below is None and len(targets) == 1:
        below = targets.pop()
    if arguments.gsn is not None:
        argument = (
            argument_of_runs(runs, below=below) if judged is None else argument_of_budget(judged)
        )
        write_gsn(arguments.gsn, argument)
        print(f"argument: {arguments.gsn}")
        if judged is not None and arguments.runs:
            argued = {run.folder.resolve() for one in judged.hazards for run in one.runs}
            beside = [run.name for run in runs if run.folder.resolve() not in argued]
            if beside:
                why = "in no hazard of the budget, so not in the argument"
                print(f"pemviz: {', '.join(beside)}: {why}", file=sys.stderr)
    if out is not None:
        write_named("out", out, safety_case_page(runs, below=below, budget=judged))
        print(f"report: {out}")
    return EXIT_DONE


def _check(arguments: ReportArguments, path: Path) -> int:
    """Judge an argument again; 1 if a claim does not hold."""
    given = {"runs": arguments.runs, "out": arguments.out, "budget": arguments.budget,
             "gsn": arguments.gsn, "claim-below": arguments.claim_below}  # fmt: skip
    stray = next((name for name, value in given.items() if value), None)
    if stray is not None:
        message = f"{stray}: not with --check, whose file names what it was made from"
        raise ConfigError(message)
    from pemviz.reports.gsn_file import check_gsn, update_gsn  # noqa: PLC0415

    findings = check_gsn(path)
    for one in findings:
        print(f"{one.goal}: {one.text}")
    if arguments.update and any(one.is_new for one in findings):
        update_gsn(path, findings)
        print(f"argument: {path}")
    if findings:
        claims = "claim does" if len(findings) == 1 else "claims do"
        print(f"{len(findings)} {claims} not hold")
        return EXIT_GATE_TRIPPED
    print("every claim holds")
    return EXIT_DONE
