"""From somebody's own log to the table that models learn from, by a mapping of columns."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pemviz.errors import PemError
from pemviz.files.text_files import open_text
from pemviz.pem.data.collected import CollectedCounts, write_table
from pemviz.pem.data.column_mapping import (
    ALPHA,
    SEPARATORS,
    ColumnMapping,
    FileShape,
    Source,
    read_mapping,
)
from pemviz.pem.data.position_errors import PLANE_COLUMNS, TRACK_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN
from pemviz.pem.models.encoding import check_rows
from pemviz.pem.models.protocol import SALIENT_COLUMNS

Cells = Mapping[str, str]


@dataclass
class LogCounts(CollectedCounts):
    """What was in a log."""

    obstacles: int = 0
    """Rows written."""


def collect_log(
    *, labels: Path, detections: Path, mapping: Path, out: Path, skip_bad: bool = False
) -> LogCounts:
    """Write a row for each of a log's.

    Args:
        labels: The log; or its file of obstacles.
        detections: The same file; or what the detector made of each, row by row.
        mapping: Where the columns are, see ``pemviz.pem.data.column_mapping``.
        out: CSV to write; complete or not there.
        skip_bad: Whether malformed rows are counted and passed over.

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
    """A row's texts by column of the table.

    Raises:
        PemError: a value is missing or not allowed.
    """
    columns = plan.columns
    texts = {name: _text(columns[name], cells, where) for name in TRACK_COLUMNS if name in columns}
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


def _text(source: Source | float, cells: Cells, where: str) -> str:
    """A name or number that is written as it is."""
    if not isinstance(source, Source):
        return f"{source:g}"
    return _cell(source, cells, where)


def _cell(source: Source, cells: Cells, where: str) -> str:
    if source.column not in cells:
        raise PemError(f"{where}: no column {source.column!r}, there are: {_listed(list(cells))}")
    return cells[source.column]


def _value(source: Source | float, name: str, cells: Cells, where: str) -> float:
    """A number of the table, in its unit.

    Raises:
        PemError: There is none in the log.
    """
    if not isinstance(source, Source):
        return source
    text = _cell(source, cells, where)
    read: Callable[[str], float] = source.values.__getitem__ if source.values else float
    try:
        value = source.times * read(text) + source.plus
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        allowed = f"one of {_listed(list(source.values))}" if source.values else "a number"
        raise PemError(
            f"{where}: {source.column}, for {name}, is {text[:40]!r}, allowed: {allowed}"
        )
    return value


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:20])
