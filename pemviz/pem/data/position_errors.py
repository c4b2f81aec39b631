"""Tables of position errors: where obstacles were, and where a detector reported them.

An error is reported minus true: along the line of sight from the sensor to the obstacle
(``range``; above 0: reported too far away), across it (``cross_range``; above 0: reported too far
to the right), and of its speed. Two ways in: a CSV (``pemviz pem collect`` writes one where
detections have a 3D position), and a folder of nuScenes cars and where PointPillars reported them,
as C. Innes published them.

That folder has two files (github.com/craigiedon/CommonRules, arXiv 2405.15771):
``salient_inputs.txt`` (place to the right and forward of the lidar [m], heading from the x axis
[rad], length, width, height [m], visibility) and ``salient_labels.txt`` (detected, *true minus
reported* place [m], heading error).

Their matching overlaps boxes of length x |cos(heading)| by width x |sin(heading)|: a car that heads
exactly along an axis has a box without area, and matches nothing or only what is off by less than
its sliver of a box. Within 30 m 36 % of the cars that head along the y axis to 0.002 rad count as
detected, of oblique ones 97 %. Errors beyond a row's box are not in the table. Rows are taken
therefore only where the box is at least ``PASSED_M`` long and wide: chosen by the true heading
and size alone, never by the error.

Rows come by frame, two frames a second. A car's size to the millimetre tells who it is: rows of
equal size that lie near each other, in the table and in space, are one car.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import read_numbers
from pemviz.pem.data.columns import Columns, read_columns
from pemviz.pem.data.table import INPUTS_FILE, LABELS_FILE, OUTCOME_COLUMN, TIME_COLUMN

RANGE, CROSS_RANGE, SPEED = "range", "cross_range", "speed"
AXIS_COLUMNS = {
    RANGE: "range_error_m",
    CROSS_RANGE: "cross_range_error_m",
    SPEED: "speed_error_mps",
}
"""Column of each kind of error; the third may be missing."""
PLANE_COLUMNS = ("x_error_m", "z_error_m")
"""Errors to the right and forward, from which the first two may be computed."""
LARGEST = 1e4
"""No position [m], error [m] or [m/s] or angle [rad] is larger."""

INPUT_COLUMNS = ("x_m", "y_m", "rotation_rad", "length_m", "width_m", "height_m", "visibility")
OUTPUT_COLUMNS = ("detected", "x_error_m", "y_error_m", "rotation_error_rad")
RATE_HZ = 2.0
PASSED_M = 0.7
FARTHEST_ROWS = 250
"""Rows between two sightings of a car: no frame has as many cars."""
FARTHEST_M = 20.0
"""How far a car moves, seen from the ego, from one frame to the next: 40 m/s."""
NOTE = (
    "The table's matching pairs a car only with what overlaps a box of its length times "
    "|cos(heading)| and its width times |sin(heading)|, along the lidar's axes: larger errors "
    f"count as misses. Only cars whose box is at least {PASSED_M:g} m both ways are taken, which "
    "are those that head about 10 to 70 degrees off the lidar's forward axis; larger errors than "
    f"{PASSED_M:g} to 2 m are fewer here than they were, above all far away."
)


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
        return len(self.errors)

    def only(self, rows: BoolArray) -> "PositionErrorTable":
        """The table of these rows ``[n]``, in the same order."""

        def chosen(values: AnyArray | None) -> Any:
            return None if values is None else values[rows]

        return replace(
            self,
            x_m=self.x_m[rows],
            z_m=self.z_m[rows],
            alpha_rad=chosen(self.alpha_rad),
            errors=self.errors[rows],
            sequence=chosen(self.sequence),
            track=chosen(self.track),
            time_s=chosen(self.time_s),
        )

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

    True places ``[n]`` [m] are to the right (x) and forward (z); errors are reported minus true.
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
    Rows of missed obstacles (detected 0) are passed over. ``rate_hz`` is that of a table that has
    no column of that name.

    Raises:
        PemError: The file is missing or malformed; the message names file, line and column.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such table of position errors")
    csv = read_columns(path)
    lacking = [name for name in ("x_m", "z_m") if name not in csv.header]
    own = [name for axis, name in AXIS_COLUMNS.items() if axis != SPEED]
    along_sight = set(own) <= set(csv.header)
    if not along_sight and not set(PLANE_COLUMNS) <= set(csv.header):
        lacking.append(f"{' and '.join(own)} (or {' and '.join(PLANE_COLUMNS)})")
    if lacking:
        raise PemError(f"{path}:1: the header lacks {', '.join(lacking)}")
    csv = _detected(csv)

    def numbers(name: str) -> FloatArray:
        return csv.numbers(name, largest=LARGEST)

    x_m, z_m = numbers("x_m"), numbers("z_m")
    if (np.hypot(x_m, z_m) == 0.0).any():
        raise PemError(f"{path}: an obstacle is at the sensor's own place (x_m = z_m = 0)")
    if along_sight:
        errors = np.stack([numbers(name) for name in own], axis=1)
    else:
        right, forward = (numbers(name) for name in PLANE_COLUMNS)
        errors = sight_errors(x_m, z_m, x_error_m=right, z_error_m=forward)
    axes = (RANGE, CROSS_RANGE)
    if AXIS_COLUMNS[SPEED] in csv.header:
        errors = np.column_stack([errors, numbers(AXIS_COLUMNS[SPEED])])
        axes = (*axes, SPEED)
    alpha = None
    if "alpha_rad" in csv.header:
        alpha = numbers("alpha_rad")
    elif "rotation_y_rad" in csv.header:
        alpha = numbers("rotation_y_rad") - np.arctan2(x_m, z_m)
    sequence, track, time_s = _who_and_when(csv, rate_hz)
    return PositionErrorTable(
        x_m, z_m, alpha, axes, errors, path.stem, sequence=sequence, track=track, time_s=time_s
    )


def _detected(csv: Columns) -> Columns:
    if OUTCOME_COLUMN in csv.header:
        outcome = csv.numbers(OUTCOME_COLUMN)
        wrong = ~np.isin(outcome, (0.0, 1.0))
        if wrong.any():
            row = int(np.argmax(wrong))
            where = csv.where(row, OUTCOME_COLUMN)
            raise PemError(f"{where} is {str(csv.texts(OUTCOME_COLUMN)[row])!r}, allowed: 0, 1")
        csv = csv.only(outcome == 1.0)
    if not len(csv):
        raise PemError(f"{csv.path}: the table has no rows of detected obstacles")
    return csv


def _who_and_when(
    csv: Columns, rate_hz: float | None
) -> tuple[IntArray | None, IntArray | None, FloatArray | None]:
    """Sequence, track and time ``[n]``, each ``None`` where the table does not tell."""
    sequence = csv.labels("sequence") if "sequence" in csv.header else None
    if "track" not in csv.header:
        return sequence, None, None
    own = csv.labels("track")
    pair = own if sequence is None else sequence * (own.max() + 1) + own
    track = np.unique(pair, return_inverse=True)[1].astype(np.int64)
    if TIME_COLUMN in csv.header:
        time_s = csv.numbers(TIME_COLUMN)
    elif "frame" not in csv.header or ("rate_hz" not in csv.header and rate_hz is None):
        return sequence, track, None
    else:
        rate = np.full(len(csv), rate_hz or 0.0)
        if "rate_hz" in csv.header:
            rate = csv.numbers("rate_hz", largest=LARGEST)
        if not (rate > 0.0).all():
            raise PemError(f"{csv.path}: column 'rate_hz' must be above 0")
        time_s = csv.numbers("frame", largest=LARGEST) / rate
    order = np.lexsort((time_s, track))
    same: BoolArray = np.diff(track[order]) == 0
    if (same & (np.diff(time_s[order]) == 0.0)).any():
        raise PemError(f"{csv.path}: a track is there twice in one frame")
    return sequence, track, time_s


def load_error_table(path: Path | str, *, rate_hz: float | None = None) -> PositionErrorTable:
    """Read a CSV of position errors, see :func:`load_error_csv`, or the folder of nuScenes cars.

    Raises:
        PemError: It is missing or malformed; one line says where.
    """
    path = Path(path)
    if not is_folder(path):
        return load_error_csv(path, rate_hz=rate_hz)
    first = ""
    if is_file(path / INPUTS_FILE):  # which may be one of KITTI obstacles, with other columns
        with (path / INPUTS_FILE).open(encoding="utf-8", errors="replace") as stream:
            first = next((line for line in stream if line.strip() and line[0] != "#"), "")
    if len(first.split()) != len(INPUT_COLUMNS):
        raise PemError(
            f"{path}: no folder of nuScenes cars ({INPUTS_FILE} with {len(INPUT_COLUMNS)} columns, "
            f"{LABELS_FILE}); another table of position errors must be a .csv"
        )
    return load_nuscenes_errors(path)


def load_nuscenes_errors(folder: Path) -> PositionErrorTable:
    """The detected cars whose errors the matching did not cut off.

    Raises:
        PemError: A file is missing or malformed.
    """
    for name in (INPUTS_FILE, LABELS_FILE):
        if not is_file(folder / name):
            raise PemError(f"{folder / name}: no such file")
    inputs = read_numbers(folder / INPUTS_FILE, separator=None, columns=INPUT_COLUMNS)
    labels = read_numbers(folder / LABELS_FILE, separator=None, columns=OUTPUT_COLUMNS)
    if len(inputs) != len(labels) or len(inputs) == 0:
        raise PemError(f"{folder}: {len(inputs)} rows of inputs, {len(labels)} of labels")
    track = _tracks(inputs)
    along_x_m = inputs[:, 3] * np.abs(np.cos(inputs[:, 2]))
    along_y_m = inputs[:, 4] * np.abs(np.sin(inputs[:, 2]))
    kept: BoolArray = (labels[:, 0] == 1.0) & (np.minimum(along_x_m, along_y_m) >= PASSED_M)
    if not kept.any():
        raise PemError(f"{folder}: no detected car whose errors the matching did not cut off")
    x_m, z_m = inputs[kept, 0], inputs[kept, 1]
    errors = sight_errors(x_m, z_m, x_error_m=-labels[kept, 1], z_error_m=-labels[kept, 2])
    return PositionErrorTable(
        x_m=x_m,
        z_m=z_m,
        alpha_rad=-inputs[kept, 2] - np.arctan2(x_m, z_m),
        axes=(RANGE, CROSS_RANGE),
        errors=errors,
        source="nuScenes validation cars, PointPillars",
        sequence=_scenes(track)[kept],
        track=track[kept],
        time_s=_frames(track)[kept] / RATE_HZ,
        note=NOTE,
    )


def _tracks(inputs: FloatArray) -> IntArray:
    """Which car each row is ``[n]``."""
    rows = np.arange(len(inputs))
    size = np.unique(inputs[:, 3:6], axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((rows, size))
    moved_m = np.hypot(*np.diff(inputs[order, :2], axis=0).T)
    goes_on = (
        (np.diff(size[order]) == 0) & (np.diff(order) < FARTHEST_ROWS) & (moved_m < FARTHEST_M)
    )
    track = np.empty(len(inputs), dtype=np.int64)
    track[order] = np.cumsum(np.append(0, ~goes_on))
    return track


def _frames(track: IntArray) -> IntArray:
    """How many sightings of the same car come before each row ``[n]``."""
    order = np.argsort(track, kind="stable")
    first = np.searchsorted(track[order], track[order])
    frame = np.empty(len(track), dtype=np.int64)
    frame[order] = np.arange(len(track)) - first
    return frame


def _scenes(track: IntArray) -> IntArray:
    """Which stretch of driving each row is from ``[n]``: a car that is there on joins two rows."""
    rows = np.arange(len(track))
    last = np.zeros(int(track.max()) + 1, dtype=np.int64)
    np.maximum.at(last, track, rows)
    reached = np.maximum.accumulate(last[track])
    begins = np.append(False, reached[:-1] < rows[1:])
    return np.cumsum(begins)
