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
from pemviz.files.text_files import read_numbers
from pemviz.pem.data.columns import TABLE_SUFFIXES, Columns, read_columns, table_header
from pemviz.pem.data.own_columns import bare_names, own_columns
from pemviz.pem.data.timing import (
    GAP,
    check_not_logged_again,
    check_not_twice,
    check_rates,
    clock_words,
    rates_of,
)
from pemviz.pem.data.units import check_plausible
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.protocol import SALIENT_COLUMNS, check_rows

OUTCOME_COLUMN = "detected"
INPUTS_FILE = "salient_inputs.txt"
LABELS_FILE = "salient_labels.txt"
RATE_COLUMN = "rate_hz"
TRACK_COLUMNS = ("sequence", "frame", "track", RATE_COLUMN)
JUDGED_ROWS = 200_000
"""Of a large table, among which frames that were logged again are looked for."""
TIME_COLUMN = "time_s"
"""Time stamps [s], which may stand in the place of frame and rate_hz."""


@dataclass(frozen=True, eq=False)
class SalientTable:
    """Obstacles and what a detector made of them.

    Attributes:
        salient: Salient variables ``[n, 11]``.
        detected: Outcomes ``[n]``.
        source: Where the table comes from, in words.
        sequence: Which sequence of video each is from ``[n]``; ``None``: obstacles stand alone.
        features: What the salient variables ``[n, D]`` are, where they are not a road user's.
    """

    salient: FloatArray
    detected: BoolArray
    source: str
    sequence: IntArray | None = None
    features: OwnFeatures | None = None

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
        return replace(
            self, salient=self.salient[rows], detected=self.detected[rows], sequence=sequence
        )


def load_table(path: Path | str, *, features: Sequence[str] = ()) -> SalientTable:
    """Read a table: as ``pemviz pem collect`` writes it, or the authors' folder of two files.

    A table is CSV, parquet or Arrow (.arrow, .feather). With ``features``, names of columns, it
    needs these and ``detected`` alone.

    Raises:
        PemError: the file is missing or malformed; the message names file, line and column.
    """
    path = Path(path)
    if not is_folder(path) and path.suffix in TABLE_SUFFIXES and is_file(path):
        needs = bare_names(features) if features else SALIENT_COLUMNS
        return _table_of_columns(read_columns(path, *needs, OUTCOME_COLUMN), features)
    if features:
        raise PemError(f"{path}: with features a table must be a {', '.join(TABLE_SUFFIXES)} file")
    if is_folder(path):
        for name in (INPUTS_FILE, LABELS_FILE):
            if not is_file(path / name):
                raise PemError(f"{path / name}: no such file")
        salient = read_numbers(path / INPUTS_FILE, separator=None, columns=SALIENT_COLUMNS)
        labels = (OUTCOME_COLUMN, *(f"column {index}" for index in range(2, 10)))
        detected = read_numbers(path / LABELS_FILE, separator=None, columns=labels)[:, 0]
        if len(salient) != len(detected):
            raise PemError(f"{path}: {len(salient)} rows of inputs but {len(detected)} of labels")
    else:
        raise PemError(
            f"{path}: no table; need a .csv of 'pemviz pem collect', a .parquet or .arrow file, or "
            f"a folder with {INPUTS_FILE} and {LABELS_FILE}"
        )
    return _checked_table(path, salient, detected, sequence=None)


def _table_of_columns(columns: Columns, features: Sequence[str]) -> SalientTable:
    """Rows of obstacles; where tracks are followed, none is there twice."""
    own: OwnFeatures | None = None
    if features:
        salient, own = own_columns(columns, features)
    else:
        salient = np.empty((len(columns), len(SALIENT_COLUMNS)))
        for index, name in enumerate(SALIENT_COLUMNS):
            salient[:, index] = columns.numbers(name)
    detected = columns.numbers(OUTCOME_COLUMN)
    sequence = columns.labels("sequence") if {"sequence", "track"} <= set(columns.header) else None
    table = _checked_table(columns.path, salient, detected, sequence=sequence, features=own)
    moment = next((name for name in (TIME_COLUMN, "frame") if name in columns.header), None)
    if sequence is not None and moment is not None:
        track, when = columns.labels("track"), columns.numbers(moment)
        check_not_twice(sequence, track, when, columns)
        order = np.lexsort((when, track, sequence))[:JUDGED_ROWS]
        follows = np.append(False, (np.diff(track[order]) == 0) & (np.diff(sequence[order]) == 0))
        check_not_logged_again(
            salient[order],
            table.detected[order],
            follows=follows,
            frame=np.arange(len(order)),
            where=str(columns.path),
        )
    return table


def _checked_table(
    path: Path,
    salient: FloatArray,
    detected: FloatArray,
    *,
    sequence: IntArray | None,
    features: OwnFeatures | None = None,
) -> SalientTable:
    if features is None:
        _check_salient(path, salient)
    if not np.isin(detected, (0.0, 1.0)).all():
        raise PemError(f"{path}: column {OUTCOME_COLUMN!r} must hold 0 or 1 only")
    if len(detected) == 0:
        raise PemError(f"{path}: the table has no rows")
    return SalientTable(salient, detected == 1.0, path.stem, sequence, features)


def _check_salient(path: Path, salient: FloatArray) -> None:
    try:
        check_rows(salient)
        check_plausible(salient)
    except PemError as error:
        raise PemError(f"{path}: {error}") from None


def coded_as(table: SalientTable, own: OwnFeatures) -> SalientTable:
    """A table of a model's features, with categories by the model's codes.

    A table's own codes are of the categories that it happens to have.

    Raises:
        PemError: A feature is a number to one and a category to the other, or the model knows no
            such category.
    """
    assert table.features is not None  # noqa: S101  it was read by their names
    salient = table.salient.copy()
    for place, (found, wanted) in enumerate(
        zip(table.features.features, own.features, strict=True)
    ):
        if found.categories and not wanted.categories:
            raise PemError(f"{table.source}: column {found.name!r} has words, the model a number")
        if not found.categories:
            continue
        codes = np.array([own.code(wanted.name, name) for name in found.categories])
        salient[:, place] = codes[salient[:, place].astype(np.int64)]
    return replace(table, salient=salient, features=own)


def save_table(table: SalientTable, path: Path) -> None:
    """Write the table as CSV, with as many digits as reading it back exactly needs."""
    lines = [",".join((*SALIENT_COLUMNS, OUTCOME_COLUMN))]
    for row, outcome in zip(table.salient.tolist(), table.detected.tolist(), strict=True):
        lines.append(",".join([*(f"{value!r}".removesuffix(".0") for value in row), str(+outcome)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass(frozen=True, eq=False)
class TrackTable:
    """Observations in the order of sequence, track and frame.

    Attributes:
        obstacles: The n observations as a table that error models learn from.
        sequence: Which sequence each belongs to, ``[n]``, counted from 0.
        track: Which obstacle, ``[n]``, counted from 0 over all sequences.
        frame: ``[n]``, as labelled.
        rate_hz: Frames a second, ``[n]``.
        has_state: Whether the salient variables are a road user's; else they are all 0, or
            features of one's own.
        time_s: Time stamps ``[n]`` [s] where there are some, comparable within a sequence.
        doubts: What looks wrong with it, but may be meant, in words.
    """

    obstacles: SalientTable
    sequence: IntArray
    track: IntArray
    frame: IntArray
    rate_hz: FloatArray
    has_state: bool = True
    time_s: FloatArray | None = None
    doubts: tuple[str, ...] = ()

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
            time_s=None if self.time_s is None else self.time_s[rows],
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
        if self.time_s is not None:
            return np.where(self.follows, np.diff(self.time_s, prepend=self.time_s[:1]), np.inf)
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
        if self.time_s is not None:
            return int(np.count_nonzero(self.follows & (self.since_s * self.rate_hz > GAP)))
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
    time_s: FloatArray | None = None,
    features: OwnFeatures | None = None,
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
    order = np.lexsort((frame if time_s is None else time_s, one_track))
    ordered = of_sequence[order].astype(np.int64)
    table = TrackTable(
        obstacles=SalientTable(salient[order], detected[order], source, ordered, features),
        sequence=ordered,
        track=one_track[order].astype(np.int64),
        frame=frame[order],
        rate_hz=rate_hz[order],
        has_state=has_state,
        time_s=None if time_s is None else time_s[order],
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
    path: Path | str,
    *,
    rate_hz: float | None = None,
    needs_state: bool = True,
    features: Sequence[str] = (),
) -> TrackTable:
    """Read a table with sequence, track, frame or time_s, the salient columns and the outcome.

    Where it has time stamps (``time_s``), rates are each sequence's own by them, and the time
    between two rows is what they say.

    Args:
        path: as ``pemviz pem collect`` writes it of sequences, or one of the user's own; CSV,
            parquet or Arrow.
        rate_hz: frames a second where the table has neither a column ``rate_hz`` nor ``time_s``.
        needs_state: whether the salient columns must be there; else a table without any of them
            will do.
        features: names of columns that are looked at in place of the salient ones.

    Raises:
        PemError: the file is missing or malformed, rows or frames are there again, or units cannot
            be; the message names file, line and column.
    """
    path = Path(path)
    if not is_file(path):
        raise PemError(f"{path}: no such table of tracks")
    header = table_header(path)
    has_state = needs_state or any(name in header for name in SALIENT_COLUMNS)
    state = SALIENT_COLUMNS if has_state else ()
    state, has_state = (bare_names(features), False) if features else (state, has_state)
    moment = () if TIME_COLUMN in header else ("frame",)
    columns = read_columns(path, "sequence", *moment, "track", OUTCOME_COLUMN, *state)
    own: OwnFeatures | None = None
    salient = np.zeros((len(columns), len(SALIENT_COLUMNS)))
    if features:
        salient, own = own_columns(columns, features)
    elif has_state:
        salient = np.stack([columns.numbers(name) for name in state], axis=1)
    detected = columns.numbers(OUTCOME_COLUMN)
    frame, rates, time_s = _moments(columns, rate_hz)
    _check(path, detected=detected, rates=rates, frame=frame, salient=salient, is_known=has_state)
    table = track_table(
        salient=salient,
        detected=detected == 1.0,
        sequence=columns.texts("sequence"),
        track=columns.texts("track"),
        frame=frame.astype(np.int64),
        rate_hz=rates,
        source=path.stem,
        has_state=has_state,
        time_s=time_s,
        features=own,
    )
    repeated = check_not_logged_again(
        table.obstacles.salient if has_state or features else None,
        table.detected,
        follows=table.follows,
        frame=table.frame,
        where=str(path),
    )
    clock = clock_words(table.since_s, table.rate_hz, table.sequence)
    return replace(table, doubts=(*repeated, *clock))


def _moments(
    columns: Columns, rate_hz: float | None
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Frame, rate and time stamp of each row ``[n]``.

    Raises:
        PemError: Nothing tells the rate, or time stamps do not fit it, or are there twice.
    """
    rates: FloatArray | None = None
    if RATE_COLUMN in columns.header:
        rates = columns.numbers(RATE_COLUMN)
    if TIME_COLUMN not in columns.header:
        if rates is None and rate_hz is None:
            raise PemError(
                f"{columns.path}:1: the header lacks {RATE_COLUMN}; give the rate of the frames"
            )
        given = np.full(len(columns), rate_hz or 0.0) if rates is None else rates
        return columns.numbers("frame"), given, None
    time_s, where = columns.numbers(TIME_COLUMN), str(columns.path)
    if not np.isfinite(time_s).all():
        raise PemError(f"{where}: column {TIME_COLUMN!r} must be finite")
    names, sequence = np.unique(columns.texts("sequence"), return_inverse=True)
    track = np.unique(
        np.stack([sequence, columns.labels("track")], axis=1), axis=0, return_inverse=True
    )[1].ravel()
    check_not_twice(sequence, track, time_s, columns)
    if len(columns):
        measured = rates_of(time_s, sequence=sequence, track=track, names=names, where=where)
        if rates is not None:
            check_rates(rates, measured, names[sequence], where=where)
        rates = measured
    frame = _ranks(time_s, sequence)
    if "frame" in columns.header:
        frame = columns.numbers("frame")
    return frame, np.empty(0) if rates is None else rates, time_s


def _ranks(time_s: FloatArray, sequence: IntArray) -> FloatArray:
    """Which of its sequence's moments each row is of ``[n]``, counted from 0."""
    order = np.lexsort((time_s, sequence))
    begins = np.append(True, np.diff(sequence[order]) != 0)[: len(order)]
    later = np.append(False, np.diff(time_s[order]) > 0.0)[: len(order)] & ~begins
    moment = np.cumsum(later)
    lengths = np.diff(np.append(np.flatnonzero(begins), len(order)))
    frame = np.empty(len(order))
    frame[order] = moment - np.repeat(moment[begins], lengths)
    return frame


def _check(
    path: Path,
    *,
    detected: FloatArray,
    rates: FloatArray,
    frame: FloatArray,
    salient: FloatArray,
    is_known: bool,
) -> None:
    if len(salient) == 0:
        raise PemError(f"{path}: the table has no rows")
    if not np.isin(detected, (0.0, 1.0)).all():
        raise PemError(f"{path}: column {OUTCOME_COLUMN!r} must hold 0 or 1 only")
    if not ((rates > 0.0) & np.isfinite(rates)).all():
        raise PemError(f"{path}: column {RATE_COLUMN!r} must be above 0 and finite")
    if not ((frame >= 0.0) & (frame == np.floor(frame)) & (frame < 2.0**53)).all():
        raise PemError(f"{path}: column 'frame' must hold whole numbers from 0 on")
    if is_known:
        _check_salient(path, salient)
