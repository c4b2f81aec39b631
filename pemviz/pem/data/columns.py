"""Tables by columns, from CSV, parquet or Arrow files: texts and numbers, and where each stands.

A CSV has a header and commas between cells; lines with # and blank ones are passed over. pyarrow
reads it where every line is a row; what it does not take is read line by line, which can say what
is wrong with which.
"""

import contextlib
import csv
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.text_files import check_columns, open_text

TABLE_SUFFIXES = (".csv", ".parquet", ".arrow", ".feather")
WHO_AND_WHEN = ("sequence", "track", "frame", "rate_hz", "time_s")
"""Columns that are read beside those that are asked for."""
BLOCK_BYTES = 1 << 23
TICKS_A_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
SHOWN = 40
"""Characters of a cell that a message repeats."""
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars"}
BY_COMMAS = (
    " ({!r}), must be by commas; a log with others is read by 'pemviz pem collect --format log'"
)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns by name, and where each row stands.

    Attributes:
        table: A ``pyarrow.Table``: texts of a CSV, of other files what they hold.
        lines: Line of each row ``[n]`` of a CSV, counted from 1; else its row, counted from 1.
        is_text: Whether it is a CSV.
    """

    path: Path
    header: tuple[str, ...]
    table: Any
    lines: IntArray
    is_text: bool = True

    def __len__(self) -> int:
        return len(self.lines)

    def place(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.path}{':' if self.is_text else ': row '}{self.lines[row]}"

    def where(self, row: int, name: str) -> str:
        """File, line and column of a cell, for messages."""
        column = f"column {self.header.index(name) + 1} ({name})" if self.is_text else name
        return f"{self.place(row)}: {column}"

    def only(self, rows: BoolArray) -> "Columns":
        """The columns of these rows ``[n]``."""
        return replace(self, table=self.table.filter(rows), lines=self.lines[rows])

    def texts(self, name: str) -> NDArray[np.str_]:
        """A column as it is written ``[n]``; of a number what names it."""
        names, place = self._distinct(name)
        return names[place]

    def labels(self, name: str) -> IntArray:
        """What a column names ``[n]``, counted from 0 in the order of the names."""
        names, place = self._distinct(name)
        return np.unique(names, return_inverse=True)[1].astype(np.int64)[place]

    def _distinct(self, name: str) -> tuple[NDArray[np.str_], IntArray]:
        """Texts that occur, and which of them each row has ``[n]``."""
        encoded = self.table.column(name).dictionary_encode("encode").combine_chunks()
        if not len(self):
            return np.array([], dtype=str), np.array([], dtype=np.int64)
        names = [text_of(cell) for cell in encoded.dictionary.to_pylist()]
        return np.array(names, dtype=str), encoded.indices.to_numpy(zero_copy_only=False)

    def numbers(self, name: str, *, largest: float | None = None) -> FloatArray:
        """A column's numbers ``[n]``, none beyond the largest if there is one.

        Raises:
            PemError: naming line and column of what is no number, or too large.
        """
        column = self.table.column(name)
        values, wrong = numbers_of(column)
        allowed = "not a number"
        if largest is not None:
            allowed = f"allowed: a number from {-largest:g} to {largest:g}"
            wrong = wrong | ~(np.abs(values) <= largest)
        if wrong.any():
            row = int(np.argmax(wrong))
            cell = text_of(column[row].as_py())[:SHOWN]
            raise PemError(f"{self.where(row, name)} is {cell!r}, {allowed}")
        return values


def text_of(cell: object) -> str:
    """A cell as text: whole numbers without a point, truth as true and false, nothing as empty."""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    if isinstance(cell, float) and cell.is_integer():
        return str(int(cell))
    return "" if cell is None else str(cell).strip()


def numbers_of(column: Any) -> tuple[FloatArray, BoolArray]:
    """Numbers ``[n]`` of a ``pyarrow`` column, and which cells are none; these are NaN.

    Time stamps become seconds.
    """
    import pyarrow as pa  # noqa: PLC0415  slow to import

    if pa.types.is_timestamp(column.type):
        values, wrong = numbers_of(column.cast(pa.int64()))
        return values / TICKS_A_SECOND[column.type.unit], wrong
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    is_whole = pa.types.is_integer(column.type)  # beyond 2^53 the nearest double serves
    try:
        values = column.cast(pa.float64(), safe=not is_whole).to_numpy()
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        return _numbers_by_cell(column.to_pylist())  # some are no numbers: it must be known which
    return np.asarray(values, dtype=np.float64), np.asarray(column.is_null().to_numpy())


def _numbers_by_cell(cells: Sequence[Any]) -> tuple[FloatArray, BoolArray]:
    values, wrong = np.full(len(cells), np.nan), np.zeros(len(cells), dtype=np.bool_)
    for row, each in enumerate(cells):
        cell = each.decode(errors="replace") if isinstance(each, bytes) else each
        try:
            values[row] = float(cell)
        except (TypeError, ValueError):
            wrong[row] = True
        if isinstance(cell, str) and "_" in cell:  # Python alone reads 1_5 as 15
            values[row], wrong[row] = np.nan, True
    return values, wrong


def table_header(path: Path) -> tuple[str, ...]:
    """Names of the columns of a CSV, parquet or Arrow file.

    Raises:
        PemError: It cannot be read.
    """
    if path.suffix in TABLE_SUFFIXES[1:]:
        return tuple(_read_binary(path, header_alone=True).column_names)
    with open_text(path) as stream:
        return tuple(split_cells(stream.readline(), ","))


def read_columns(path: Path, *needs: str) -> Columns:
    """Read a table that has these columns.

    Raises:
        PemError: It cannot be read, is empty, has not what it needs or a column twice, or a line
            has not as many cells as the header.
    """
    if path.suffix in TABLE_SUFFIXES[1:]:
        columns = _binary_columns(path, needs)
        check_needs(columns.header, needs, path)
        return columns
    header = table_header(path)
    if not any(header):
        raise PemError(f"{path}: the file is empty, or begins with an empty line")
    check_header(header, f"{path}:1", remedy=BY_COMMAS)
    check_needs(header, needs, path)
    fast = _fast_csv(path, header)
    return _csv_by_lines(path, header) if fast is None else fast


def split_cells(line: str, separator: str | None) -> list[str]:
    """A line's cells, without space around them and quotes about them; ``None``: white space."""
    line = line.strip("\r\n")
    if separator is not None and '"' in line and len(line) < csv.field_size_limit():
        with contextlib.suppress(csv.Error):
            return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return [cell.strip() for cell in line.split(separator)]


def check_needs(header: Sequence[str], needs: Sequence[str], path: Path) -> None:
    """Whether all columns are there that are needed.

    Raises:
        PemError: Some are not.
    """
    if missing := [name for name in needs if name not in header]:
        raise PemError(f"{path}:1: the header lacks {', '.join(missing)}")


def check_header(header: Sequence[str], where: str, *, remedy: str) -> None:
    """Whether a line of names is one, split as it is.

    Args:
        header: The names.
        where: File and line, for messages.
        remedy: What to do about other separators than those that it was split by; ``{}`` is theirs.

    Raises:
        PemError: It has a name twice, or other separators; one line says which.
    """
    if any("\0" in name for name in header):
        raise PemError(f"{where}: holds zero bytes, as UTF-16 does; must be UTF-8 text")
    if len(header) == 1:
        for separator, words in SEPARATORS.items():
            if separator in header[0]:
                raise PemError(
                    f"{where}: columns are separated by {words}{remedy.format(separator)}"
                )
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        raise PemError(f"{where}: column {twice!r} stands twice in the header")


def _fast_csv(path: Path, header: Sequence[str]) -> Columns | None:
    """By pyarrow, or nothing where a line is blank, a comment or of another count of cells."""
    import pyarrow as pa  # noqa: PLC0415  slow to import
    from pyarrow import compute  # noqa: PLC0415
    from pyarrow import csv as arrow_csv  # noqa: PLC0415

    try:
        table: Any = arrow_csv.read_csv(
            path,
            read_options=arrow_csv.ReadOptions(
                column_names=list(header), skip_rows=1, block_size=BLOCK_BYTES, use_threads=False
            ),
            parse_options=arrow_csv.ParseOptions(ignore_empty_lines=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(header, pa.string()), strings_can_be_null=False
            ),
        )
    except (pa.ArrowInvalid, OSError):
        return None
    functions: Any = compute
    first = functions.starts_with(functions.utf8_ltrim_whitespace(table.column(0)), "#")
    if functions.any(first).as_py() or len(header) == 1:
        return None
    return Columns(path, tuple(header), table, np.arange(2, len(table) + 2))


def _csv_by_lines(path: Path, header: Sequence[str]) -> Columns:
    import pyarrow as pa  # noqa: PLC0415  slow to import

    rows: list[list[str]] = []
    lines: list[int] = []
    for number, cells in _rows(path):
        check_columns(cells, header, where=f"{path}:{number}")
        rows.append(cells)
        lines.append(number)
    by_column = list(zip(*rows, strict=True)) or [()] * len(header)
    table = pa.table(
        {
            name: pa.array(list(cells), pa.string())
            for name, cells in zip(header, by_column, strict=True)
        }
    )
    return Columns(path, tuple(header), table, np.array(lines, dtype=np.int64))


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    with open_text(path) as stream:
        next(stream, None)
        for number, line in enumerate(stream, start=2):
            if line.strip() and not line.lstrip().startswith("#"):
                yield number, split_cells(line, ",")


def _binary_columns(path: Path, needs: Sequence[str]) -> Columns:
    there = table_header(path)
    wanted = [name for name in there if name in (*needs, *WHO_AND_WHEN)] if needs else None
    table = _read_binary(path, wanted)
    header = tuple(table.column_names)
    if len(set(header)) < len(header):
        raise PemError(f"{path}: a column stands twice")
    return Columns(path, header, table, np.arange(1, len(table) + 1), is_text=False)


def _read_binary(
    path: Path, wanted: Sequence[str] | None = None, *, header_alone: bool = False
) -> Any:
    from pyarrow import feather, parquet  # noqa: PLC0415  slow to import

    if not is_file(path):
        raise PemError(f"{path}: no such file")
    with readable(path):
        if path.suffix == ".parquet" and header_alone:
            return parquet.read_schema(path).empty_table()
        read: Any = parquet if path.suffix == ".parquet" else feather
        table = read.read_table(path, columns=wanted)
        table.validate(full=True)  # a damaged file may point outside of itself
        return table


@contextlib.contextmanager
def readable(path: Path) -> Generator[None]:
    """Let what pyarrow says of a damaged file be one line.

    Raises:
        PemError: It cannot be read.
    """
    import pyarrow as pa  # noqa: PLC0415  slow to import

    try:
        yield
    except (pa.ArrowException, OSError, ValueError, LookupError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PemError(f"{path}: not a readable {path.suffix} file ({reason})") from None
