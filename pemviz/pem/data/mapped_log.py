"""Somebody's own log as the table that models learn from, by a mapping of its columns.

A log has a row for each obstacle at each moment, with what a detector made of it; in one file, or
in two whose rows belong together. The mapping, a small TOML, names, for each column of the table, a
column of the log or a number::

    [labels]                              # and [detections], for the second file
    separator = ","                       # the default; or ";", "tab", "whitespace"
    header = ["t", "x", "y"]              # only where the file has no header line

    [columns]
    class_id = 0                          # a number: the same in every row
    x_m = "lateral"                       # a column
    z_m = { column = "range_cm", times = 0.01, plus = -1.5 }
    occlusion = { column = "visible", values = { full = 0, part = 1 } }

Needed are the salient variables of ``pemviz.pem.SALIENT_COLUMNS`` (without ``alpha_rad`` it follows
from place and rotation) and ``detected``. ``x_error_m`` and ``z_error_m`` count where detected;
``sequence``, ``frame``, ``track`` and ``rate_hz`` make a table of tracks of it.
"""

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pemviz.config.records import read_record
from pemviz.errors import ConfigError, PemError
from pemviz.files.text_files import open_text
from pemviz.pem.data.collect import CollectedCounts, write_table
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN, TRACK_COLUMNS
from pemviz.pem.models.protocol import SALIENT_COLUMNS, check_rows

Separator = Literal[",", ";", "tab", "whitespace"]
SEPARATORS: Mapping[Separator, str | None] = {",": ",", ";": ";", "tab": "\t", "whitespace": None}
ALPHA = "alpha_rad"
NEEDED = (*(name for name in SALIENT_COLUMNS if name != ALPHA), OUTCOME_COLUMN)
KNOWN = (*NEEDED, ALPHA, *PLANE_COLUMNS, *TRACK_COLUMNS)
LARGEST_BYTES = 1_000_000
MOST_LISTED = 20

Cells = Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class FileShape:
    """How one file of a log is written."""

    separator: Separator = ","
    header: tuple[str, ...] = ()
    """Names of the columns where the file itself has none."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a column's values come from: times * value + plus."""

    column: str
    times: float = 1.0
    """For other units, or the other direction."""
    plus: float = 0.0
    """In the table's unit."""
    values: Mapping[str, float] = field(default_factory=dict[str, float])
    """What stands for each text; numbers are read as they are without it."""


@dataclass(frozen=True)
class ColumnMapping:
    """How the files of a log are written, and where each column of the table is from."""

    labels: FileShape
    detections: FileShape
    columns: Mapping[str, Source | float]


def read_mapping(path: Path) -> ColumnMapping:
    """Read a mapping.

    Raises:
        PemError: it cannot be read, or a line of it says what, where and what is allowed.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES)
        table = tomllib.loads(content.decode("utf-8"))
        if unknown := set(table) - {"labels", "detections", "columns"}:
            message = f"{min(unknown)}: must be labels, detections or columns"
            raise ConfigError(message)
        columns = _columns(table.get("columns"))
        shapes = [
            read_record(FileShape, table.get(name, {}), name=name)
            for name in ("labels", "detections")
        ]
    except OSError as error:
        raise PemError(f"mapping {path}: cannot be read ({error.strerror or error})") from None
    except (ConfigError, ValueError, RecursionError) as error:
        raise PemError(f"mapping {path}: {error}") from None
    return ColumnMapping(labels=shapes[0], detections=shapes[1], columns=columns)


def _columns(given: object) -> Mapping[str, Source | float]:
    table: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
    if missing := [name for name in NEEDED if name not in table]:
        message = f"columns: lacks {', '.join(missing)}"
        raise ConfigError(message)
    found: dict[str, Source | float] = {}
    for name, value in table.items():
        if name not in KNOWN:
            message = f"columns.{name}: must be one of {', '.join(KNOWN)}"
            raise ConfigError(message)
        if isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = float(value)
        else:
            source = {"column": value} if isinstance(value, str) else value
            found[name] = read_record(Source, source, name=f"columns.{name}")
    tracked = [name for name in TRACK_COLUMNS if name in found]
    if tracked and len(tracked) < len(TRACK_COLUMNS):
        message = f"columns: of {', '.join(TRACK_COLUMNS)} all or none, here {', '.join(tracked)}"
        raise ConfigError(message)
    return found


@dataclass
class LogCounts(CollectedCounts):
    """What was in a log."""

    obstacles: int = 0


def collect_log(
    *, labels: Path, detections: Path, mapping: Path, out: Path, skip_bad: bool = False
) -> LogCounts:
    """Write a row for each of a log's, to a CSV that is complete or not there.

    ``labels`` and ``detections`` are the log twice, or its file of obstacles and what the detector
    made of each, row by row. Malformed rows are counted and passed over if ``skip_bad``.

    Raises:
        PemError: naming file, line and column of what is malformed, or what is missing.
    """
    plan, counts, lines = read_mapping(mapping), LogCounts(), list[str]()
    on_bad_line = counts.on_bad_line(skip_bad=skip_bad)
    written = [name for name in (*TRACK_COLUMNS, *SALIENT_COLUMNS, OUTCOME_COLUMN, *PLANE_COLUMNS)
               if name in plan.columns or name == ALPHA]  # fmt: skip
    for where, cells in _rows(plan, labels, detections):
        try:
            row = _row(plan, cells, where)
        except PemError as error:
            on_bad_line(error)
            continue
        counts.obstacles += 1
        counts.missed += row[OUTCOME_COLUMN] == "0"
        lines.append(",".join(row[name] for name in written))
    write_table(out, written, lines)
    return counts


def _rows(plan: ColumnMapping, labels: Path, detections: Path) -> Iterator[tuple[str, Cells]]:
    """Where each row stands, and its cells by name; of two files side by side."""
    if labels == detections:
        yield from _file_rows(labels, plan.labels)
        return
    own, others = (list(_file_rows(*file)) for file in
                   ((labels, plan.labels), (detections, plan.detections)))  # fmt: skip
    if len(own) != len(others):
        raise PemError(f"{detections}: {len(others)} rows, but {len(own)} in {labels}")
    for (where, first), (_, second) in zip(own, others, strict=True):
        yield where, {**first, **second}


def _file_rows(path: Path, shape: FileShape) -> Iterator[tuple[str, Cells]]:
    separator, header = SEPARATORS[shape.separator], list[str](shape.header)
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = [cell.strip() for cell in line.strip("\r\n").split(separator)]
            if not header:
                header = cells
                continue
            if len(cells) != len(header):
                wanted = f"{len(cells)} columns where {len(header)} are needed"
                raise PemError(f"{path}:{number}: {wanted}")
            yield f"{path}:{number}", dict(zip(header, cells, strict=True))


def _row(plan: ColumnMapping, cells: Cells, where: str) -> dict[str, str]:
    columns, texts = plan.columns, dict[str, str]()
    for name in TRACK_COLUMNS:
        if name in columns:
            source = columns[name]
            is_column = isinstance(source, Source)
            texts[name] = _cell(source, cells, where) if is_column else f"{source:g}"
    values = {
        name: _value(columns[name], name, cells, where)
        for name in (*SALIENT_COLUMNS, OUTCOME_COLUMN)
        if name in columns
    }
    if values[OUTCOME_COLUMN] not in (0.0, 1.0):
        raise PemError(f"{where}: detected is {values[OUTCOME_COLUMN]:g}, allowed: 0 or 1")
    if ALPHA not in values:
        turned = values["rotation_y_rad"] - math.atan2(values["x_m"], values["z_m"])
        values[ALPHA] = math.remainder(turned, 2.0 * math.pi)
    try:
        check_rows(np.array([[values[name] for name in SALIENT_COLUMNS]]))
    except PemError as error:
        raise PemError(f"{where}: {str(error).removeprefix('salient row 0: ')}") from None
    texts |= {name: f"{value:.10g}" for name, value in values.items()}
    for name in PLANE_COLUMNS:
        if name in columns:
            is_hit = values[OUTCOME_COLUMN] == 1.0
            texts[name] = f"{_value(columns[name], name, cells, where):.6g}" if is_hit else ""
    return texts


def _cell(source: Source, cells: Cells, where: str) -> str:
    if source.column not in cells:
        names = ", ".join(list(cells)[:MOST_LISTED])
        raise PemError(f"{where}: no column {source.column!r}, there are: {names}")
    return cells[source.column]


def _value(source: Source | float, name: str, cells: Cells, where: str) -> float:
    """A number of the table, in its unit."""
    if not isinstance(source, Source):
        return source
    text = _cell(source, cells, where)
    read: Callable[[str], float] = source.values.__getitem__ if source.values else float
    try:
        value = source.times * read(text) + source.plus
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        listed = ", ".join(list(source.values)[:MOST_LISTED])
        allowed = f"one of {listed}" if listed else "a number"
        raise PemError(
            f"{where}: {source.column}, for {name}, is {text[:40]!r}, allowed: {allowed}"
        )
    return value
