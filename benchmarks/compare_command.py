"""``python -m benchmarks compare``: ratios of speed in a run, held against an earlier run's."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.figures import as_cell
from pemviz.cli.parsing import parse_arguments
from pemviz.config.ranges import Range, check_fields
from pemviz.errors import EXIT_DONE, EXIT_GATE_TRIPPED, InputError

if TYPE_CHECKING:
    from benchmarks.ratios import Change, Comparison

COMMAND, PROGRAM = "compare", "python -m benchmarks"


@dataclass(frozen=True, kw_only=True)
class CompareArguments:
    """Measure how many times faster pemviz is than what one would write or use else.

    Against plain numpy, the compiled loop's own limit on this machine, rtamt (in the Python that
    PEMVIZ_ORACLE_PYTHON names) and the paper's algorithm in plain torch; all within one run, in
    processor seconds. With an earlier run's file, what became slower is told: exit code 1.
    """

    earlier: tyro.conf.Positional[Path | None] = None
    """A file that --out wrote, to hold this run against."""
    out: Path | None = None
    """Keep this run's ratios in a file, for later runs to be held against."""
    threshold: Annotated[float, Range(low=0.0, high=1.0, high_open=True)] = 0.25
    """Share of its earlier value by which a ratio must fall to count as slower."""
    turns: Annotated[int, Range(low=1, high=1000)] = 5
    """How often each pair is measured; medians are shown, least and largest beside them."""
    json: bool = False
    """Print the ratios as one JSON object and nothing else."""


def run(words: Sequence[str]) -> int:
    """Measure, print, keep and compare.

    Args:
        words: What follows the command.

    Raises:
        InputError: The arguments are wrong, or the earlier file is.
        RunError: rtamt cannot be run where it was said to be.
    """
    arguments = parse_arguments(CompareArguments, words, command=COMMAND, program=PROGRAM)
    check_fields(arguments)
    from benchmarks.comparison import compare  # noqa: PLC0415  slow to import
    from benchmarks.ratios import changes, read_comparison  # noqa: PLC0415  as above

    # before minutes are spent
    earlier = None if arguments.earlier is None else read_comparison(arguments.earlier)
    _check_out(arguments.out)
    now = compare(turns=arguments.turns)
    if arguments.out is not None:
        _keep(now, arguments.out)
    held = [] if earlier is None else list(changes(earlier, now, threshold=arguments.threshold))
    _show(now, held, as_json=arguments.json)
    if earlier is not None and dict(earlier.made_with) != dict(now.made_with):
        print(_other_machine(earlier, now), file=sys.stderr)
    slower = [change for change in held if change.slower]
    for one in slower:
        ratios = f"{one.before:.3g} before, {one.now:.3g} now"
        print(f"slower: {one.name} against {one.against}: {ratios}", file=sys.stderr)
    return EXIT_GATE_TRIPPED if slower else EXIT_DONE


def _check_out(path: Path | None) -> None:
    if path is not None and not path.parent.is_dir():
        raise InputError(f"out = {path}: there is no folder {path.parent}")


def _keep(now: "Comparison", path: Path) -> None:
    from pemviz.files.atomic import write_json  # noqa: PLC0415

    try:
        write_json(path, now.document())
    except OSError as error:
        raise InputError(f"out = {path}: cannot be written ({error.strerror or error})") from None


def _show(now: "Comparison", held: Sequence["Change"], *, as_json: bool) -> None:
    if as_json:
        document = now.document()
        if held:
            document["changes"] = [vars(change) for change in held]
        print(json.dumps(document, allow_nan=False))
        return
    before = {(change.name, change.against): change for change in held}
    table = Table(title="times faster", title_justify="left")
    for name in ("measured", "against"):
        table.add_column(name)
    for name in ("ratio", "least", "largest", *(("earlier",) if held else ())):
        table.add_column(name, justify="right")
    for ratio in now.ratios:
        was = before.get(ratio.key)
        earlier = [] if not held else ["-" if was is None else as_cell(was.before)]
        cells = (as_cell(ratio.value), as_cell(ratio.low), as_cell(ratio.high), *earlier)
        name = f"{ratio.name}\n  {ratio.note}" if ratio.note else ratio.name
        table.add_row(name.replace("[", r"\["), ratio.against, *cells)
    Console().print(table)
    for one in now.left_out:
        print(f"left out: {one.name}: {one.why}")
    for change in held:
        if change.now is None:
            print(f"left out: {change.name} against {change.against}, measured in the earlier run")


def _other_machine(earlier: "Comparison", now: "Comparison") -> str:
    parts: list[str] = []
    for name in {**earlier.made_with, **now.made_with}:
        was, is_now = (made.get(name, "unknown") for made in (earlier.made_with, now.made_with))
        if was != is_now:
            parts.append(f"{name} {was} (now {is_now})")
    return f"the earlier run had {', '.join(parts)}"
