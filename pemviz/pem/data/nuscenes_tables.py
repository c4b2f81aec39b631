"""nuScenes' own tables, as far as obstacles and what was detected of them go.

The folder (``v1.0-mini``, ``v1.0-trainval``) holds JSON lists: scene, sample, sample_data,
calibrated_sensor, sensor, ego_pose, sample_annotation, instance, category, attribute, visibility,
as ``docs/schema_nuscenes.md`` of nuscenes-devkit describes them. Places are global [m], rotations
quaternions w, x, y, z, sizes width, length, height. Of large tables (sample_data, ego_pose,
sample_annotation) rows are read one after the other, and only those of the samples asked for kept.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.json_text import json_rows
from pemviz.pem.data.kitti_labels import UNKNOWN_OCCLUSION, OnBadLine

SENSOR = "LIDAR_TOP"
"""Whose ego pose nuScenes' evaluation takes for a sample's, and from where obstacles are seen."""
OCCLUSION = {"v80-100": 0, "v60-80": 1, "v40-60": 2, "v0-40": 2}
"""KITTI's level for each bin of what is visible."""
DETECTION_NAMES = {
    "movable_object.barrier": "barrier",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}
"""The detection task's class for each category; others are not of the task."""
ANNOTATION_FIELDS = (
    *("sample_token", "instance_token", "visibility_token", "attribute_tokens"),
    *("num_lidar_pts", "num_radar_pts"),
)
LARGEST_M = 1e6
"""No place and no size is larger."""


@dataclass(frozen=True)
class Box:
    """A box in the global frame.

    Attributes:
        name: Class of the detection task.
        centre_m: x, y, z.
        size_m: Width, length, height.
        rotation: Quaternion w, x, y, z, of length 1.
    """

    name: str
    centre_m: FloatArray
    size_m: FloatArray
    rotation: FloatArray


@dataclass(frozen=True)
class Annotation:
    """A labelled obstacle of one sample.

    Attributes:
        box: Where it is.
        instance: Who it is, within its scene.
        occlusion: 0 to 2 as KITTI's levels; 3 where no visibility is labelled.
        points: Of lidar and radar in its box.
        attributes: Names, such as cycle.with_rider.
    """

    box: Box
    instance: str
    occlusion: int
    points: int
    attributes: tuple[str, ...]


@dataclass(frozen=True)
class Pose:
    """Where a sample is seen from.

    Attributes:
        ego_m: Place of the ego's frame (rear axle, on the road) in the global one, x, y, z.
        rotation: Quaternion of the ego's frame (x forward, y left, z up).
        lidar_m: Place of the lidar in the ego's frame.
    """

    ego_m: FloatArray
    rotation: FloatArray
    lidar_m: FloatArray


@dataclass(frozen=True)
class Sample:
    """A moment of a scene.

    Attributes:
        scene: Its name.
        frame: Which of the scene's samples it is, counted from 0.
        rate_hz: Samples a second, the scene's median.
        pose: Where the ego is.
        annotations: What is labelled.
    """

    scene: str
    frame: int
    rate_hz: float
    pose: Pose
    annotations: tuple[Annotation, ...]


def read_samples(
    folder: Path, wanted: Collection[str], *, on_bad_line: OnBadLine
) -> dict[str, Sample]:
    """The samples ``wanted``, by token, in the order of scenes' names and of time.

    Args:
        folder: With the tables.
        wanted: Tokens of samples.
        on_bad_line: Called with what is wrong with an annotation, which is passed over if that
            returns.

    Raises:
        PemError: A table is missing or malformed, or does not have what another refers to.
    """
    if not is_folder(folder):
        raise PemError(f"{folder}: no folder with nuScenes' tables (scene.json, sample.json, ...)")
    tables = _Tables(folder)
    order = tables.order(wanted)
    poses = tables.poses(order)
    annotations = tables.annotations(order, on_bad_line)
    return {
        token: Sample(*place, poses[token], tuple(annotations.get(token, ())))
        for token, place in order.items()
    }


def box_of(row: Mapping[str, Any], name: str, *, where: str) -> Box:
    """The box of an annotation or a detection.

    Raises:
        PemError: A field is missing or no list of so many finite numbers, or a size is not above 0.
    """
    size = vector(row, "size", 3, where=where)
    if not (size > 0.0).all():
        raise PemError(f"{where}: 'size' must be above 0")
    rotation = vector(row, "rotation", 4, where=where)
    length = float(np.linalg.norm(rotation))
    if not 0.5 < length < 2.0:
        raise PemError(f"{where}: 'rotation' must be a quaternion of length 1")
    return Box(name, vector(row, "translation", 3, where=where), size, rotation / length)


def vector(row: Mapping[str, Any], field: str, length: int, *, where: str) -> FloatArray:
    """A field's numbers ``[length]``.

    Raises:
        PemError: It has no such list.
    """
    given: Any = row.get(field)
    is_list = isinstance(given, list) and len(given) == length
    if not is_list or not all(type(value) in (int, float) for value in given):
        raise PemError(f"{where}: {field!r} must be a list of {length} numbers")
    values = np.array(given, dtype=np.float64)
    if not (np.abs(values) <= LARGEST_M).all():
        raise PemError(f"{where}: {field!r} must be from {-LARGEST_M:g} to {LARGEST_M:g}")
    return values


def plain(name: object, where: object) -> str:
    """A name that can stand in a table.

    Raises:
        PemError: It is none.
    """
    if not isinstance(name, str) or not name.isprintable() or "," in name:
        raise PemError(f"{where}: {str(name)[:40]!r} must be a name without commas")
    return name


@dataclass(frozen=True)
class _Tables:
    folder: Path

    def rows(self, table: str, *needs: str) -> Any:
        path = self.folder / f"{table}.json"
        if not is_file(path):
            raise PemError(f"{path}: no such file; nuScenes' tables have one")
        return json_rows(path, needs=("token", *needs))

    def names(self, table: str, field: str) -> dict[str, Any]:
        return {row["token"]: row[field] for row in self.rows(table, field)}

    def get(self, rows: Mapping[str, Any], token: object, table: str, *, whose: str) -> Any:
        """What a table has under a token.

        Raises:
            PemError: Nothing.
        """
        if not isinstance(token, str) or token not in rows:
            raise PemError(f"{self.folder / table}.json: no row {token!r}, which {whose} refers to")
        return rows[token]

    def order(self, wanted: Collection[str]) -> dict[str, tuple[str, int, float]]:
        """Scene, frame and rate of each sample wanted."""
        scenes, of_scene = self.names("scene", "name"), dict[str, list[tuple[int, str]]]()
        for row in self.rows("sample", "timestamp", "scene_token"):
            time_us = row["timestamp"]
            if type(time_us) is not int:
                raise PemError(f"{self.folder / 'sample.json'}: a 'timestamp' is no whole number")
            scene = self.get(scenes, row["scene_token"], "scene", whose="a sample")
            of_scene.setdefault(plain(scene, self.folder / "scene.json"), []).append(
                (time_us, row["token"])
            )
        found: dict[str, tuple[str, int, float]] = {}
        for scene, samples in sorted(of_scene.items()):
            samples.sort()
            steps = np.diff([time_us for time_us, _ in samples]).tolist()
            rate_hz = 1e6 / median(steps) if steps and median(steps) > 0 else 2.0
            found |= {
                token: (scene, frame, rate_hz)
                for frame, (_, token) in enumerate(samples)
                if token in wanted
            }
        missing = [token for token in wanted if token not in found]
        if missing:
            raise PemError(
                f"{self.folder / 'sample.json'}: no sample {missing[0]!r}, which has detections"
            )
        return found

    def poses(self, samples: Collection[str]) -> dict[str, Pose]:
        """The ego's place and rotation, and the lidar's place, of each sample."""
        channels = self.names("sensor", "channel")
        places = {
            row["token"]: vector(
                row, "translation", 3, where=f"{self.folder / 'calibrated_sensor.json'}"
            )
            for row in self.rows("calibrated_sensor", "sensor_token", "translation")
            if self.get(channels, row["sensor_token"], "sensor", whose="a calibrated_sensor")
            == SENSOR
        }
        needs = ("sample_token", "ego_pose_token", "calibrated_sensor_token", "is_key_frame")
        sights = {
            row["sample_token"]: (row["ego_pose_token"], places[row["calibrated_sensor_token"]])
            for row in self.rows("sample_data", *needs)
            if row["is_key_frame"]
            and row["sample_token"] in samples
            and row["calibrated_sensor_token"] in places
        }
        asked, where = {pose for pose, _ in sights.values()}, f"{self.folder / 'ego_pose.json'}"
        poses = {
            row["token"]: box_of({**row, "size": [1, 1, 1]}, "ego", where=where)
            for row in self.rows("ego_pose", "translation", "rotation")
            if row["token"] in asked
        }
        found: dict[str, Pose] = {}
        for token in samples:
            pose, place = self.get(sights, token, "sample_data", whose=f"{SENSOR} of a sample")
            ego = self.get(poses, pose, "ego_pose", whose="a sample_data")
            found[token] = Pose(ego.centre_m, ego.rotation, place)
        return found

    def annotations(
        self, samples: Collection[str], on_bad_line: OnBadLine
    ) -> dict[str, list[Annotation]]:
        """What is labelled in each sample, of the detection task's classes."""
        words = {
            "category": self.names("category", "name"),
            "visibility": self.names("visibility", "level"),
            "attribute": self.names("attribute", "name"),
            "instance": self.names("instance", "category_token"),
        }
        found: dict[str, list[Annotation]] = {}
        for row in self.rows("sample_annotation", *ANNOTATION_FIELDS):
            if row["sample_token"] not in samples:
                continue
            try:
                one = self.annotation(row, words)
            except PemError as error:
                on_bad_line(error)
                continue
            if one is not None:
                found.setdefault(row["sample_token"], []).append(one)
        return found

    def annotation(
        self, row: Mapping[str, Any], words: Mapping[str, Mapping[str, Any]]
    ) -> Annotation | None:
        """A row's obstacle; none if its category is not of the detection task."""
        where = f"{self.folder / 'sample_annotation.json'}: {row['token']!r}"

        def word(table: str, token: object) -> Any:
            return self.get(words[table], token, table, whose=where)

        name = DETECTION_NAMES.get(word("category", word("instance", row["instance_token"])))
        if name is None:
            return None
        level = row["visibility_token"] and word("visibility", row["visibility_token"])
        if level and level not in OCCLUSION:
            message = f"'level' is {level!r}, allowed: {', '.join(OCCLUSION)}"
            raise PemError(f"{self.folder / 'visibility.json'}: {message}")
        points, tokens = (row["num_lidar_pts"], row["num_radar_pts"]), row["attribute_tokens"]
        if not all(type(number) is int for number in points) or not isinstance(tokens, list):
            raise PemError(
                f"{where}: 'num_lidar_pts' and 'num_radar_pts' must be whole numbers, "
                "'attribute_tokens' a list"
            )
        return Annotation(
            box_of(row, name, where=where),
            plain(row["instance_token"], where),
            OCCLUSION[level] if level else UNKNOWN_OCCLUSION,
            sum(points),
            tuple(str(word("attribute", token)) for token in tokens),
        )
