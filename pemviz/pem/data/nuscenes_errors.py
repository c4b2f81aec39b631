"""nuScenes cars and where PointPillars reported them, as C. Innes published them.

Two files (github.com/craigiedon/CommonRules, arXiv 2405.15771): ``salient_inputs.txt`` (place to
the right and forward of the lidar [m], heading from the x axis [rad], length, width, height [m],
visibility) and ``salient_labels.txt`` (detected, *true minus reported* place [m], heading error).

Their matching overlaps boxes of length x |cos(heading)| by width x |sin(heading)|: a car that heads
exactly along an axis has a box without area, and matches nothing or only what is off by less than
its sliver of a box. Within 30 m 36 % of the cars that head along the y axis to 0.002 rad count as
detected, of oblique ones 97 %. Errors beyond a row's box are not in the table. Rows are taken
therefore only where the box is at least ``PASSED_M`` long and wide: chosen by the true heading
and size alone, never by the error.

Rows come by frame, two frames a second. A car's size to the millimetre tells who it is: rows of
equal size that lie near each other, in the table and in space, are one car.
"""

from pathlib import Path

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import read_numbers
from pemviz.pem.data.position_errors import (
    CROSS_RANGE,
    RANGE,
    PositionErrorTable,
    load_error_csv,
    sight_errors,
)
from pemviz.pem.data.table import INPUTS_FILE, LABELS_FILE

INPUT_COLUMNS = ("x_m", "y_m", "rotation_rad", "length_m", "width_m", "height_m", "visibility")
LABEL_COLUMNS = ("detected", "x_error_m", "y_error_m", "rotation_error_rad")
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


def is_nuscenes_folder(folder: Path) -> bool:
    """Whether a folder's inputs have the columns of nuScenes cars, not those of KITTI obstacles."""
    file = folder / INPUTS_FILE
    if not is_file(file):
        return False
    with file.open(encoding="utf-8", errors="replace") as stream:
        first = next((line for line in stream if line.strip() and line[0] != "#"), "")
    return len(first.split()) == len(INPUT_COLUMNS)


def load_error_table(path: Path | str, *, rate_hz: float | None = None) -> PositionErrorTable:
    """Read a CSV of position errors, or the folder of nuScenes cars.

    Args:
        path: Of either.
        rate_hz: Frames a second of a CSV that has no column ``rate_hz``.

    Raises:
        PemError: It is missing or malformed; one line says where.
    """
    path = Path(path)
    if not is_folder(path):
        return load_error_csv(path, rate_hz=rate_hz)
    if not is_nuscenes_folder(path):
        raise PemError(
            f"{path}: no folder of nuScenes cars ({INPUTS_FILE} with {len(INPUT_COLUMNS)} columns, "
            f"{LABELS_FILE}); another table of position errors must be a .csv"
        )
    return load_nuscenes_errors(path)


def load_nuscenes_errors(folder: Path, *, passed_m: float = PASSED_M) -> PositionErrorTable:
    """The detected cars whose errors the matching did not cut off.

    Args:
        folder: With the two files.
        passed_m: Least length and width of the box that errors had to stay within [m].

    Raises:
        PemError: A file is missing or malformed.
    """
    for name in (INPUTS_FILE, LABELS_FILE):
        if not is_file(folder / name):
            raise PemError(f"{folder / name}: no such file")
    inputs = read_numbers(folder / INPUTS_FILE, separator=None, columns=INPUT_COLUMNS)
    labels = read_numbers(folder / LABELS_FILE, separator=None, columns=LABEL_COLUMNS)
    if len(inputs) != len(labels) or len(inputs) == 0:
        raise PemError(f"{folder}: {len(inputs)} rows of inputs, {len(labels)} of labels")
    track = _tracks(inputs)
    along_x_m = inputs[:, 3] * np.abs(np.cos(inputs[:, 2]))
    along_y_m = inputs[:, 4] * np.abs(np.sin(inputs[:, 2]))
    kept: BoolArray = (labels[:, 0] == 1.0) & (np.minimum(along_x_m, along_y_m) >= passed_m)
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
