"""A log's rows in batches of columns, so that memory does not grow with the log.

Text with any of four separators, JSON lines (.jsonl, .ndjson; what is nested is named a.b),
parquet, Arrow (.arrow, .feather): by the ending of the file's name.
"""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.json_text import parse_json
from pemviz.files.text_files import check_columns, open_text
from pemviz.pem.data.columns import Columns, check_header, readable, split_cells, text_of

Separator = Literal[",", ";", "tab", "whitespace"]
SEPARATORS: Mapping[Separator, str | None] = {",": ",", ";": ";", "tab": "\t", "whitespace": None}
ROWS = 50_000
"""Of a batch."""
JSON_LINES = (".jsonl", ".ndjson")
ARROW = (".arrow", ".feather")
DEEPEST = 8
"""Levels of a JSON object that are looked into."""


@dataclass(frozen=True, kw_only=True)
class FileShape:
    """How one file of a log is written."""

    separator: Separator = ","
    header: tuple[str, ...] = ()
    """Names of the columns where the file itself has none."""


@dataclass(frozen=True)
class LogBatch:
    """Rows that follow each other in a log.

    Attributes:
        done: Share of the log that is read with them.
    """

    rows: Columns
    done: float


def log_batches(
    labels: tuple[Path, FileShape],
    detections: tuple[Path, FileShape],
    *,
    wanted: Collection[str],
    rows: int = ROWS,
) -> Iterator[LogBatch]:
    """The rows of one file, or of two side by side, whose columns are then of both.

    Only ``wanted`` columns are read where a file's form allows that; those that it has.

    Raises:
        PemError: A file is missing, empty or malformed, or two differ in length.
    """
    first = _file_batches(*labels, wanted=wanted, rows=rows)
    if labels == detections:
        yield from first
        return
    second = _file_batches(*detections, wanted=wanted, rows=rows)
    counts = [0, 0]
    for own, other in zip_longest(first, second):
        lengths = [0 if each is None else len(each.rows) for each in (own, other)]
        counts = [total + length for total, length in zip(counts, lengths, strict=True)]
        if own is None or other is None or lengths[0] != lengths[1]:
            counts[0] += sum(len(each.rows) for each in first)
            counts[1] += sum(len(each.rows) for each in second)
            raise PemError(f"{detections[0]}: {counts[1]} rows, but {counts[0]} in {labels[0]}")
        yield LogBatch(_beside(own.rows, other.rows), own.done)


def _beside(first: Columns, second: Columns) -> Columns:
    """Rows of two files side by side; of two columns of a name the second's."""
    import pyarrow as pa  # noqa: PLC0415  slow to import

    columns = {name: first.table.column(name) for name in first.header}
    columns |= {name: second.table.column(name) for name in second.header}
    return Columns(first.path, tuple(columns), pa.table(columns), first.lines, first.is_text)


def _file_batches(
    path: Path, shape: FileShape, *, wanted: Collection[str], rows: int
) -> Iterator[LogBatch]:
    if path.suffix in (".parquet", *ARROW):
        yield from _binary_batches(path, wanted=wanted, rows=rows)
        return
    import pyarrow as pa  # noqa: PLC0415  slow to import

    size = max(path.stat().st_size, 1) if is_file(path) else 1
    read = _json_rows(path) if path.suffix in JSON_LINES else _text_rows(path, shape)
    is_empty = True
    while taken := list(islice(read, rows)):
        is_empty = False
        names = dict.fromkeys(name for header in {row.names for row in taken} for name in header)
        if len({row.names for row in taken}) == 1:
            by_column = zip(*(row.cells for row in taken), strict=True)
            columns = {name: _array(cells) for name, cells in zip(names, by_column, strict=True)}
        else:
            entries = [dict(zip(row.names, row.cells, strict=True)) for row in taken]
            columns = {name: _array([entry.get(name) for entry in entries]) for name in names}
        lines = np.array([row.line for row in taken], dtype=np.int64)
        found = Columns(path, tuple(columns), pa.table(columns), lines)
        yield LogBatch(found, min(taken[-1].place / size, 1.0))
    if is_empty:
        raise PemError(f"{path}: no rows")


class _Row(NamedTuple):
    """A row of text.

    Attributes:
        line: Of the file, counted from 1.
        place: Characters read with it.
    """

    line: int
    place: int
    names: tuple[str, ...]
    cells: Sequence[object]


def _array(cells: Sequence[object]) -> Any:
    """What cells hold; texts beside numbers make texts of all."""
    import pyarrow as pa  # noqa: PLC0415  slow to import

    try:
        return pa.array(cells)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        return pa.array([text_of(cell) for cell in cells])


def _text_rows(path: Path, shape: FileShape) -> Iterator[_Row]:
    separator, header = SEPARATORS[shape.separator], shape.header
    place = 0
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            place += len(line)
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = split_cells(line, separator)
            if not header:
                header = tuple(cells)
                given = f", not by {shape.separator!r}: say which in [labels] or [detections]"
                check_header(header, f"{path}:{number}", remedy=f"{given}, separator")
                continue
            check_columns(cells, header, where=f"{path}:{number}")
            yield _Row(number, place, header, cells)


def _json_rows(path: Path) -> Iterator[_Row]:
    place = 0
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            place += len(line)
            if not line.strip():
                continue
            try:
                entry: Any = parse_json(line)
            except json.JSONDecodeError as error:
                raise PemError(f"{path}:{number}: column {error.colno}: {error.msg}") from None
            except ValueError as error:
                raise PemError(f"{path}:{number}: {error}") from None
            if not isinstance(entry, dict):
                raise PemError(f"{path}:{number}: not an object")
            flat = dict(_flat(entry))
            yield _Row(number, place, tuple(flat), tuple(flat.values()))


def _flat(entry: Mapping[str, Any], prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    for name, value in entry.items():
        if isinstance(value, dict) and depth < DEEPEST:
            yield from _flat(value, f"{prefix}{name}.", depth + 1)
        else:
            yield f"{prefix}{name}", value


def _binary_batches(path: Path, *, wanted: Collection[str], rows: int) -> Iterator[LogBatch]:
    import pyarrow as pa  # noqa: PLC0415  slow to import

    done = 0
    with readable(path):
        for batch, total in _record_batches(path, wanted, rows):
            if batch.num_rows == 0:
                continue
            batch.validate(full=True)  # a damaged file may point outside of itself
            table = pa.Table.from_batches([batch])
            if len(set(table.column_names)) < len(table.column_names):
                raise PemError(f"{path}: a column stands twice")
            lines = np.arange(done + 1, done + batch.num_rows + 1)
            done += batch.num_rows
            columns = Columns(path, tuple(table.column_names), table, lines, is_text=False)
            yield LogBatch(columns, done / max(total, 1))
    if done == 0:
        raise PemError(f"{path}: no rows")


def _record_batches(path: Path, wanted: Collection[str], rows: int) -> Iterator[tuple[Any, int]]:
    """Batches of a file, and how many rows it has."""
    from pyarrow import ipc, parquet  # noqa: PLC0415  slow to import

    if path.suffix == ".parquet":
        with parquet.ParquetFile(path) as file:
            names = [name for name in file.schema_arrow.names if name in wanted]
            names = names or list(file.schema_arrow.names)
            for batch in file.iter_batches(batch_size=rows, columns=names, use_threads=False):
                yield batch, file.metadata.num_rows
        return
    import pyarrow as pa  # noqa: PLC0415

    with pa.memory_map(str(path)) as source, ipc.open_file(source) as file:
        total = 0
        for index in range(file.num_record_batches):
            whole = file.get_batch(index)
            total += whole.num_rows
            for start in range(0, whole.num_rows, rows):
                share = (index + 1) / file.num_record_batches
                yield whole.slice(start, rows), round(total / share)
