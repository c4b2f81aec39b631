"""What commands that reproduce a study share: their folder, and how far they are."""

import contextlib
from collections.abc import Callable, Generator
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pemviz.errors import ConfigError


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


@contextlib.contextmanager
def reproduction_progress() -> Generator[Callable[[int, int, str], None], None, None]:
    """A bar on a terminal, a line a job elsewhere, on standard error."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda done, total, label: console.print(
            f"{done} of {total}: {label}", highlight=False, markup=False, soft_wrap=True
        )
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)

        def show(done: int, total: int, label: str) -> None:
            progress.update(task, completed=done, total=total, description=label)

        yield show
