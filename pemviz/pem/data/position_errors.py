"""Tables of position errors: where obstacles were, and where a detector reported them.

Two ways in: a CSV (``pemviz pem collect`` writes one where detections have a 3D position), and the
folder of nuScenes cars of :mod:`pemviz.pem.data.nuscenes_errors`. An error is reported minus true:
along the line of sight from the sensor to the obstacle (``range``; above 0: reported too far
away), across it (``cross_range``; above 0: reported too far to the right), and of its speed.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.pem.data.table import OUTCOME_COLUMN, read_cells

RANGE, CROSS_RANGE, SPEED = "range", "cross_range", "speed"
AXIS_COLUMNS = {
    RANGE: "range_error_m",
    CROSS_RANGE: "cross_range_error_m",
    SPEED: "speed_error_mps",
}
"""Column of each kind of error; the third may be missing."""
PLANE_COLUMNS = ("x_error_m", "z_error_m")
"""Errors to the right and forward, from which the first two may be computed."""
TRACK_COLUMNS = ("sequence", "frame", "track", "rate_hz")
LARGEST = 1e4
"""No position [m], error [m] or [m/s] or angle [rad] is larger."""


@dataclass(frozen=True, eq=False)
class PositionErrorTable:
    """Detected obstacles and the errors of their reported positions.

    Attributes:
        x_m: True place to the right of the sensor ``[n]`` [m].
        z_m: True place forward of the sensor ``[n]`` [m].
        alpha_rad: KITTI's observation angle ``[n]`` [rad]: rotation_y - atan2(x, z), -pi/2 where
            the obstacle is seen from straight behind; ``None`` if headings are unknown.
        axes: Kinds of error: range, cross_range, and speed where it is known.
        errors: ``[n, M]`` by kind [m, or m/s].
        source: Where the table comes from, in words.
        sequence: Which drive each is from ``[n]``, counted from 0; ``None`` if unknown.
        track: Which obstacle ``[n]``, counted from 0; ``None`` if unknown.
        time_s: When ``[n]`` [s], comparable within a track; ``None`` if unknown.
        note: What whoever uses it must know of how it was made; empty if nothing.
    """

    x_m: FloatArray
    z_m: FloatArray
    alpha_rad: FloatArray | None
    axes: tuple[str, ...]
    errors: FloatArray
    source: str
    sequence: IntArray | None = None
    track: IntArray | None = None
    time_s: FloatArray | None = None
    note: str = ""

    def __len__(self) -> int:
        """Number of errors n."""
        return len(self.errors)

    @cached_property
    def distance_m(self) -> FloatArray:
        """Distance from the sensor ``[n]`` [m]."""
        return np.hypot(self.x_m, self.z_m)

    @cached_property
    def groups(self) -> tuple[str, IntArray]:
        """What is taken as independent of each other, in words, and which row is of which."""
        if self.sequence is not None:
            return "drives", self.sequence
        if self.track is not None:
            return "obstacles", self.track
        return "observations", np.arange(len(self))

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the values."""
        digest = hashlib.sha256(np.stack([self.x_m, self.z_m], axis=1).tobytes())
        digest.update(np.ascontiguousarray(self.errors).tobytes())
        return digest.hexdigest()


def sight_errors(
    x_m: FloatArray, z_m: FloatArray, *, x_error_m: FloatArray, z_error_m: FloatArray
) -> FloatArray:
    """Errors along and across the line of sight ``[n, 2]`` [m], of those to the right and forward.

    Args:
        x_m: True place to the right ``[n]`` [m].
        z_m: True place forward ``[n]`` [m].
        x_error_m: Reported minus true, to the right ``[n]`` [m].
        z_error_m: The same forward ``[n]`` [m].
    """
    distance_m = np.hypot(x_m, z_m)
    right, ahead = x_m / distance_m, z_m / distance_m
    along = x_error_m * right + z_error_m * ahead
    across = x_error_m * ahead - z_error_m * right
    return np.stack([along, across], axis=1)


def load_error_csv(path: Path, *, rate_hz: float | None = None) -> PositionErrorTable:
    """Read a CSV with ``x_m``, ``z_m`` and the errors.

    These are range_error_m and cross_range_error_m, or x_error_m and z_error_m; speed_error_mps,
    alpha_rad (or rotation_y_rad), sequence, frame, track, rate_hz and detected may be there.
    Rows of missed obstacles (detected 0) are passed over.

    Args:
        path: The file.
        rate_hz: Frames a second, where the table has no column of that name.

    Raises:
        PemError: The file is missing or malformed; the message names file, line and column.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such table of position errors")
    header, lines = read_cells(path)
    lacking = [name for name in ("x_m", "z_m") if name not in header]
    own = [name for axis, name in AXIS_COLUMNS.items() if axis != SPEED]
    if not (set(own) <= set(header) or set(PLANE_COLUMNS) <= set(header)):
        lacking.append(f"{' and '.join(own)} (or {' and '.join(PLANE_COLUMNS)})")
    if lacking:
        raise PemError(f"{path}:1: the header lacks {', '.join(lacking)}")
    columns = _Columns(path, header, _detected_lines(path, header, lines))
    if not columns.lines:
        raise PemError(f"{path}: the table has no rows of detected obstacles")
    x_m, z_m = columns.numbers("x_m"), columns.numbers("z_m")
    if (np.hypot(x_m, z_m) == 0.0).any():
        raise PemError(f"{path}: an obstacle is at the sensor's own place (x_m = z_m = 0)")
    if set(own) <= set(header):
        errors = np.stack([columns.numbers(name) for name in own], axis=1)
    else:
        right, forward = (columns.numbers(name) for name in PLANE_COLUMNS)
        errors = sight_errors(x_m, z_m, x_error_m=right, z_error_m=forward)
    axes = (RANGE, CROSS_RANGE)
    if AXIS_COLUMNS[SPEED] in header:
        errors = np.column_stack([errors, columns.numbers(AXIS_COLUMNS[SPEED])])
        axes = (*axes, SPEED)
    sequence, track, time_s = columns.tracks(rate_hz)
    return PositionErrorTable(
        x_m=x_m,
        z_m=z_m,
        alpha_rad=columns.alpha(x_m, z_m),
        axes=axes,
        errors=errors,
        source=path.stem,
        sequence=sequence,
        track=track,
        time_s=time_s,
    )


def _detected_lines(
    path: Path, header: list[str], lines: list[tuple[int, list[str]]]
) -> list[tuple[int, list[str]]]:
    if OUTCOME_COLUMN not in header:
        return lines
    index = header.index(OUTCOME_COLUMN)
    for number, cells in lines:
        if cells[index] not in ("0", "1"):
            raise PemError(
                f"{path}:{number}: column {index + 1} ({OUTCOME_COLUMN}) is {cells[index]!r}, "
                "allowed: 0, 1"
            )
    return [line for line in lines if line[1][index] == "1"]


@dataclass(frozen=True, eq=False)
class _Columns:
    """The cells of the rows that count, by column."""

    path: Path
    header: list[str]
    lines: list[tuple[int, list[str]]]

    def numbers(self, name: str) -> FloatArray:
        index = self.header.index(name)
        values = np.empty(len(self.lines))
        for row, (line, cells) in enumerate(self.lines):
            try:
                values[row] = float(cells[index])
            except ValueError:
                values[row] = np.nan
            if not abs(values[row]) <= LARGEST:
                raise PemError(
                    f"{self.path}:{line}: column {index + 1} ({name}) is {cells[index]!r}, "
                    f"allowed: a number from {-LARGEST:g} to {LARGEST:g}"
                )
        return values

    def alpha(self, x_m: FloatArray, z_m: FloatArray) -> FloatArray | None:
        if "alpha_rad" in self.header:
            return self.numbers("alpha_rad")
        if "rotation_y_rad" in self.header:
            return self.numbers("rotation_y_rad") - np.arctan2(x_m, z_m)
        return None

    def tracks(
        self, rate_hz: float | None
    ) -> tuple[IntArray | None, IntArray | None, FloatArray | None]:
        """Sequence, track and time ``[n]``, each ``None`` where the table does not tell."""
        text = {name: np.array([cells[self.header.index(name)] for _, cells in self.lines])
                for name in ("sequence", "track") if name in self.header}  # fmt: skip
        sequence = text.get("sequence")
        if sequence is not None:
            sequence = np.unique(sequence, return_inverse=True)[1].astype(np.int64)
        if "track" not in text:
            return sequence, None, None
        own = np.unique(text["track"], return_inverse=True)[1].astype(np.int64)
        pair = own if sequence is None else sequence * (own.max() + 1) + own
        track = np.unique(pair, return_inverse=True)[1].astype(np.int64)
        if "frame" not in self.header or ("rate_hz" not in self.header and rate_hz is None):
            return sequence, track, None
        rate = self.numbers("rate_hz") if rate_hz is None else np.full(len(self.lines), rate_hz)
        if not (rate > 0.0).all():
            raise PemError(f"{self.path}: column 'rate_hz' must be above 0")
        time_s = self.numbers("frame") / rate
        if self._twice(track, time_s):
            raise PemError(f"{self.path}: a track is there twice in one frame")
        return sequence, track, time_s

    @staticmethod
    def _twice(track: IntArray, time_s: FloatArray) -> bool:
        order = np.lexsort((time_s, track))
        same: BoolArray = np.diff(track[order]) == 0
        return bool((same & (np.diff(time_s[order]) == 0.0)).any())
