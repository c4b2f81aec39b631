"""The tables that perception error models learn from: one obstacle a row, and was it detected.

In a table of tracks obstacles are followed over time: who was seen when.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import open_text, read_numbers
from pemviz.pem.models.protocol import SALIENT_COLUMNS, check_rows

OUTCOME_COLUMN = "detected"
INPUTS_FILE = "salient_inputs.txt"
LABELS_FILE = "salient_labels.txt"
RATE_COLUMN = "rate_hz"
TRACK_COLUMNS = ("sequence", "frame", "track", RATE_COLUMN)
REQUIRED = ("sequence", "frame", "track", OUTCOME_COLUMN)


@dataclass(frozen=True, eq=False)
class SalientTable:
    """Obstacles and what a detector made of them.

    Attributes:
        salient: Salient variables ``[n, 11]``.
        detected: Outcomes ``[n]``.
        source: Where the table comes from, in words.
        sequence: Which sequence of video each is from ``[n]``; ``None``: obstacles stand alone.
    """

    salient: FloatArray
    detected: BoolArray
    source: str
    sequence: IntArray | None = None

    def __len__(self) -> int:
        return len(self.detected)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the values."""
        digest = hashlib.sha256(np.ascontiguousarray(self.salient).tobytes())
        digest.update(self.detected.astype(np.uint8).tobytes())
        return digest.hexdigest()

    def check_outcomes(self) -> None:
        """Whether some were detected and some missed, without which no model has finite logits.

        Raises:
            PemError: All have the same outcome.
        """
        if self.detected.all() or not self.detected.any():
            outcome = "detected" if self.detected.all() else "missed"
            raise PemError(f"{self.source}: all {len(self)} obstacles were {outcome}")

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
        for name in (INPUTS_FILE, LABELS_FILE):
            if not is_file(path / name):
                raise PemError(f"{path / name}: no such file")
        salient = read_numbers(path / INPUTS_FILE, separator=None, columns=SALIENT_COLUMNS)
        labels = (OUTCOME_COLUMN, *(f"column {index}" for index in range(2, 10)))
        detected = read_numbers(path / LABELS_FILE, separator=None, columns=labels)[:, 0]
        if len(salient) != len(detected):
            raise PemError(f"{path}: {len(salient)} rows of inputs but {len(detected)} of labels")
    elif path.suffix == ".csv" and is_file(path):
        header = csv_header(path)
        wanted = (*SALIENT_COLUMNS, OUTCOME_COLUMN)
        CsvTable(path, header, ()).check_header(*wanted)
        picked = tuple(header.index(name) for name in wanted)
        values = read_numbers(path, separator=",", columns=header, picked=picked, skip_lines=1)
        salient, detected = values[:, :-1], values[:, -1]
        if {"sequence", "track"} <= set(header):
            sequence = read_csv(path).labels("sequence")
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


def csv_header(path: Path) -> tuple[str, ...]:
    """Names of a CSV's columns.

    Raises:
        PemError: It cannot be read.
    """
    with open_text(path) as stream:
        return tuple(name.strip() for name in stream.readline().split(","))


def save_table(table: SalientTable, path: Path) -> None:
    """Write the table as CSV, with as many digits as reading it back exactly needs."""
    lines = [",".join((*SALIENT_COLUMNS, OUTCOME_COLUMN))]
    for row, outcome in zip(table.salient.tolist(), table.detected.tolist(), strict=True):
        lines.append(",".join([*(f"{value!r}".removesuffix(".0") for value in row), str(+outcome)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class CsvTable:
    """A CSV's header, and number and cells of each line that is neither blank nor a comment."""

    path: Path
    header: Sequence[str]
    lines: Sequence[tuple[int, Sequence[str]]]

    def check_header(self, *wanted: str) -> None:
        """Whether all columns are there that are wanted.

        Raises:
            PemError: Some are not.
        """
        if missing := [name for name in wanted if name not in self.header]:
            raise PemError(f"{self.path}:1: the header lacks {', '.join(missing)}")

    def labels(self, name: str) -> IntArray:
        """What a column names ``[n]``, counted from 0 in the order of the names."""
        return np.unique(self.texts(name), return_inverse=True)[1].astype(np.int64)

    def texts(self, name: str) -> NDArray[np.str_]:
        """A column as it is written ``[n]``."""
        column = self.header.index(name)
        return np.array([cells[column] for _, cells in self.lines])

    def numbers(self, name: str, *, largest: float | None = None) -> FloatArray:
        """A column's numbers ``[n]``, none beyond the largest if there is one.

        Raises:
            PemError: naming line and column of what is no number, or too large.
        """
        column, values = self.header.index(name), np.empty(len(self.lines))
        allowed = "not a number"
        if largest is not None:
            allowed = f"allowed: a number from {-largest:g} to {largest:g}"
        for row, (line, cells) in enumerate(self.lines):
            try:
                values[row] = float(cells[column])
                wrong = largest is not None and not abs(values[row]) <= largest
            except ValueError:
                wrong = True
            if wrong:
                where = f"{self.path}:{line}: column {column + 1} ({name})"
                raise PemError(f"{where} is {cells[column]!r}, {allowed}")
        return values


def read_csv(path: Path) -> CsvTable:
    """Read a CSV as text.

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
    return CsvTable(path, header, lines)


@dataclass(frozen=True, eq=False)
class TrackTable:
    """Observations in the order of sequence, track and frame.

    Attributes:
        obstacles: The n observations as a table that error models learn from.
        sequence: Which sequence each belongs to, ``[n]``, counted from 0.
        track: Which obstacle, ``[n]``, counted from 0 over all sequences.
        frame: ``[n]``, as labelled.
        rate_hz: Frames a second, ``[n]``.
        has_state: Whether the salient variables are known; else they are all 0.
    """

    obstacles: SalientTable
    sequence: IntArray
    track: IntArray
    frame: IntArray
    rate_hz: FloatArray
    has_state: bool = True

    def __len__(self) -> int:
        return len(self.obstacles)

    @property
    def detected(self) -> BoolArray:
        """Outcomes ``[n]``."""
        return self.obstacles.detected

    def only(self, rows: BoolArray) -> "TrackTable":
        """The table of these observations ``[n]``, tracks and sequences numbered as before."""
        return replace(
            self,
            obstacles=self.obstacles.take(np.flatnonzero(rows)),
            sequence=self.sequence[rows],
            track=self.track[rows],
            frame=self.frame[rows],
            rate_hz=self.rate_hz[rows],
        )

    @cached_property
    def follows(self) -> BoolArray:
        """Whether the row before is of the same track, ``[n]``."""
        same = np.zeros(len(self), dtype=np.bool_)
        same[1:] = self.track[1:] == self.track[:-1]
        return same

    @cached_property
    def by_place(self) -> list[IntArray]:
        """Rows in the order in which outcomes follow each other; see :func:`rows_by_place`."""
        return rows_by_place(np.flatnonzero(~self.follows), count=len(self))

    @cached_property
    def since_s(self) -> FloatArray:
        """Time since the track's observation before [s], ``[n]``; infinite at its first."""
        frames = np.diff(self.frame, prepend=self.frame[:1]).astype(np.float64)
        return np.where(self.follows, frames / self.rate_hz, np.inf)

    @cached_property
    def missed_before(self) -> BoolArray:
        """Whether the track's observation before was missed, ``[n]``; false at its first."""
        before = np.zeros(len(self), dtype=np.bool_)
        before[1:] = ~self.detected[:-1]
        return before & self.follows

    @property
    def gaps(self) -> int:
        """How often a track goes on after frames in which it was not observed."""
        frames = np.diff(self.frame, prepend=self.frame[:1])
        return int(np.count_nonzero(self.follows & (frames > 1)))

    @property
    def rate_changes(self) -> int:
        """How often the rate changes within a track."""
        changed = np.diff(self.rate_hz, prepend=self.rate_hz[:1]) != 0.0
        return int(np.count_nonzero(changed & self.follows))


def rows_by_place(starts: IntArray, *, count: int) -> list[IntArray]:
    """The first rows of all tracks, then the second of those that go on, and so forth.

    Tracks of ``count`` rows begin at ``starts [K]``, ascending.
    """
    place = np.arange(count) - np.repeat(starts, np.diff(np.append(starts, count)))
    order = np.argsort(place, kind="stable")
    return np.split(order, np.searchsorted(place[order], np.arange(1, int(place.max()) + 1)))


def track_table(
    *,
    salient: FloatArray,
    detected: BoolArray,
    sequence: NDArray[np.str_] | IntArray,
    track: NDArray[np.str_] | IntArray,
    frame: IntArray,
    rate_hz: FloatArray,
    source: str,
    has_state: bool = True,
) -> TrackTable:
    """Observations ``[n]`` in any order as a table in order.

    Sequences and tracks are names or numbers, a track's its own within its sequence; the rest is as
    in :class:`TrackTable`, salient variables ``[n, 11]``.

    Raises:
        PemError: A track is observed twice in a frame.
    """
    sequences, of_sequence = np.unique(sequence, return_inverse=True)
    tracks, of_track = np.unique(track, return_inverse=True)
    pair = of_sequence.astype(np.int64) * tracks.size + of_track
    _, one_track = np.unique(pair, return_inverse=True)
    order = np.lexsort((frame, one_track))
    ordered = of_sequence[order].astype(np.int64)
    table = TrackTable(
        obstacles=SalientTable(salient[order], detected[order], source, sequence=ordered),
        sequence=ordered,
        track=one_track[order].astype(np.int64),
        frame=frame[order],
        rate_hz=rate_hz[order],
        has_state=has_state,
    )
    twice = table.follows & (np.diff(table.frame, prepend=-1) == 0)
    if twice.any():
        row = int(np.argmax(twice))
        who, where = tracks[of_track[order[row]]], sequences[of_sequence[order[row]]]
        raise PemError(
            f"{source}: track {who} of sequence {where} is there twice in frame {table.frame[row]}"
        )
    return table


def load_tracks(
    path: Path | str, *, rate_hz: float | None = None, needs_state: bool = True
) -> TrackTable:
    """Read a CSV with sequence, frame, track, the salient columns and the outcome.

    Args:
        path: as ``pemviz pem collect`` writes it of sequences, or one of the user's own.
        rate_hz: frames a second where the table has no column ``rate_hz``.
        needs_state: whether the salient columns must be there; else a table without any of them
            will do.

    Raises:
        PemError: the file is missing or malformed; the message names file, line and column.
    """
    path = Path(path)
    if not is_file(path):
        raise PemError(f"{path}: no such table of tracks")
    csv = read_csv(path)
    has_state = needs_state or any(name in csv.header for name in SALIENT_COLUMNS)
    state = SALIENT_COLUMNS if has_state else ()
    csv.check_header(*REQUIRED, *state)
    if RATE_COLUMN not in csv.header and rate_hz is None:
        raise PemError(f"{path}:1: the header lacks {RATE_COLUMN}; give the rate of the frames")
    number = {name: csv.numbers(name) for name in ("frame", OUTCOME_COLUMN, *state)}
    rates = np.full(len(csv.lines), rate_hz)
    if RATE_COLUMN in csv.header:
        rates = csv.numbers(RATE_COLUMN)
    nothing = np.zeros(len(csv.lines))
    salient = np.stack([number.get(name, nothing) for name in SALIENT_COLUMNS], axis=1)
    _check(path, number, rates, salient)
    return track_table(
        salient=salient,
        detected=number[OUTCOME_COLUMN] == 1.0,
        sequence=csv.texts("sequence"),
        track=csv.texts("track"),
        frame=number["frame"].astype(np.int64),
        rate_hz=rates,
        source=path.stem,
        has_state=has_state,
    )


def _check(
    path: Path, number: dict[str, FloatArray], rates: FloatArray, salient: FloatArray
) -> None:
    if len(salient) == 0:
        raise PemError(f"{path}: the table has no rows")
    if not np.isin(number[OUTCOME_COLUMN], (0.0, 1.0)).all():
        raise PemError(f"{path}: column {OUTCOME_COLUMN!r} must hold 0 or 1 only")
    if not ((rates > 0.0) & np.isfinite(rates)).all():
        raise PemError(f"{path}: column {RATE_COLUMN!r} must be above 0 and finite")
    frame = number["frame"]
    if not ((frame >= 0.0) & (frame == np.floor(frame)) & (frame < 2.0**53)).all():
        raise PemError(f"{path}: column 'frame' must hold whole numbers from 0 on")
    try:
        check_rows(salient)
    except PemError as error:
        raise PemError(f"{path}: {error}") from None
