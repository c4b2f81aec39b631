"""nuScenes' ground truth and a file of detections to the table that models learn from.

The folder (``v1.0-mini``, ``v1.0-trainval``) holds JSON lists: scene, sample, sample_data,
calibrated_sensor, sensor, ego_pose, sample_annotation, instance, category, attribute, visibility,
as ``docs/schema_nuscenes.md`` of nuscenes-devkit describes them. Places are global [m], rotations
quaternions w, x, y, z, sizes width, length, height. Of large tables (sample_data, ego_pose,
sample_annotation) rows are read one after the other, and only those of samples that the detections
name are kept.

Matching is that of nuScenes' detection task: within a class, detections in the order of their
scores, each with the nearest obstacle that is still free, if the centres are less than 2 m apart
in the ground plane. Obstacles without any point of lidar or radar in their box are left out, as
there, before anything is matched, and then those beyond their class's range. Detections are not cut
off at that range: what lies just inside is not missed for being reported just outside.

Obstacles are written as KITTI's are, seen from the lidar: x to the right and z forward in the ego's
axes, y down to the middle of the bottom face. What is behind has z below 0. Nothing is truncated:
lidar and cameras look all round.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.json_text import json_rows, parse_json
from pemviz.files.text_files import open_text
from pemviz.pem.data.collect import (
    CLASS_ID,
    OBSTACLE_COLUMNS,
    CollectedCounts,
    Progress,
    plain,
    write_table,
)
from pemviz.pem.data.kitti_labels import UNKNOWN_OCCLUSION, OnBadLine
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import TRACK_COLUMNS

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
FORWARD = np.array([1.0, 0.0, 0.0])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
CLASSES = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "bicycle": "Cyclist"}
"""Classes of the detection task that error models have; a bicycle only with its rider."""
RANGES_M = {"car": 50.0, "truck": 50.0, "pedestrian": 40.0, "bicycle": 40.0}
"""From the ego, as nuScenes' detection task evaluates them."""
RIDDEN = "cycle.with_rider"
MATCHED_BELOW_M = 2.0
"""The detection task's threshold for errors of what was detected."""
TABLE_COLUMNS = (*TRACK_COLUMNS, *OBSTACLE_COLUMNS, "centre_distance_m", *PLANE_COLUMNS)


@dataclass(frozen=True)
class Box:
    """A box in the global frame.

    Attributes:
        size_m: Width, length, height.
        rotation: Quaternion w, x, y, z, of length 1.
    """

    name: str
    centre_m: FloatArray
    size_m: FloatArray
    rotation: FloatArray

    def apart_m(self, other: "Box") -> float:
        """Distance of centres in the ground plane [m]."""
        return math.dist(self.centre_m[:2].tolist(), other.centre_m[:2].tolist())


@dataclass(frozen=True)
class Annotation:
    """A labelled obstacle of one sample.

    Attributes:
        instance: Who it is, within its scene.
        occlusion: 0 to 2 as KITTI's levels; 3 where no visibility is labelled.
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
        frame: Which of the scene's samples it is, counted from 0.
        rate_hz: Samples a second, the scene's median.
    """

    scene: str
    frame: int
    rate_hz: float
    pose: Pose
    annotations: tuple[Annotation, ...]


def _read_samples(
    folder: Path, wanted: Collection[str], *, on_bad_line: OnBadLine
) -> dict[str, Sample]:
    """The samples ``wanted``, by token, in the order of scenes' names and of time.

    A malformed annotation is passed over if ``on_bad_line`` returns.
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


def _box_of(row: Mapping[str, Any], name: str, *, where: str) -> Box:
    size = _vector(row, "size", 3, where=where)
    if not (size > 0.0).all():
        raise PemError(f"{where}: 'size' must be above 0")
    rotation = _vector(row, "rotation", 4, where=where)
    length = float(np.linalg.norm(rotation))
    if not 0.5 < length < 2.0:
        raise PemError(f"{where}: 'rotation' must be a quaternion of length 1")
    return Box(name, _vector(row, "translation", 3, where=where), size, rotation / length)


def _vector(row: Mapping[str, Any], field: str, length: int, *, where: str) -> FloatArray:
    given: Any = row.get(field)
    is_list = isinstance(given, list) and len(given) == length
    if not is_list or not all(type(value) in (int, float) for value in given):
        raise PemError(f"{where}: {field!r} must be a list of {length} numbers")
    values = np.array(given, dtype=np.float64)
    if not (np.abs(values) <= LARGEST_M).all():
        raise PemError(f"{where}: {field!r} must be from {-LARGEST_M:g} to {LARGEST_M:g}")
    return values


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
        """What a table has under a token."""
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
            row["token"]: _vector(
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
        wanted, where = {pose for pose, _ in sights.values()}, f"{self.folder / 'ego_pose.json'}"
        poses = {
            row["token"]: _box_of({**row, "size": [1, 1, 1]}, "ego", where=where)
            for row in self.rows("ego_pose", "translation", "rotation")
            if row["token"] in wanted
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
            _box_of(row, name, where=where),
            plain(row["instance_token"], where),
            OCCLUSION[level] if level else UNKNOWN_OCCLUSION,
            sum(points),
            tuple(str(word("attribute", token)) for token in tokens),
        )


@dataclass
class NuscenesCounts(CollectedCounts):
    """What happened on the way."""

    samples: int = 0
    """Samples with an entry in the detections' file."""
    tracks: int = 0
    observations: int = 0
    other_types: int = 0
    """Labels of the classes that error models do not have, or that were not asked for."""
    without_points: int = 0
    """Labels left out since no point of lidar or radar lies in them."""
    beyond: int = 0
    """Labels left out since they lie beyond their class's range."""


def collect_nuscenes(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    types: tuple[str, ...] = (),
    matched_below_m: float = MATCHED_BELOW_M,
    score_from: float = -math.inf,
    drop_unknown: bool = False,
    skip_bad: bool = False,
    on_progress: Progress | None = None,
) -> NuscenesCounts:
    """Match every labelled obstacle of every sample, and write a row for it.

    ``centre_distance_m`` is that to the detection, and ``x_error_m``, ``z_error_m`` how far it is
    off to the right and forward, reported minus true; empty if missed. A track is an instance,
    rates follow from the samples' times. Samples of the tables that the detections' file does not
    name are of another split, and passed over. The CSV ``out`` is complete or not there.

    Args:
        labels: Folder of tables, such as v1.0-mini.
        detections: JSON as it is submitted: ``results``, a list of boxes for each sample's token.
        out: CSV to write.
        types: Of the error model's classes, such as Car; all that nuScenes has if empty.
        matched_below_m: Centres of a pair are nearer to each other than this.
        score_from: Detections of a lower score are ignored.
        drop_unknown: Whether obstacles without a labelled visibility are left out.
        skip_bad: Whether malformed labels and detections are counted and passed over.
        on_progress: Called with samples done and samples in all.

    Raises:
        PemError: Naming file and row of what is malformed, or what is missing.
    """
    if unknown := [name for name in types if name not in CLASSES.values()]:
        allowed = ", ".join(CLASSES.values())
        raise PemError(f"types: {unknown[0]!r} is no class of nuScenes' here, allowed: {allowed}")
    counts, rows = NuscenesCounts(), list[tuple[tuple[str, str, int], str]]()
    on_bad_line = counts.on_bad_line(skip_bad=skip_bad)
    found = _read_results(detections)
    samples = _read_samples(labels, found, on_bad_line=on_bad_line)
    for done, (token, sample) in enumerate(samples.items(), start=1):
        where = f"{detections}: sample {token!r}"
        boxes = _boxes(found[token], where, score_from, on_bad_line)
        present = [one for one in sample.annotations if one.points > 0]
        counts.without_points += len(sample.annotations) - len(present)
        for one, kind, partner in _counted(
            sample, _matched(present, boxes, matched_below_m), types, drop_unknown, counts
        ):
            key = (sample.scene, one.instance, sample.frame)
            rows.append((key, _line(sample, one, kind, partner)))
            counts.missed += partner is None
        if on_progress is not None:
            on_progress(done, len(samples))
    counts.samples, counts.observations = len(samples), len(rows)
    counts.tracks = len({key[:2] for key, _ in rows})
    counts.judge(len(rows), labels=labels, types=types)
    write_table(out, TABLE_COLUMNS, (line for _, line in sorted(rows)))
    return counts


def _read_results(path: Path) -> Mapping[str, Any]:
    with open_text(path) as stream:
        try:
            content: Any = parse_json(stream.read())
        except ValueError as error:
            raise PemError(f"{path}: {error}") from None
    results: Any = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict) or not results:
        raise PemError(f"{path}: needs 'results', an object with a list for each sample's token")
    return results


def _boxes(entries: Any, where: str, score_from: float, on_bad_line: OnBadLine) -> list[Box]:
    """The boxes of a sample, high scores first; of equal ones the later, as nuScenes sorts them."""
    if not isinstance(entries, list):
        raise PemError(f"{where}: must be a list of boxes")
    scored: list[tuple[float, int, Box]] = []
    for number, entry in enumerate(entries):
        here = f"{where}, box {number}"
        try:
            if not isinstance(entry, dict):
                raise PemError(f"{here}: must be an object")
            name, score = entry.get("detection_name"), entry.get("detection_score")
            if not isinstance(name, str) or not isinstance(score, int | float):
                raise PemError(f"{here}: needs 'detection_name' and the number 'detection_score'")
            if score >= score_from:
                scored.append((score, number, _box_of(entry, name, where=here)))
        except PemError as error:
            on_bad_line(error)
    return [each for *_, each in sorted(scored, key=lambda each: each[:2], reverse=True)]


def _matched(
    present: Sequence[Annotation], reported: Sequence[Box], below_m: float
) -> list[tuple[Annotation, Box | None]]:
    """Each obstacle with what it was found by."""
    found: dict[int, Box] = {}
    for box in reported:
        free = {
            index: one.box.apart_m(box)
            for index, one in enumerate(present)
            if one.box.name == box.name and index not in found
        }
        nearest = min(free, key=free.__getitem__, default=None)
        if nearest is not None and free[nearest] < below_m:
            found[nearest] = box
    return [(one, found.get(index)) for index, one in enumerate(present)]


def _counted(
    sample: Sample,
    matched: Sequence[tuple[Annotation, Box | None]],
    types: tuple[str, ...],
    drop_unknown: bool,
    counts: NuscenesCounts,
) -> Iterator[tuple[Annotation, str, Box | None]]:
    """Those that get a row, with their class and what they were found by."""
    for one, partner in matched:
        kind = CLASSES.get(one.box.name, "")
        ridden = one.box.name != "bicycle" or RIDDEN in one.attributes
        if not kind or not ridden or (types and kind not in types):
            counts.other_types += 1
        elif np.hypot(*(one.box.centre_m - sample.pose.ego_m)[:2]) >= RANGES_M[one.box.name]:
            counts.beyond += 1
        elif drop_unknown and one.occlusion == UNKNOWN_OCCLUSION:
            counts.dropped += 1
        else:
            yield one, kind, partner


def _line(sample: Sample, one: Annotation, kind: str, found: Box | None) -> str:
    right, up, forward = _from_lidar(sample, one.box.centre_m)
    width, length, height = one.box.size_m.tolist()
    ahead = _turned(sample.pose.rotation * CONJUGATE, _turned(one.box.rotation, FORWARD))
    rotation_y = math.atan2(-ahead[0], -ahead[1])
    values = (
        *(CLASS_ID[kind], 0.0, one.occlusion),
        math.remainder(rotation_y - math.atan2(right, forward), 2.0 * math.pi),
        *(height, width, length, right, height / 2.0 - up, forward, rotation_y),
    )
    who = (sample.scene, str(sample.frame), one.instance, f"{sample.rate_hz:.10g}", kind)
    cells = (*who, *(f"{value:.10g}" for value in values), str(int(found is not None)))
    if found is None:
        return ",".join((*cells, "", "", ""))
    reported = _from_lidar(sample, found.centre_m)
    off = (one.box.apart_m(found), reported[0] - right, reported[2] - forward)
    return ",".join((*cells, *(f"{value:.6g}" for value in off)))


def _from_lidar(sample: Sample, place_m: FloatArray) -> tuple[float, float, float]:
    """A global place seen from the lidar: to the right, up and forward in the ego's axes [m]."""
    pose = sample.pose
    own = _turned(pose.rotation * CONJUGATE, place_m - pose.ego_m) - pose.lidar_m
    forward, left, up = own.tolist()
    return -left, up, forward


def _turned(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """A vector ``[3]`` turned by a quaternion w, x, y, z of length 1."""
    twice = 2.0 * np.cross(rotation[1:], vector)
    return vector + rotation[0] * twice + np.cross(rotation[1:], twice)
