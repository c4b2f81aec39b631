"""Boxes with time stamps, of a reference and of a detector, met in time and place, to a table.

Moments meet first: each of the reference and the nearest of the detections, one to one, within a
stated tolerance. Those without a partner are left out and counted: nothing says what a detector
would have reported then. Boxes meet in place: centres in the ground plane nearer than a stated
distance, or in an image by overlap. What a box in space does not say, truncation and occlusion, is
0 in the table.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.matching import PAPER_IOU, assign_boxes, assign_centres, iou, nearness
from pemviz.pem.data.collect import (
    CLASS_ID,
    NUMBERED_CLASSES,
    OBSTACLE_COLUMNS,
    CollectedCounts,
    plain,
    write_table,
)
from pemviz.pem.data.frame_shift import ShiftTally
from pemviz.pem.data.kitti_labels import Box
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN, TIME_COLUMN
from pemviz.pem.data.units import check_plausible

TIME_TOLERANCE_S = 0.05
MATCHED_BELOW_M = 2.0
NAMES = {
    **{"car": "Car", "van": "Van", "truck": "Truck", "pedestrian": "Pedestrian"},
    **{"person": "Pedestrian", "bicycle": "Cyclist", "cyclist": "Cyclist", "tram": "Tram"},
    "person_sitting": "Person_sitting",
}
"""Classes that error models have; a bicycle is one with its rider, as Autoware's is."""
LATE_SHARE = 0.2
"""Of the tolerance: by more than that detections are late on the whole, which is told."""
WHO = ("sequence", "frame", "track", TIME_COLUMN)
IMAGE_COLUMNS = ("type", "left_px", "top_px", "right_px", "bottom_px", OUTCOME_COLUMN, "iou")
PLACE_COLUMNS = (*OBSTACLE_COLUMNS, "centre_distance_m", *PLANE_COLUMNS)


@dataclass(frozen=True)
class SeenBox:
    """What a message says of one obstacle.

    Attributes:
        name: Its class, or the number of it as text.
        who: What follows it from message to message; empty if nothing does.
        place_m: Centre, x, y, z in the message's frame; of boxes in an image all 0.
        rotation: Quaternion w, x, y, z of length 1.
        size_m: Length, width, height.
        box_px: In an image.
    """

    name: str
    score: float
    who: str
    place_m: FloatArray
    rotation: FloatArray
    size_m: FloatArray
    box_px: Box | None = None


@dataclass(frozen=True)
class Moment:
    """A message of boxes.

    Attributes:
        time_ns: Its header's stamp.
        frame: Name of the frame that places are in.
    """

    time_ns: int
    frame: str
    boxes: tuple[SeenBox, ...]


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """What counts as a detection.

    Attributes:
        time_tolerance_s: Of the stamps of two moments that belong together.
        centres_below_m: Of two boxes that do.
        iou_above: Of two boxes in an image.
        types: Classes that count as obstacles; all if empty.
        class_names: Names of the classes 0, 1, ... where boxes have numbers.
        score_from: Detections of a lower score are ignored.
    """

    time_tolerance_s: float = TIME_TOLERANCE_S
    centres_below_m: float = MATCHED_BELOW_M
    iou_above: float = PAPER_IOU
    types: tuple[str, ...] = ()
    class_names: tuple[str, ...] = NUMBERED_CLASSES
    score_from: float = -math.inf


@dataclass
class TimedCounts(CollectedCounts):
    """What happened on the way."""

    sequences: int = 0
    moments: int = 0
    """Messages of reference boxes that have one of detections."""
    alone: int = 0
    """Those that have none."""
    tracks: int = 0
    observations: int = 0
    other_types: int = 0
    ignored_detections: int = 0
    late_s: list[float] = field(default_factory=list[float])
    """Stamps of detections minus those of labels, of each pair [s]."""


@dataclass(frozen=True)
class _Row:
    sequence: str
    frame: int
    time_ns: int
    label: SeenBox
    found: SeenBox | None
    apart: float
    """Distance of centres [m], or overlap in an image."""


class TimedTable:
    """Sequences of moments, matched one after the other, and then written."""

    def __init__(self, options: MatchOptions) -> None:
        if unknown := [name for name in options.types if name not in CLASS_ID]:
            allowed = ", ".join(CLASS_ID)
            raise PemError(f"types: {unknown[0]!r} is no class, allowed: {allowed}")
        self.options = options
        self.counts = TimedCounts()
        self._rows: list[_Row] = []
        self._is_image = False
        self._shift = ShiftTally(partial(nearness, below_m=2.0 * options.centres_below_m))

    def add(
        self,
        sequence: str,
        truth: Sequence[Moment],
        seen: Sequence[Moment],
        *,
        where: Path,
        is_image: bool = False,
    ) -> None:
        """Match a sequence, moments by time; places in one frame.

        Raises:
            PemError: They are not, or no moments belong together; begins with ``where``.
        """
        plain(sequence, where)
        if is_image and not self._is_image:
            self._is_image, self._shift = True, ShiftTally(iou)
        if not is_image:
            _check_frames(truth, seen, where)
        met = _met(truth, seen, self.options, self.counts, where=where)
        _tally(self._shift, met, is_image=is_image)
        self._rows += _rows(sequence, met, self.options, self.counts, is_image=is_image)
        self.counts.sequences += 1

    def write(self, out: Path, *, labels: Path) -> TimedCounts:
        """Write the CSV, complete or not at all, and tell what is in it.

        Raises:
            PemError: There is no row, somebody is there twice, units cannot be, or it cannot be
                written.
        """
        counts, rows = self.counts, self._rows
        counts.observations = len(rows)
        counts.judge(len(rows), labels=labels, types=self.options.types, shift=self._shift)
        counts.doubts += tuple(_clock_doubts(counts, self.options))
        _write(out, rows, counts, is_image=self._is_image)
        return counts


def _check_frames(truth: Sequence[Moment], seen: Sequence[Moment], bag: Path) -> None:
    frames = {each.frame for each in (*truth, *seen)}
    if len(frames) > 1:
        one, other = sorted(frames)[:2]
        raise PemError(
            f"{bag}: places are in the frames {one!r} and {other!r}; both topics must be in one"
        )


def _met(
    truth: Sequence[Moment],
    seen: Sequence[Moment],
    options: MatchOptions,
    counts: TimedCounts,
    *,
    where: Path,
) -> list[tuple[int, Moment, Moment | None]]:
    """Each message of labels with its place in order and the one of detections, if there is one."""
    own, other = (np.array([each.time_ns for each in part]) for part in (truth, seen))
    after = np.clip(np.searchsorted(other, own), 1, max(len(other) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(other) - 1)
    nearer = np.abs(other[before] - own) <= np.abs(other[after] - own)
    nearest: IntArray = np.where(nearer, before, after)
    late_s = (other[nearest] - own) / 1e9
    taken: dict[int, int] = {}
    for index in np.argsort(np.abs(late_s), kind="stable").tolist():
        if abs(late_s[index]) <= options.time_tolerance_s:
            taken.setdefault(int(nearest[index]), index)
    if not taken:
        middle = float(np.median(np.abs(late_s)))
        raise PemError(
            f"{where}: no detections within {options.time_tolerance_s:g} s of any of {len(truth)} "
            f"labelled moments; the nearest are {middle:.4g} s away in the middle: are there two "
            "clocks?"
        )
    partner = {index: seen[found] for found, index in taken.items()}
    counts.moments += len(partner)
    counts.alone += len(truth) - len(partner)
    counts.late_s += [float(late_s[index]) for index in partner]
    return [(index, moment, partner.get(index)) for index, moment in enumerate(truth)]


def _clock_doubts(counts: TimedCounts, options: MatchOptions) -> Iterator[str]:
    moments = counts.alone + counts.moments
    if counts.alone:
        yield (
            f"{counts.alone} of {moments} labelled moments have no detections "
            f"within {options.time_tolerance_s:g} s of their own, and are left out: what was not "
            "reported then is not counted as missed"
        )
    late_s = float(np.median(counts.late_s))
    if abs(late_s) > LATE_SHARE * options.time_tolerance_s:
        yield (
            f"stamps of detections are {abs(late_s):.3g} s {'later' if late_s > 0 else 'earlier'} "
            "than those of labels in the middle"
        )


def _boxes_of(moment: Moment, *, is_image: bool) -> FloatArray:
    """Boxes in an image ``[n, 4]``, or centres in the ground plane ``[n, 2]``."""
    if is_image:
        return np.array([each.box_px for each in moment.boxes], dtype=np.float64).reshape(-1, 4)
    return np.array([each.place_m[:2] for each in moment.boxes]).reshape(-1, 2)


def _tally(
    shift: ShiftTally, met: Sequence[tuple[int, Moment, Moment | None]], *, is_image: bool
) -> None:
    paired = [(truth, found) for _, truth, found in met if found is not None]
    shift.add(
        {place: _boxes_of(truth, is_image=is_image) for place, (truth, _) in enumerate(paired)},
        {place: _boxes_of(found, is_image=is_image) for place, (_, found) in enumerate(paired)},
    )


def _rows(
    sequence: str,
    met: Sequence[tuple[int, Moment, Moment | None]],
    options: MatchOptions,
    counts: TimedCounts,
    *,
    is_image: bool,
) -> Iterator[_Row]:
    for frame, truth, found in met:
        if found is None:
            continue
        kept = [each for each in found.boxes if each.score >= options.score_from]
        counts.ignored_detections += len(found.boxes) - len(kept)
        seen = Moment(found.time_ns, found.frame, tuple(kept))
        one, other = (_boxes_of(each, is_image=is_image) for each in (truth, seen))
        if is_image:
            apart, partner = assign_boxes(one.tolist(), other.tolist())
            partner = np.where(apart > options.iou_above, partner, -1)
        else:
            apart, partner = assign_centres(one, other, below_m=options.centres_below_m)
        for label, which, gap in zip(truth.boxes, partner.tolist(), apart.tolist(), strict=True):
            kind = _class_of(label.name, options)
            if (not is_image and kind not in CLASS_ID) or (
                options.types and kind not in options.types
            ):
                counts.other_types += 1
            else:
                counts.missed += which < 0
                yield _Row(
                    sequence,
                    frame,
                    truth.time_ns,
                    replace(label, name=kind),
                    kept[which] if which >= 0 else None,
                    gap,
                )


def _class_of(name: str, options: MatchOptions) -> str:
    if name.isdigit() and int(name) < len(options.class_names):
        name = options.class_names[int(name)]
    return name if name in CLASS_ID else NAMES.get(name.lower(), name)


def _write(out: Path, rows: Sequence[_Row], counts: TimedCounts, *, is_image: bool) -> None:
    """The table; with tracks where every box says who it is.

    Raises:
        PemError: It cannot be written, somebody is there twice, or units cannot be.
    """
    is_followed = all(row.label.who for row in rows)
    seen: set[tuple[str, str, int]] = set()
    for row in rows if is_followed else ():
        key = (row.sequence, row.label.who, row.frame)
        if key in seen:
            raise PemError(
                f"{row.sequence}: the box {row.label.who!r} is there twice at "
                f"{row.time_ns / 1e9:.9f} s"
            )
        seen.add(key)
    counts.tracks = len({key[:2] for key in seen})
    if not is_followed:
        counts.doubts += ("not every reference box has an id: the table has no tracks",)
    if is_image and not is_followed:
        raise PemError("labels: boxes in an image need ids, as only their memory can be fitted")
    if not is_image:
        check_plausible(np.array([_salient(row.label) for row in rows]))
    header = (*(WHO if is_followed else ()), *(IMAGE_COLUMNS if is_image else PLACE_COLUMNS))
    lines = (
        ",".join((*(_who_cells(row) if is_followed else ()), *_cells(row, is_image=is_image)))
        for row in sorted(rows, key=lambda row: (row.sequence, row.label.who, row.frame))
    )
    write_table(out, header, lines)


def _who_cells(row: _Row) -> tuple[str, ...]:
    seconds, rest_ns = divmod(row.time_ns, 1_000_000_000)
    time = f"{seconds}.{rest_ns:09d}"
    return row.sequence, str(row.frame), plain(row.label.who, row.sequence), time


def _cells(row: _Row, *, is_image: bool) -> tuple[str, ...]:
    detected = str(int(row.found is not None))
    if is_image:
        assert row.label.box_px is not None  # noqa: S101  what a topic of images gives
        sides = (f"{side:.10g}" for side in row.label.box_px)
        return (plain(row.label.name, "class"), *sides, detected, f"{row.apart:.4f}")
    salient = (f"{value:.10g}" for value in _salient(row.label))
    errors = ("", "", "")
    if row.found is not None:
        off = row.found.place_m - row.label.place_m
        errors = (f"{row.apart:.6g}", f"{-off[1]:.6g}", f"{off[0]:.6g}")
    return (row.label.name, *salient, detected, *errors)


def _salient(label: SeenBox) -> tuple[float, ...]:
    forward, left, up = label.place_m.tolist()
    length, width, height = label.size_m.tolist()
    ahead = Rotation.from_quat(label.rotation[[1, 2, 3, 0]]).apply([1.0, 0.0, 0.0])
    rotation_y = math.atan2(-ahead[0], -ahead[1])
    alpha = math.remainder(rotation_y - math.atan2(-left, forward), 2.0 * math.pi)
    pose = (-left, height / 2.0 - up, forward, rotation_y)
    return (CLASS_ID[label.name], 0.0, 0.0, alpha, height, width, length, *pose)
