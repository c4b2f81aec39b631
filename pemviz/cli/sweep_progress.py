"""Progress of a sweep on standard error: a bar on a terminal, a line a run elsewhere."""

import contextlib
from collections.abc import Generator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pemviz.reports.escape import printable_line
from pemviz.sweep.carry_out import OnReport, RunReport


@contextlib.contextmanager
def sweep_progress(total: int, *, done: int, quiet: bool) -> Generator[OnReport, None, None]:
    """Yield what is to be called with every report; failures are told however quiet it is.

    Args:
        total: Runs of the sweep.
        done: Of these, done before.
        quiet: Leave out the lines of runs that are done, where there is no terminal.
    """
    console = Console(stderr=True)
    if console.is_terminal:
        with _bar(console, total=total, done=done) as on_report:
            yield on_report
        return
    ended = done

    def say(report: RunReport) -> None:
        nonlocal ended
        ended += not report.again
        if report.state.status == "failed":
            _say(console, failure_line(report))
        elif not quiet:
            _say(console, f"{ended} of {total}: {done_text(report)}")

    yield say


@contextlib.contextmanager
def _bar(console: Console, *, total: int, done: int) -> Generator[OnReport, None, None]:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("runs,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=total, completed=done)

        def show(report: RunReport) -> None:
            if report.state.status == "failed":
                _say(progress.console, failure_line(report))
            if not report.again:
                progress.update(task, advance=1, description=report.state.planned.label)

        yield show


def tell_done_before(done: int, total: int) -> None:
    """Say how many runs need not be done."""
    _say(Console(stderr=True), f"{done} of {total} runs are done already")


def done_text(report: RunReport) -> str:
    """A run that is done, with what it found."""
    estimate = report.state.estimate
    answer = "" if estimate is None else f": probability {estimate.probability:.3g}"
    return f"{report.state.planned.label}{answer}"


def failure_line(report: RunReport) -> str:
    """Which run failed, why, and what follows."""
    then = "; it is tried once more" if report.again else ""
    return f"failed: {report.state.planned.label}: {report.state.message}{then}"


def _say(console: Console, text: str) -> None:
    console.print(printable_line(text), highlight=False, markup=False, soft_wrap=True)
