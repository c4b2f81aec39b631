"""Bars on standard error, of anything that takes long; what a run says of itself is in progress."""

import contextlib
from collections.abc import Callable, Generator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)


def drawn_on_terminal(console: Console) -> bool:
    """Whether a bar can be redrawn in place: a notebook asks for colours, but is no terminal."""
    return console.is_terminal and console.file.isatty()


def bar(console: Console, *words: ProgressColumn, width: int, disable: bool = False) -> Progress:
    """A bar that goes when it is done: what is under way, how far it is, and that in words.

    Args:
        console: Where it is shown.
        words: Columns that say how far in numbers, and how long it takes still.
        width: Of the bar [characters].
        disable: Show nothing.
    """
    columns = TextColumn("{task.description}", markup=False), BarColumn(width), *words
    return Progress(*columns, console=console, transient=True, disable=disable)


def counting_bar(console: Console, *, unit: str = "", disable: bool = False) -> Progress:
    """A bar of so many things, each a ``unit``, with the time left as rich has it."""
    words = (MofNCompleteColumn(), *([TextColumn(unit)] if unit else []))
    left = TimeRemainingColumn(), TextColumn("left")
    return bar(console, *words, *left, width=40, disable=disable)


@contextlib.contextmanager
def progress_bar(what: str) -> Generator[Callable[[int, int], None]]:
    """Yield a function that takes (steps done, steps in all); nothing but on a terminal."""
    console = Console(stderr=True)
    # elsewhere than on a terminal rich would leave an empty line
    with counting_bar(console, disable=not drawn_on_terminal(console)) as progress:
        task = progress.add_task(what, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@contextlib.contextmanager
def jobs_progress() -> Generator[Callable[[int, int, str], None]]:
    """Yield a function that takes (jobs done, jobs in all, label): a bar, or a line a job."""
    console = Console(stderr=True)
    if not drawn_on_terminal(console):
        yield lambda done, total, label: console.print(
            f"{done} of {total}: {label}", highlight=False, markup=False, soft_wrap=True
        )
        return
    with counting_bar(console) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda done, total, label: progress.update(
            task, completed=done, total=total, description=label
        )
