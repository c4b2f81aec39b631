"""Two topics of rosbags to the table that models learn from: reference boxes, and detections.

Messages meet by their headers' stamps, see :mod:`pemviz.pem.data.timed_boxes`. Places are the
vehicle's: x forward, y left, z up. Where both topics are in a fixed frame (``map``), the ego's own
topic turns them into it. The table's are KITTI's (x right, y down, z forward), heights from the
frame's origin.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.pem.data.collect import Progress
from pemviz.pem.data.ros_bags import EgoPose, bags_in, read_ego, read_moments
from pemviz.pem.data.timed_boxes import MatchOptions, Moment, SeenBox, TimedCounts, TimedTable

FIXED_FRAMES = ("map", "odom", "world", "earth", "local")


@dataclass(frozen=True, kw_only=True)
class BagOptions(MatchOptions):
    """What counts as a detection, and where it is found.

    Attributes:
        labels_topic: Reference boxes.
        detections_topic: What the detector reported.
        ego_topic: Where the ego is; empty where boxes are in its own frame.
    """

    labels_topic: str
    detections_topic: str
    ego_topic: str = ""


def collect_rosbag(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    options: BagOptions,
    on_progress: Progress | None = None,
) -> TimedCounts:
    """Match every reference box with the detections of its moment, and write a row for it.

    A bag is a sequence; ``labels`` and ``detections`` are one bag, two, or folders with bags of the
    same names. Tracks are what reference boxes say by ``id`` or ``object_id``; where they do not,
    the table has none. The CSV ``out`` is complete or not there.

    Raises:
        PemError: Naming bag, topic and message of what is malformed, missing, or of another clock,
            frame or unit.
    """
    table, pairs = TimedTable(options), _paired(labels, detections)
    for done, (name, own, other) in enumerate(pairs, start=1):
        truth, is_image = read_moments(own, options.labels_topic, role="labels_topic")
        seen, seen_in_image = read_moments(other, options.detections_topic, role="detections_topic")
        if is_image != seen_in_image:
            raise PemError(f"{own}: one topic's boxes are in an image, the other's in space")
        if not is_image:
            ego = read_ego(own, options.ego_topic) if options.ego_topic else None
            truth = _in_ego(truth, ego, own, options)
            seen = _in_ego(seen, ego, other, options)
        table.add(name, truth, seen, where=own, is_image=is_image)
        if on_progress is not None:
            on_progress(done, len(pairs))
    return table.write(out, labels=labels)


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
