"""Text files that a user names: opening, reading numbers, saying what could not be written."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import shorten
from typing import TextIO

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError


@contextmanager
def open_text(path: Path) -> Generator[TextIO, None, None]:
    """A file's text without a byte order mark, what is not UTF-8 replaced; line ends are kept.

    Raises:
        PemError: it is not there, or cannot be read.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as stream:
            yield stream
    except OSError as error:
        raise PemError(f"{path}: cannot be read ({error.strerror or error})") from None


@contextmanager
def writing(path: Path) -> Generator[None, None, None]:
    """What is written to ``path``, or below it.

    Raises:
        PemError: it cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise PemError(f"out = {path}: cannot be written ({error.strerror or error})") from None


def check_columns(
    cells: Sequence[str], names: Sequence[str], *, where: str, optional: int = 0
) -> None:
    """Refuse a line that does not have these columns, of which the last ``optional`` may be absent.

    Raises:
        PemError: How many there are, and which ones are needed.
    """
    least, most = len(names) - optional, len(names)
    if not least <= len(cells) <= most:
        needed = f"{least}{' or ' if optional == 1 else ' to '}{most}" if optional else f"{most}"
        given = "1 column" if len(cells) == 1 else f"{len(cells)} columns"
        needed += " is needed" if needed == "1" else " are needed"
        named = shorten(", ".join(names), 300, placeholder=" ...")
        raise PemError(f"{where}: {given} where {needed}: {named}")


def read_numbers(
    path: Path,
    *,
    separator: str | None,
    columns: tuple[str, ...],
    picked: tuple[int, ...] | None = None,
    skip_lines: int = 0,
) -> FloatArray:
    """Read a text table of numbers, shape [rows, picked columns]; lines with # are comments.

    Args:
        path: The file.
        separator: Between columns; ``None`` for white space.
        columns: Names of all columns, in order.
        picked: Which columns to read; ``None``: all.
        skip_lines: Header lines that are passed over.

    Raises:
        PemError: naming file, line and column of the first malformed value.
    """
    picked = tuple(range(len(columns))) if picked is None else picked
    values: list[list[float]] = []
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if number <= skip_lines or not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = line.strip().split(separator)
            check_columns(cells, columns, where=f"{path}:{number}")
            row: list[float] = []
            for index in picked:
                try:
                    row.append(float(cells[index]))
                except ValueError:
                    raise PemError(
                        f"{path}:{number}: column {index + 1} ({columns[index]}) is "
                        f"{cells[index]!r}, not a number"
                    ) from None
            values.append(row)
    return np.asarray(values, dtype=np.float64).reshape(-1, len(picked))
