"""``pemviz sweep``: many experiments, every combination of settings with every seed."""

import contextlib
import json
import sys
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from pemviz.bars import counting_bar, drawn_on_terminal
from pemviz.cli.help import HelpPage
from pemviz.cli.interrupt import stop_on_signals
from pemviz.cli.parsing import Processes, parse_arguments
from pemviz.config import ExperimentConfig
from pemviz.config.ranges import Range, check_value
from pemviz.config.toml_files import load_config, load_preset
from pemviz.errors import EXIT_DONE, EXIT_FAILED, ConfigError, RunError
from pemviz.files.atomic import write_bytes, write_text
from pemviz.processes import usable_cpus
from pemviz.reports.escape import printable_line
from pemviz.reports.markdown import sections_markdown
from pemviz.runs.workers import check_one_kind
from pemviz.sampling.registry import ignored_note, ignored_settings
from pemviz.sweep import tables
from pemviz.sweep.carry_out import (
    OnReport,
    RunReport,
    RunState,
    carry_out_runs,
    finished_before,
    sweep_folder,
)
from pemviz.sweep.cluster import ClusterWorkers
from pemviz.sweep.plan import Plan, PlannedRun, make_plan, parse_variation
from pemviz.sweep.run_task import Keep, ModelFiles, NamedModels, model_files, models_of
from pemviz.sweep.trade import trade_of, trade_section, trade_variation
from pemviz.sweep.workers import LocalWorkers, Workers

SCHEMA = 1
DEFAULT_OUT = Path("sweeps")
TRADE_PICTURE = "trade.png"
Seeds = Annotated[int, Range(low=1, high=100_000)]

PAGE = HelpPage(
    text="""
usage: pemviz sweep [CONFIG.toml] [OPTIONS]
Every combination of settings with every seed: a run folder each, a table
(sweep.csv, sweep.parquet), summary.md and an overview recording, sweep.rrd.

Question
  --preset NAME              a shipped configuration, in place of CONFIG.toml
  --vary FIELD=VALUE,VALUE   a field of the configuration; may be repeated
  --seeds N                  seeds of each setting [1]
  --trade RULE,RULE          which settings are not dominated between two rules
Work
  --workers N                processes here; --scheduler ADDRESS: a cluster
Output
  --out DIR                  the same command again skips what is done there
  --keep results|all         rollouts and recordings of every run too
  --json                     the table as one JSON object
Examples
  pemviz sweep --preset paper --vary alpha=0.1,0.5 --seeds 10
  pemviz sweep my.toml --vary scenario.initial_gap_m=12,15,18
  pemviz sweep my.toml --vary tracker=hits=1:3,window=3 --trade contact,braking
Exit codes: 0 done, 2 bad input, 3 a run failed twice, or interrupted
More: --help OPTION, such as --help vary; --help-all for everything""",
)


@dataclass(frozen=True, kw_only=True)
class SweepArguments:
    """Options of ``pemviz sweep``."""

    config: tyro.conf.Positional[Path | None] = None
    """Configuration file (TOML) that every run starts from."""
    preset: str | None = None
    """Shipped configuration to start from instead, as of 'pemviz record'."""
    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """FIELD=VALUE,VALUE,... with any field of the configuration, such as alpha=0.05,0.1 or
    scenario.initial_gap_m=12,15; may be given several times. tracker=hits=1:3,window=3:5,coast=0:1
    is a grid of trackers (LOW:HIGH:STEP), rule=NAME,NAME runs that are of one rule each."""
    seeds: Seeds = 1
    """Seeds a setting, from the configuration's on; 1 to 100000."""
    trade: str | None = None
    """Two rules of the configuration, RULE,RULE: each setting is run for either, and the summary
    says which settings are not dominated; a picture, trade.png, shows them. With one seed."""
    out: Path | None = None
    """Folder for everything; without it, one below sweeps/ that the same command finds again."""
    workers: Processes | None = None
    """Processes on this machine, 1 to 1024; without it, as many as there are CPUs. The results
    do not depend on it."""
    scheduler: str | None = None
    """Address of a Dask scheduler, such as tcp://10.0.0.5:8786: its workers carry out the runs.
    They need pemviz in the same version, and no disk in common with this machine."""
    keep: Keep = "results"
    """What is kept of a run: config.toml and result.json, or all, rollouts, proposals and
    recording too."""
    allow_python: bool = False
    """Allow error models named module:attribute, which runs that module's code, in workers too."""
    json: bool = False
    """Print the table as one JSON object and nothing else."""


def run(words: Sequence[str]) -> int:
    """Carry out the command and return its exit code.

    Raises:
        InputError: The arguments are wrong; nothing was simulated.
        RunError: Something cannot be written, or the cluster is gone.
    """
    arguments = parse(words)
    base = _base(arguments)
    variations = [parse_variation(text) for text in arguments.vary]
    if arguments.trade is not None:
        varied = [one.field for one in variations]
        variations.append(trade_variation(arguments.trade, seeds=arguments.seeds, varied=varied))
    plan = make_plan(base, variations, seeds=arguments.seeds, allow_python=arguments.allow_python)
    models = {
        names: model_files(names, allow_python=arguments.allow_python)
        for names in {models_of(one.config) for one in plan.runs}
    }
    workers = _workers(arguments, plan)
    out = _out(arguments, plan)
    for note in ignored_notes(plan):
        print(f"pemviz: {note}", file=sys.stderr)
    with sweep_folder(out) as runs:
        before = finished_before(runs, plan.runs, keep=arguments.keep)
        states, lost = _carry_out(
            runs, before, workers, models=models, keep=arguments.keep, quiet=arguments.json
        )
        summary = write_reports(out, plan, states, base=base, is_trade=arguments.trade is not None)
    if arguments.json:
        document = {"schema": SCHEMA, "out": str(out), "runs": tables.rows(plan, states)}
        print(json.dumps(document, allow_nan=False))
    else:
        print(f"{summary}\nsweep folder: {out}")
    return _judge(states, out=out, lost=lost)


def parse(words: Sequence[str]) -> SweepArguments:
    """The command's arguments.

    Raises:
        InputError: An option is unknown, or a value is not allowed.
    """
    arguments = parse_arguments(
        SweepArguments, words, command="sweep", default=SweepArguments(), page=PAGE
    )
    check_value(name="seeds", value=arguments.seeds, annotation=Seeds)
    if arguments.workers is not None:
        check_value(name="workers", value=arguments.workers, annotation=Processes)
    check_one_kind(workers=arguments.workers, scheduler=arguments.scheduler)
    return arguments


def ignored_notes(plan: Plan) -> tuple[str, ...]:
    """A line for each varied setting that one of the sweep's methods does not look at."""
    methods = dict.fromkeys(run.config.method for run in plan.runs)
    return tuple(
        f"{name} is varied: {ignored_note(method)}"
        for method in methods
        for name in plan.fields
        if name in ignored_settings(method)
    )


def write_reports(
    out: Path,
    plan: Plan,
    states: Sequence[RunState],
    *,
    base: ExperimentConfig,
    is_trade: bool = False,
) -> str:
    """Write table, summary and overview recording, each whole or not at all; gives the summary.

    Raises:
        RunError: One of them cannot be written.
    """
    from pemviz.sweep.overview import write_overview  # noqa: PLC0415  rerun is slow to import

    table = tables.rows(plan, states)
    summary, picture = tables.summary_markdown(plan, states), ""
    try:
        if is_trade:
            trade, picture = _write_trade(out, plan, states)
            summary += f"\n{trade}"
        write_text(out / "sweep.csv", tables.csv_text(plan, table))
        write_bytes(out / "sweep.parquet", tables.parquet_bytes(plan, table))
        write_text(out / "summary.md", f"{summary}{picture}")  # which a recording cannot show
        write_overview(out / "sweep.rrd", plan, states, base=base, summary=summary)
    except OSError as error:
        message = f"out = {out}: cannot be written ({error.strerror or error})"
        raise RunError(message) from error
    return summary


def _write_trade(out: Path, plan: Plan, states: Sequence[RunState]) -> tuple[str, str]:
    """Write the picture of the trade between the two rules that are varied last.

    Gives its page, and the line that shows the picture.
    """
    from pemviz.sweep.trade_picture import trade_png  # noqa: PLC0415  matplotlib is slow to import

    first, second = map(str, plan.variations[-1].values)
    trade = trade_of(states, (first, second))
    page = "\n\n".join(sections_markdown([trade_section(trade)], level=2)) + "\n"
    if (picture := trade_png(trade)) is None:
        return page, ""
    write_bytes(out / TRADE_PICTURE, picture)
    return page, f"\n![Both rules over all settings]({TRADE_PICTURE})\n"


def _base(arguments: SweepArguments) -> ExperimentConfig:
    if arguments.config is not None and arguments.preset is not None:
        message = (
            f"config {arguments.config} and preset = {arguments.preset!r}: give only one of them"
        )
        raise ConfigError(message)
    if arguments.config is not None:
        return load_config(arguments.config)
    if arguments.preset is None:
        message = "nothing to start from: give a configuration file or --preset paper"
        raise ConfigError(message)
    return replace(load_preset(arguments.preset), plan=False)  # a sweep tells of many runs


def _workers(arguments: SweepArguments, plan: Plan) -> Workers:
    if arguments.scheduler is not None:
        return ClusterWorkers(arguments.scheduler)
    count = usable_cpus() if arguments.workers is None else arguments.workers
    return LocalWorkers(min(count, len(plan.runs)))


def _out(arguments: SweepArguments, plan: Plan) -> Path:
    if arguments.out is not None:
        return arguments.out
    source = arguments.preset if arguments.config is None else arguments.config.stem
    return DEFAULT_OUT / f"{source}-{plan.digest}"


def _carry_out(
    runs: Path,
    before: Sequence[RunState],
    workers: Workers,
    *,
    models: Mapping[NamedModels, ModelFiles],
    keep: Keep,
    quiet: bool,
) -> tuple[list[RunState], str | None]:
    """How all runs stand in the end, and why the workers were lost, if they were."""
    states = {state.planned.name: state for state in before}
    waiting: list[PlannedRun] = [state.planned for state in before if state.status != "done"]
    total, done = len(before), len(before) - len(waiting)
    if done:
        _say(Console(stderr=True), f"{done} of {total} runs are done already")
    lost = None
    if waiting:
        with (
            stop_on_signals() as should_stop,
            _sweep_progress(total, done=done, quiet=quiet) as on_report,
            workers,
        ):
            try:
                carry_out_runs(
                    runs,
                    waiting,
                    workers,
                    models=models,
                    keep=keep,
                    on_report=on_report,
                    on_end=lambda state: states.update({state.planned.name: state}),
                    should_stop=should_stop,
                )
            except RunError as error:
                lost = str(error)
    return [states[state.planned.name] for state in before], lost


def _judge(states: Sequence[RunState], *, out: Path, lost: str | None) -> int:
    done = sum(state.status == "done" for state in states)
    if lost is not None:
        print(f"pemviz: {lost}", file=sys.stderr)
    if done == len(states):
        return EXIT_DONE if lost is None else EXIT_FAILED
    print(
        f"pemviz: {done} of {len(states)} runs are done; the same command again does the rest; "
        f"what is finished is in {out}",
        file=sys.stderr,
    )
    return EXIT_FAILED


@contextlib.contextmanager
def _sweep_progress(total: int, *, done: int, quiet: bool) -> Generator[OnReport, None, None]:
    """Yield what is to be called with every report; failures are told however quiet it is.

    Args:
        total: Runs of the sweep.
        done: Of these, done before.
        quiet: Leave out the lines of runs that are done, where there is no terminal.
    """
    console = Console(stderr=True)
    if drawn_on_terminal(console):
        with _bar(console, total=total, done=done) as on_report:
            yield on_report
        return
    ended = done

    def say(report: RunReport) -> None:
        nonlocal ended
        ended += not report.again
        if report.state.status == "failed":
            _say(console, _failure_line(report))
        elif not quiet:
            _say(console, f"{ended} of {total}: {_done_text(report)}")

    yield say


@contextlib.contextmanager
def _bar(console: Console, *, total: int, done: int) -> Generator[OnReport, None, None]:
    with counting_bar(console, unit="runs,") as progress:
        task = progress.add_task("starting", total=total, completed=done)

        def show(report: RunReport) -> None:
            if report.state.status == "failed":
                _say(progress.console, _failure_line(report))
            if not report.again:
                progress.update(task, advance=1, description=report.state.planned.label)

        yield show


def _done_text(report: RunReport) -> str:
    """A run that is done, with what it found."""
    estimate = report.state.estimate
    answer = "" if estimate is None else f": probability {estimate.probability:.3g}"
    return f"{report.state.planned.label}{answer}"


def _failure_line(report: RunReport) -> str:
    """Which run failed, why, and what follows."""
    then = "; it is tried once more" if report.again else ""
    return f"failed: {report.state.planned.label}: {report.state.message}{then}"


def _say(console: Console, text: str) -> None:
    console.print(printable_line(text), highlight=False, markup=False, soft_wrap=True)
