"""Boxes of a topic of a rosbag of ROS 2, a folder or a .mcap file, by ``rosbags``.

Read are vision_msgs' Detection3DArray and Detection2DArray, Autoware's DetectedObjects and
TrackedObjects, and where the ego is: nav_msgs' Odometry or geometry_msgs' PoseStamped. Messages are
decoded by the definitions that the bag itself holds; without them it is refused, as fields read in
another version's order would be other numbers.
"""

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.faults import exception_text
from pemviz.files.atomic import is_file, is_folder
from pemviz.pem.data.kitti_labels import FARTHEST_PX, Box
from pemviz.pem.data.timed_boxes import Moment, SeenBox

BOXES_3D = {
    "vision_msgs/msg/Detection3DArray": "detections",
    "autoware_perception_msgs/msg/DetectedObjects": "objects",
    "autoware_perception_msgs/msg/TrackedObjects": "objects",
    "autoware_auto_perception_msgs/msg/DetectedObjects": "objects",
    "autoware_auto_perception_msgs/msg/TrackedObjects": "objects",
}
"""Types of messages, and which field holds what was seen."""
BOXES_2D = {"vision_msgs/msg/Detection2DArray": "detections"}
EGO_TYPES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
AUTOWARE_CLASSES = (
    *("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian"),
)
"""Of Autoware's ObjectClassification, by their numbers."""
SUFFIXES = (".mcap",)
METADATA = "metadata.yaml"
LARGEST_M = 1e6
SHOWN_TOPICS = 12


@dataclass(frozen=True)
class EgoPose:
    """Where the ego is in the frame of places."""

    time_ns: int
    frame: str
    place_m: FloatArray
    rotation: FloatArray


def bags_in(path: Path) -> dict[str, Path]:
    """Bags by name: one, or those of a folder.

    Raises:
        PemError: There is none.
    """
    if _is_bag(path):
        return {path.stem if is_file(path) else path.name: path}
    found: dict[str, Path] = {}
    if is_folder(path):
        bags = (each for each in sorted(path.iterdir()) if _is_bag(each))
        found = {each.stem if is_file(each) else each.name: each for each in bags}
    if not found:
        endings = ", ".join(SUFFIXES)
        raise PemError(f"{path}: no rosbag ({endings}, or a folder with {METADATA}) nor one in it")
    return found


def holds_bags(path: Path) -> bool:
    """Whether it is a bag, or a folder with some."""
    return _is_bag(path) or (is_folder(path) and any(_is_bag(one) for one in path.iterdir()))


def _is_bag(path: Path) -> bool:
    if is_folder(path):
        return is_file(path / METADATA)
    return path.suffix in SUFFIXES and is_file(path)


def read_moments(bag: Path, topic: str, *, role: str) -> tuple[list[Moment], bool]:
    """A topic's messages of boxes, by time, and whether these lie in an image.

    Raises:
        PemError: The bag cannot be read, has no such topic, or none of boxes, or a message is not
            sound; two have one time stamp, or one has none.
    """
    moments: list[Moment] = []
    types = {**BOXES_3D, **BOXES_2D}
    with _messages(bag, topic, types, role=role) as (kind, messages):
        is_image = kind in BOXES_2D
        for number, message in enumerate(messages, start=1):
            where = f"{bag}: {topic}, message {number}"
            with _sound(where):
                boxes = tuple(
                    _box(one, is_image=is_image, where=f"{where}, box {place}")
                    for place, one in enumerate(getattr(message, types[kind]), start=1)
                )
                moments.append(Moment(_time_ns(message, where), message.header.frame_id, boxes))
    _check_times([each.time_ns for each in moments], where=f"{bag}: {topic}")
    return sorted(moments, key=lambda each: each.time_ns), is_image


def read_ego(bag: Path, topic: str) -> list[EgoPose]:
    """Where the ego is, by time.

    Raises:
        PemError: As :func:`read_moments`.
    """
    poses: list[EgoPose] = []
    with _messages(bag, topic, EGO_TYPES, role="ego_topic") as (_, messages):
        for number, message in enumerate(messages, start=1):
            where = f"{bag}: {topic}, message {number}"
            with _sound(where):
                pose = message.pose
                place, rotation = _placed(getattr(pose, "pose", pose), where)
                time_ns = _time_ns(message, where)
                poses.append(EgoPose(time_ns, message.header.frame_id, place, rotation))
    _check_times([each.time_ns for each in poses], where=f"{bag}: {topic}")
    return sorted(poses, key=lambda each: each.time_ns)


@contextmanager
def _messages(
    bag: Path, topic: str, types: Sequence[str] | Mapping[str, str], *, role: str
) -> Generator[tuple[str, Iterator[Any]]]:
    """A topic's type and decoded messages."""
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  optional
    except ImportError as error:
        message = f"format rosbag needs the package rosbags (pip install 'pemviz[logs]'): {error}"
        raise PemError(message) from None
    reader: Any = None
    with _readable(bag):
        reader = AnyReader([bag])
        reader.open()
    try:
        kinds = {each.topic: each.msgtype for each in reader.connections}
        if kinds.get(topic) not in types:
            known = [f"{name} ({kind})" for name, kind in sorted(kinds.items()) if kind in types]
            what = f"is of {kinds[topic]}" if topic in kinds else "is not in it"
            allowed = ", ".join(known[:SHOWN_TOPICS]) or f"none; readable are {', '.join(types)}"
            raise PemError(f"{bag}: {role} = {topic!r} {what}, allowed: {allowed}")
        chosen = [each for each in reader.connections if each.topic == topic]

        def messages() -> Iterator[Any]:
            raw = reader.messages(connections=chosen)
            while True:
                with _readable(bag):
                    found = next(raw, None)
                if found is None:
                    return
                connection, _, data = found
                with _readable(bag):
                    message = reader.deserialize(data, connection.msgtype)
                yield message

        yield kinds[topic], messages()
    finally:
        reader.close()


@contextmanager
def _readable(bag: Path) -> Generator[None]:
    """A damaged bag makes its reader raise anything."""
    try:
        yield
    except Exception as error:
        raise PemError(f"{bag}: not a readable rosbag ({exception_text(error)})") from None


@contextmanager
def _sound(where: str) -> Generator[None]:
    """A message of another version lacks fields."""
    try:
        yield
    except (AttributeError, TypeError, IndexError) as error:
        raise PemError(f"{where}: {error}") from None


def _time_ns(message: Any, where: str) -> int:
    stamp = message.header.stamp
    time_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if time_ns <= 0:
        raise PemError(f"{where}: its header has no time stamp ({time_ns} ns)")
    return time_ns


def _check_times(times_ns: Sequence[int], *, where: str) -> None:
    if not times_ns:
        raise PemError(f"{where}: no message")
    if again := len(times_ns) - len(set(times_ns)):
        seen: set[int] = set()
        first = next(each for each in times_ns if each in seen or seen.add(each))
        raise PemError(
            f"{where}: {again} messages have the time stamp of another, the first "
            f"{first / 1e9:.9f} s: record each once, or publish a moment in one message"
        )


def _box(one: Any, *, is_image: bool, where: str) -> SeenBox:
    name, score = _classified(one)
    if not np.isfinite(score):
        raise PemError(f"{where}: its score is {score}")
    if is_image:
        nothing = np.zeros(3)
        return SeenBox(name, score, _who(one), nothing, nothing, nothing, _pixels(one.bbox, where))
    if hasattr(one, "bbox"):
        place, rotation = _placed(one.bbox.center, where)
        size = one.bbox.size
    else:
        place, rotation = _placed(one.kinematics.pose_with_covariance.pose, where)
        size = one.shape.dimensions
    size_m = np.array([size.x, size.y, size.z], dtype=np.float64)
    if not ((size_m > 0.0) & (size_m <= LARGEST_M)).all():
        raise PemError(f"{where}: its size is {size_m.tolist()}, allowed: above 0")
    return SeenBox(name, score, _who(one), place, rotation, size_m)


def _classified(one: Any) -> tuple[str, float]:
    """The likeliest class and its score."""
    if hasattr(one, "classification"):
        labels = sorted(one.classification, key=lambda each: -each.probability)
        label = int(labels[0].label) if labels else 0
        name = AUTOWARE_CLASSES[label] if label < len(AUTOWARE_CLASSES) else str(label)
        return name, float(one.existence_probability)
    guesses = [getattr(each, "hypothesis", each) for each in one.results]
    if not guesses:
        return "", 1.0
    best = max(guesses, key=lambda each: each.score)
    return str(best.class_id if hasattr(best, "class_id") else best.id), float(best.score)


def _who(one: Any) -> str:
    if hasattr(one, "object_id"):
        return bytes(bytearray(one.object_id.uuid)).hex()
    return str(getattr(one, "id", "") or getattr(one, "tracking_id", ""))


def _placed(pose: Any, where: str) -> tuple[FloatArray, FloatArray]:
    at, turn = pose.position, pose.orientation
    place = np.array([at.x, at.y, at.z], dtype=np.float64)
    rotation = np.array([turn.w, turn.x, turn.y, turn.z], dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        length = float(np.linalg.norm(rotation))
    if not (np.abs(place) <= LARGEST_M).all():
        raise PemError(f"{where}: its place is {place.tolist()}, allowed: at most {LARGEST_M:g} m")
    if not 0.5 < length < 2.0:
        raise PemError(f"{where}: its orientation is no quaternion of length 1")
    return place, rotation / length


def _pixels(bbox: Any, where: str) -> Box:
    centre = getattr(bbox.center, "position", bbox.center)
    half = bbox.size_x / 2.0, bbox.size_y / 2.0
    sides = (centre.x - half[0], centre.y - half[1], centre.x + half[0], centre.y + half[1])
    if not all(abs(side) <= FARTHEST_PX for side in sides) or min(half) < 0.0:
        raise PemError(f"{where}: its box is {sides}, allowed: within {FARTHEST_PX:g} px")
    return sides
