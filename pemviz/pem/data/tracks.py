"""Obstacles followed over time: who was seen when, and what the detector made of it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.pem.data.table import OUTCOME_COLUMN, SalientTable, read_cells
from pemviz.pem.models.encoding import check_rows
from pemviz.pem.models.protocol import SALIENT_COLUMNS

REQUIRED = ("sequence", "frame", "track", OUTCOME_COLUMN)
RATE_COLUMN = "rate_hz"


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
        """Number of observations n."""
        return len(self.obstacles)

    @property
    def detected(self) -> BoolArray:
        """Outcomes ``[n]``."""
        return self.obstacles.detected

    @cached_property
    def follows(self) -> BoolArray:
        """Whether the row before is of the same track, ``[n]``."""
        same = np.zeros(len(self), dtype=np.bool_)
        same[1:] = self.track[1:] == self.track[:-1]
        return same

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
        return int(np.count_nonzero(self.follows & (self._frames_since > 1)))

    @property
    def rate_changes(self) -> int:
        """How often the rate changes within a track."""
        changed = np.diff(self.rate_hz, prepend=self.rate_hz[:1]) != 0.0
        return int(np.count_nonzero(changed & self.follows))

    @property
    def _frames_since(self) -> IntArray:
        return np.diff(self.frame, prepend=self.frame[:1])


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

    Args:
        salient: ``[n, 11]``.
        detected: ``[n]``.
        sequence: Names or numbers ``[n]``.
        track: Names or numbers ``[n]``, each its own within its sequence.
        frame: ``[n]``.
        rate_hz: ``[n]``.
        source: Where they come from, in words.
        has_state: Whether the salient variables are known.

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
        who = tracks[of_track[order][row]]
        where = sequences[of_sequence[order][row]]
        raise PemError(
            f"{source}: track {who} of sequence {where} is there twice in frame {table.frame[row]}"
        )
    return table


def load_tracks(
    path: Path | str, *, rate_hz: float | None = None, needs_state: bool = True
) -> TrackTable:
    """Read a CSV with sequence, frame, track, the salient columns and the outcome.

    Args:
        path: as ``pemviz pem collect --tracks`` writes it, or one of the user's own.
        rate_hz: frames a second where the table has no column ``rate_hz``.
        needs_state: whether the salient columns must be there; else a table without any of them
            will do.

    Raises:
        PemError: the file is missing or malformed; the message names file, line and column.
    """
    path = Path(path)
    if not is_file(path):
        raise PemError(f"{path}: no such table of tracks")
    header, lines = read_cells(path)
    has_state = needs_state or any(name in header for name in SALIENT_COLUMNS)
    wanted = (*REQUIRED, *SALIENT_COLUMNS) if has_state else REQUIRED
    missing = [name for name in wanted if name not in header]
    if missing:
        raise PemError(f"{path}:1: the header lacks {', '.join(missing)}")
    if RATE_COLUMN not in header and rate_hz is None:
        raise PemError(f"{path}:1: the header lacks {RATE_COLUMN}; give the rate of the frames")
    text = {name: [cells[header.index(name)] for _, cells in lines] for name in header}
    number = {
        name: _column(path, header, lines, name)
        for name in wanted
        if name not in ("sequence", "track")
    }
    rates = (
        _column(path, header, lines, RATE_COLUMN)
        if RATE_COLUMN in header
        else np.full(len(lines), rate_hz)
    )
    nothing = np.zeros(len(lines))
    salient = np.stack([number.get(name, nothing) for name in SALIENT_COLUMNS], axis=1)
    _check(path, number, rates, salient)
    return track_table(
        salient=salient,
        detected=number[OUTCOME_COLUMN] == 1.0,
        sequence=np.array(text["sequence"]),
        track=np.array(text["track"]),
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


def _column(
    path: Path, header: list[str], lines: list[tuple[int, list[str]]], name: str
) -> FloatArray:
    index = header.index(name)
    values = np.empty(len(lines))
    for row, (line, cells) in enumerate(lines):
        try:
            values[row] = float(cells[index])
        except ValueError:
            raise PemError(
                f"{path}:{line}: column {index + 1} ({name}) is {cells[index]!r}, not a number"
            ) from None
    return values
