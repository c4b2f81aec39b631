"""``python -m benchmarks runs``: ten runs that a user would make, start to exit."""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table

from benchmarks.figures import as_cell, median_ratio
from pemviz.config.ranges import Range, check_fields
from pemviz.errors import EXIT_DONE, InputError, RunError

WHOLE_RUNS = (
    "",
    "--no-recording --preset paper-algorithm --repetitions 3",
    "--no-recording --method splitting --repetitions 10 --rollouts 1000",
    "--no-recording --method zero-variance --final-rollouts 1200 --reference",
    "--no-recording --preset cut-in",
    "--no-recording --memory-curve",
    "--no-recording --preset cut-in --method monte-carlo --final-rollouts 100000 --keep violations",
    "--no-recording --final-rollouts 100000 --keep violations",
    "--no-recording --method adaptive --final-rollouts 300000 --keep violations",
    "--no-recording --method monte-carlo --final-rollouts 1000000 --keep violations --no-plan",
)
"""What follows ``pemviz record``. A compiled loop, or anything else that is there to be fast, stays
where one of these becomes at least 1.5 times faster by it."""

_COMMAND = "from pemviz.cli.main import main; sys.exit(main())"
_NUMBA = "import sys; "
_NO_NUMBA = "import sys; sys.modules['numba'] = None; "  # as where it is not installed


@dataclass(frozen=True, kw_only=True)
class WholeRunArguments:
    """Time ten runs of ``pemviz record``, start to exit, each in a process of its own."""

    checkout: Path | None = None
    """Another checkout of pemviz, whose times are the second column."""
    without_numba: bool = False
    """Make the second column's runs as where numba is not installed."""
    times: Annotated[int, Range(low=1, high=100)] = 3
    """How often each run is made, in turn with that of the second column; medians are shown."""
    json: bool = False
    """Print the figures as one JSON object and nothing else."""


@dataclass(frozen=True, kw_only=True)
class WholeRun:
    """Medians of one run.

    Attributes:
        options: What followed ``pemviz record``.
        user_s: Processor time of the process that was not the system's [s].
        wall_s: Time from start to exit [s].
        other_user_s: ``user_s`` of the second column [s], if there is one.
        ratio: Median of ``user_s`` by ``other_user_s`` of runs made one after the other.
    """

    options: str
    user_s: float
    wall_s: float
    other_user_s: float | None = None
    ratio: float | None = None


def whole_runs(arguments: WholeRunArguments) -> Iterator[WholeRun]:
    """Make the runs, one after the other.

    Raises:
        InputError: ``arguments.checkout`` is no checkout of pemviz.
        RunError: A run did not end well.
    """
    here = Path(__file__).parent.parent
    other = arguments.checkout or (here if arguments.without_numba else None)
    if other is not None and not (other / "pemviz" / "__main__.py").is_file():
        raise InputError(f"checkout = {other}: there is no pemviz/__main__.py in it")
    for options in WHOLE_RUNS:
        user: list[float] = []
        wall: list[float] = []
        other_user: list[float] = []
        for _ in range(arguments.times):
            user_s, wall_s = _timed(options, checkout=here, without_numba=False)
            user.append(user_s)
            wall.append(wall_s)
            if other is not None:
                without = arguments.without_numba
                other_user.append(_timed(options, checkout=other, without_numba=without)[0])
        yield WholeRun(
            options=options,
            user_s=statistics.median(user),
            wall_s=statistics.median(wall),
            other_user_s=statistics.median(other_user) if other_user else None,
            ratio=median_ratio(user, other_user) if other_user else None,
        )


def _timed(options: str, *, checkout: Path, without_numba: bool) -> tuple[float, float]:
    program = (_NO_NUMBA if without_numba else _NUMBA) + _COMMAND
    with tempfile.TemporaryDirectory() as folder:
        words = ["record", "--out", str(Path(folder) / "run"), *options.split()]
        before_s, began_s = _children_s(), time.perf_counter()
        # the working directory comes first among the places where Python looks for pemviz
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-c", program, *words],
            cwd=checkout,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        wall_s = time.perf_counter() - began_s
    if done.returncode != EXIT_DONE:
        raise RunError(f"pemviz record {options}: exit code {done.returncode}\n{done.stderr}")
    return _children_s() - before_s, wall_s


def _children_s() -> float:
    import resource  # noqa: PLC0415  not on Windows

    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def print_whole_runs(arguments: WholeRunArguments) -> int:
    """Measure and print.

    Returns:
        The exit code.

    Raises:
        InputError: An argument is out of range, or as :func:`whole_runs`.
        RunError: As :func:`whole_runs`.
    """
    check_fields(arguments)
    runs = list(whole_runs(arguments))
    if arguments.json:
        print(json.dumps({"runs": [asdict(one) for one in runs]}))
        return EXIT_DONE
    table = Table(title="whole runs, start to exit", title_justify="left")
    table.add_column("pemviz record")
    for name in ("user [s]", "wall [s]", "other, user [s]", "ratio"):
        table.add_column(name, justify="right")
    for one in runs:
        figures = (one.user_s, one.wall_s, one.other_user_s, one.ratio)
        table.add_row(one.options or "(default)", *map(as_cell, figures))
    Console().print(table)
    return EXIT_DONE
