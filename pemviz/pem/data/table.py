"""The table that perception error models learn from: one obstacle a row, and was it detected."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import open_text, read_numbers
from pemviz.pem.models.encoding import check_rows
from pemviz.pem.models.protocol import SALIENT_COLUMNS

OUTCOME_COLUMN = "detected"
INPUTS_FILE = "salient_inputs.txt"
LABELS_FILE = "salient_labels.txt"


@dataclass(frozen=True, eq=False)
class SalientTable:
    """Obstacles and what a detector made of them."""

    salient: FloatArray
    """Salient variables, shape [n, 11]."""
    detected: BoolArray
    """Outcomes, shape [n]."""
    source: str
    """Where the table comes from, in words."""
    sequence: IntArray | None = None
    """Which sequence of video each obstacle is from, shape [n]; None: obstacles stand alone."""

    def __len__(self) -> int:
        """Number of obstacles n."""
        return len(self.detected)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the values."""
        digest = hashlib.sha256(np.ascontiguousarray(self.salient).tobytes())
        digest.update(self.detected.astype(np.uint8).tobytes())
        return digest.hexdigest()

    def take(self, rows: IntArray) -> "SalientTable":
        """The table of the given rows, in that order, repeats allowed."""
        sequence = None if self.sequence is None else self.sequence[rows]
        return SalientTable(self.salient[rows], self.detected[rows], self.source, sequence)


def load_table(path: Path | str) -> SalientTable:
    """Read a table: a CSV as ``pemviz pem collect`` writes it, or the authors' folder of two files.

    Raises:
        PemError: the file is missing or malformed; the message names file, line and column.
    """
    path = Path(path)
    sequence = None
    if is_folder(path):
        salient, detected = _read_folder(path)
    elif path.suffix == ".csv" and is_file(path):
        salient, detected = _read_csv(path)
        sequence = _sequences(path)
    else:
        raise PemError(
            f"{path}: no table; need a .csv of 'pemviz pem collect' or a folder with "
            f"{INPUTS_FILE} and {LABELS_FILE}"
        )
    try:
        check_rows(salient)
    except PemError as error:
        raise PemError(f"{path}: {error}") from None
    if not np.isin(detected, (0.0, 1.0)).all():
        raise PemError(f"{path}: column {OUTCOME_COLUMN!r} must hold 0 or 1 only")
    if len(detected) == 0:
        raise PemError(f"{path}: the table has no rows")
    return SalientTable(salient, detected == 1.0, source=path.stem, sequence=sequence)


def save_table(table: SalientTable, path: Path) -> None:
    """Write the table as CSV, with as many digits as reading it back exactly needs."""
    lines = [",".join((*SALIENT_COLUMNS, OUTCOME_COLUMN))]
    for row, outcome in zip(table.salient.tolist(), table.detected.tolist(), strict=True):
        lines.append(",".join([*(f"{value!r}".removesuffix(".0") for value in row), str(+outcome)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _read_folder(folder: Path) -> tuple[FloatArray, FloatArray]:
    for name in (INPUTS_FILE, LABELS_FILE):
        if not is_file(folder / name):
            raise PemError(f"{folder / name}: no such file")
    salient = read_numbers(folder / INPUTS_FILE, separator=None, columns=SALIENT_COLUMNS)
    labels = (OUTCOME_COLUMN, *(f"column {index}" for index in range(2, 10)))
    detected = read_numbers(folder / LABELS_FILE, separator=None, columns=labels)[:, 0]
    if len(salient) != len(detected):
        raise PemError(f"{folder}: {len(salient)} rows of inputs but {len(detected)} of labels")
    return salient, detected


def _read_csv(path: Path) -> tuple[FloatArray, FloatArray]:
    with open_text(path) as stream:
        header = tuple(name.strip() for name in stream.readline().split(","))
    wanted = (*SALIENT_COLUMNS, OUTCOME_COLUMN)
    missing = [name for name in wanted if name not in header]
    if missing:
        raise PemError(f"{path}:1: the header lacks {', '.join(missing)}")
    picked = tuple(header.index(name) for name in wanted)
    values = read_numbers(path, separator=",", columns=header, picked=picked, skip_lines=1)
    return values[:, :-1], values[:, -1]


def _sequences(path: Path) -> IntArray | None:
    """Numbers of the sequences in a table of tracks; None in another."""
    with open_text(path) as stream:
        header = [name.strip() for name in stream.readline().split(",")]
    if not {"sequence", "track"} <= set(header):
        return None
    _, lines = read_cells(path)
    column = header.index("sequence")
    _, numbers = np.unique([cells[column] for _, cells in lines], return_inverse=True)
    return numbers.astype(np.int64)


def read_cells(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """A CSV's header, and line number and cells of each line that is neither blank nor a comment.

    Raises:
        PemError: it cannot be read, or a line has not as many cells as the header.
    """
    with open_text(path) as stream:
        header = [name.strip() for name in stream.readline().split(",")]
        lines: list[tuple[int, list[str]]] = []
        for number, line in enumerate(stream, start=2):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = [cell.strip() for cell in line.split(",")]
            if len(cells) != len(header):
                raise PemError(
                    f"{path}:{number}: {len(cells)} columns where {len(header)} are needed"
                )
            lines.append((number, cells))
    return header, lines
