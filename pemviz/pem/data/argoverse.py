"""Argoverse 2's annotations and detections (feather) to the table that models learn from.

Labels are a log's folder with ``annotations.feather``, or a folder of such; detections one file as
it is submitted, with ``log_id``, ``timestamp_ns``, ``category``, ``score`` and the box. Places are
the ego's (x forward, y left, z up), of a track ``track_uuid``. As in the benchmark a box without a
point of lidar in it does not count, and where nothing is reported of a labelled sweep all is
missed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.pem.data.collect import Progress
from pemviz.pem.data.columns import Columns, read_columns
from pemviz.pem.data.timed_boxes import MatchOptions, Moment, SeenBox, TimedCounts, TimedTable

ANNOTATIONS = "annotations.feather"
PLACE = ("tx_m", "ty_m", "tz_m")
ROTATION = ("qw", "qx", "qy", "qz")
SIZE = ("length_m", "width_m", "height_m")
BOX = (*PLACE, *ROTATION, *SIZE)
CATEGORIES = {
    **{"REGULAR_VEHICLE": "Car", "BOX_TRUCK": "Truck", "TRUCK": "Truck", "TRUCK_CAB": "Truck"},
    **{"PEDESTRIAN": "Pedestrian", "BICYCLIST": "Cyclist"},
}
"""Of Argoverse 2 that error models have; others are left out."""
LARGEST = 1e6


def collect_argoverse(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    options: MatchOptions,
    on_progress: Progress | None = None,
) -> TimedCounts:
    """Match every annotation with the detections of its sweep, and write a row for it.

    Logs of which nothing at all is reported are refused: they were not evaluated.

    Raises:
        PemError: Naming file and row of what is malformed, or what is missing.
    """
    logs = _logs(labels)
    reported = _Boxes.read(detections, "log_id", "score", name="category")
    of_log = reported.columns.texts("log_id")
    table, silent, sweeps = TimedTable(options), 0, 0
    for done, (name, path) in enumerate(logs.items(), start=1):
        own = _Boxes.read(path, "track_uuid", "num_interior_pts", name="category")
        kept = own.columns.numbers("num_interior_pts") > 0.0
        table.counts.dropped += int(np.count_nonzero(~kept))
        truth = dict(own.moments(kept, who="track_uuid"))
        seen = dict(reported.moments(of_log == name, score="score"))
        if not seen:
            raise PemError(f"{detections}: nothing of log {name!r}, which is labelled")
        if not set(truth) & set(seen):
            raise PemError(f"{detections}: log {name!r}: no sweep has a labelled one's time stamp")
        sweeps += len(truth)
        silent += sum(time_ns not in seen for time_ns in truth)
        nothing = {time_ns: Moment(time_ns, "ego", ()) for time_ns in truth}
        both = {**nothing, **{time_ns: seen[time_ns] for time_ns in seen}}
        table.add(name, list(truth.values()), [both[t] for t in sorted(both)], where=path)
        if on_progress is not None:
            on_progress(done, len(logs))
    if silent:
        table.counts.doubts += (
            f"of {silent} of {sweeps} labelled sweeps nothing is reported: all in them counts as "
            "missed; was the detector run on all?",
        )
    return table.write(out, labels=labels)


def _logs(labels: Path) -> dict[str, Path]:
    if is_file(labels / ANNOTATIONS):
        return {labels.resolve().name: labels / ANNOTATIONS}
    found = sorted(labels.glob(f"*/{ANNOTATIONS}")) if is_folder(labels) else []
    if not found:
        raise PemError(f"{labels}: no log of Argoverse 2 ({ANNOTATIONS}) nor one in it")
    return {path.parent.name: path for path in found}


@dataclass(frozen=True)
class _Boxes:
    """The rows of a file of boxes."""

    columns: Columns
    time_ns: IntArray
    names: list[str]
    place_m: FloatArray
    rotation: FloatArray
    size_m: FloatArray

    @classmethod
    def read(cls, path: Path, *needs: str, name: str) -> "_Boxes":
        if path.suffix not in (".feather", ".parquet", ".arrow"):
            raise PemError(f"{path}: must be a .feather (or .parquet) file")
        columns = read_columns(path, *needs, name, "timestamp_ns", *BOX)
        if not len(columns):
            raise PemError(f"{path}: no rows")
        stamps = columns.table.column("timestamp_ns")
        if not str(stamps.type).startswith(("int", "uint")) or stamps.null_count:
            raise PemError(f"{path}: column 'timestamp_ns' must hold whole numbers")
        place, rotation, size = (
            np.stack([columns.numbers(one, largest=LARGEST) for one in part], axis=1)
            for part in (PLACE, ROTATION, SIZE)
        )
        length = np.linalg.norm(rotation, axis=1)  # none is beyond LARGEST
        for wrong, column, words in (
            (~((length > 0.5) & (length < 2.0)), "qw", "begins no quaternion of length 1"),
            (~(size > 0.0).all(axis=1), "length_m", "or another side is not above 0"),
        ):
            if wrong.any():
                raise PemError(f"{columns.where(int(np.argmax(wrong)), column)} {words}")
        names = [CATEGORIES.get(str(one), str(one)) for one in columns.texts(name)]
        turned = rotation / length[:, None]
        return cls(columns, np.asarray(stamps.to_numpy()), names, place, turned, size)

    def moments(
        self, kept: BoolArray, *, who: str = "", score: str = ""
    ) -> Iterator[tuple[int, Moment]]:
        """Sweeps of the rows that are kept ``[n]``, by time stamp."""
        rows = np.flatnonzero(kept)
        tracks = self.columns.texts(who) if who else None
        scores = self.columns.numbers(score) if score else None
        found: dict[int, list[SeenBox]] = {}
        for row in rows[np.argsort(self.time_ns[rows], kind="stable")].tolist():
            box = SeenBox(
                name=self.names[row],
                score=1.0 if scores is None else float(scores[row]),
                who="" if tracks is None else str(tracks[row]),
                place_m=self.place_m[row],
                rotation=self.rotation[row],
                size_m=self.size_m[row],
            )
            found.setdefault(int(self.time_ns[row]), []).append(box)
        for time_ns, boxes in found.items():
            yield time_ns, Moment(time_ns, "ego", tuple(boxes))
