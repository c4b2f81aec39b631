"""Two topics of rosbags to the table that models learn from: reference boxes, and detections.

Messages meet in time: each message of reference boxes and the nearest of detections, one to one,
within a stated tolerance, by their headers' stamps. Those without a partner are left out and
counted: nothing says what a detector would have reported then. Boxes meet in place: centres in the
ground plane nearer than a stated distance, or in an image by overlap.

Places are the vehicle's: x forward, y left, z up. Where both topics are in a fixed frame (``map``),
the ego's own topic turns them into it. The table's are KITTI's (x right, y down, z forward),
heights from the frame's origin; what a box of ROS does not say, truncation and occlusion, is 0.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.collect import (
    CLASS_ID,
    NUMBERED_CLASSES,
    OBSTACLE_COLUMNS,
    CollectedCounts,
    Progress,
    plain,
    write_table,
)
from pemviz.pem.data.frame_shift import ShiftTally
from pemviz.pem.data.matching import PAPER_IOU, assign_boxes, assign_centres, iou, nearness
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.ros_bags import EgoPose, Moment, SeenBox, bags_in, read_ego, read_moments
from pemviz.pem.data.table import OUTCOME_COLUMN, TIME_COLUMN
from pemviz.pem.data.units import check_plausible

TIME_TOLERANCE_S = 0.05
MATCHED_BELOW_M = 2.0
FIXED_FRAMES = ("map", "odom", "world", "earth", "local")
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


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """What counts as a detection, and where it is found.

    Attributes:
        labels_topic: Reference boxes.
        detections_topic: What the detector reported.
        ego_topic: Where the ego is; empty where boxes are in its own frame.
        time_tolerance_s: Of the stamps of two messages that belong together.
        centres_below_m: Of two boxes that do.
        iou_above: Of two boxes in an image.
        types: Classes that count as obstacles; all if empty.
        class_names: Names of the classes 0, 1, ... where messages have numbers.
        score_from: Detections of a lower score are ignored.
    """

    labels_topic: str
    detections_topic: str
    ego_topic: str = ""
    time_tolerance_s: float = TIME_TOLERANCE_S
    centres_below_m: float = MATCHED_BELOW_M
    iou_above: float = PAPER_IOU
    types: tuple[str, ...] = ()
    class_names: tuple[str, ...] = NUMBERED_CLASSES
    score_from: float = -math.inf


@dataclass
class BagCounts(CollectedCounts):
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


def collect_rosbag(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    options: BagOptions,
    on_progress: Progress | None = None,
) -> BagCounts:
    """Match every reference box with the detections of its moment, and write a row for it.

    A bag is a sequence; ``labels`` and ``detections`` are one bag, two, or folders with bags of the
    same names. Tracks are what reference boxes say by ``id`` or ``object_id``; where they do not,
    the table has none. The CSV ``out`` is complete or not there.

    Raises:
        PemError: Naming bag, topic and message of what is malformed, missing, or of another clock,
            frame or unit.
    """
    if unknown := [name for name in options.types if name not in CLASS_ID]:
        raise PemError(f"types: {unknown[0]!r} is no class, allowed: {', '.join(CLASS_ID)}")
    counts, rows = BagCounts(), list[_Row]()
    pairs = _paired(labels, detections)
    place = partial(nearness, below_m=2.0 * options.centres_below_m)
    is_image, shift = False, ShiftTally()
    for done, (name, own, other) in enumerate(pairs, start=1):
        plain(name, labels)
        truth, in_image = read_moments(own, options.labels_topic, role="labels_topic")
        seen, seen_in_image = read_moments(other, options.detections_topic, role="detections_topic")
        if in_image != seen_in_image:
            raise PemError(f"{own}: one topic's boxes are in an image, the other's in space")
        if not in_image:
            ego = read_ego(own, options.ego_topic) if options.ego_topic else None
            truth = _in_ego(truth, ego, own, options)
            seen = _in_ego(seen, ego, other, options)
            _check_frames(truth, seen, own)
        if done == 1:
            is_image, shift = in_image, ShiftTally(iou if in_image else place)
        met = _met(truth, seen, options, counts, where=own)
        _tally(shift, met, is_image=in_image)
        rows += _rows(name, met, options, counts, is_image=in_image)
        if on_progress is not None:
            on_progress(done, len(pairs))
    counts.sequences, counts.observations = len(pairs), len(rows)
    counts.judge(len(rows), labels=labels, types=options.types, shift=shift)
    counts.doubts += tuple(_clock_doubts(counts, options))
    _write(out, rows, counts, is_image=is_image)
    return counts


def _paired(labels: Path, detections: Path) -> list[tuple[str, Path, Path]]:
    own, other = bags_in(labels), bags_in(detections)
    if len(own) == len(other) == 1:
        (name, bag), (found,) = next(iter(own.items())), other.values()
        return [(name, bag, found)]
    if missing := [name for name in own if name not in other]:
        raise PemError(f"{detections}: no bag {missing[0]!r}, which is one of the labels")
    return [(name, bag, other[name]) for name, bag in own.items()]


def _in_ego(
    moments: Sequence[Moment], ego: Sequence[EgoPose] | None, bag: Path, options: BagOptions
) -> list[Moment]:
    """Messages with places in the ego's frame; those for which its pose is unknown are left out."""
    fixed = [each for each in moments if each.frame.strip("/") in FIXED_FRAMES]
    if not fixed:
        return list(moments)
    if ego is None:
        raise PemError(
            f"{bag}: boxes are in the fixed frame {fixed[0].frame!r}: ego_topic must say where the "
            "ego is (nav_msgs/msg/Odometry or geometry_msgs/msg/PoseStamped)"
        )
    if strange := {each.frame for each in fixed} - {each.frame for each in ego}:
        raise PemError(
            f"{bag}: {options.ego_topic}: is in {ego[0].frame!r}, boxes in {min(strange)!r}"
        )
    times = np.array([each.time_ns for each in ego])
    start, most = int(times[0]), options.time_tolerance_s
    since_s = (times - start) / 1e9
    places = np.stack([each.place_m for each in ego])
    # scipy wants x, y, z, w, and two poses at least
    turns = Rotation.from_quat(np.stack([each.rotation[[1, 2, 3, 0]] for each in ego]))
    turn_at = Slerp(since_s, turns) if len(ego) > 1 else None
    found: list[Moment] = []
    for moment in moments:
        at_s = (moment.time_ns - start) / 1e9
        if np.abs(since_s - at_s).min() > most:
            continue
        inside = float(np.clip(at_s, 0.0, since_s[-1]))
        place = np.array([np.interp(inside, since_s, places[:, axis]) for axis in range(3)])
        turn = turns[0] if turn_at is None else turn_at(inside)
        boxes = tuple(_seen_from(box, place, turn) for box in moment.boxes)
        found.append(Moment(moment.time_ns, f"the ego by {options.ego_topic}", boxes))
    if not found:
        raise PemError(
            f"{bag}: {options.ego_topic}: no pose within {most:g} s of any message of boxes"
        )
    return found


def _seen_from(box: SeenBox, place_m: FloatArray, turn: Rotation) -> SeenBox:
    back = turn.inv()
    own = (back * Rotation.from_quat(box.rotation[[1, 2, 3, 0]])).as_quat()[[3, 0, 1, 2]]
    moved = back.apply(box.place_m - place_m)
    return replace(box, place_m=moved, rotation=own)


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
    options: BagOptions,
    counts: BagCounts,
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


def _clock_doubts(counts: BagCounts, options: BagOptions) -> Iterator[str]:
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
    options: BagOptions,
    counts: BagCounts,
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


def _class_of(name: str, options: BagOptions) -> str:
    if name.isdigit() and int(name) < len(options.class_names):
        name = options.class_names[int(name)]
    return name if name in CLASS_ID else NAMES.get(name.lower(), name)


def _write(out: Path, rows: Sequence[_Row], counts: BagCounts, *, is_image: bool) -> None:
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
