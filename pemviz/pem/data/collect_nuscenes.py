"""nuScenes' ground truth and a file of detections to the table that models learn from.

Matching is that of nuScenes' detection task: within a class, detections in the order of their
scores, each with the nearest obstacle that is still free, if the centres are less than 2 m apart
in the ground plane. Obstacles without any point of lidar or radar in their box are left out, as
there, before anything is matched, and then those beyond their class's range. Detections are not cut
off at that range: what lies just inside is not missed for being reported just outside.

Obstacles are told as KITTI's are, seen from the lidar: x to the right and z forward in the ego's
axes, y down to the middle of the bottom face. What is behind has z below 0. Nothing is truncated:
lidar and cameras look all round.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.errors import PemError
from pemviz.files.json_text import parse_json
from pemviz.files.text_files import open_text
from pemviz.pem.data.collect_tracks import TRACK_COLUMNS
from pemviz.pem.data.collected import CLASS_ID, CollectedCounts, write_table
from pemviz.pem.data.kitti_labels import UNKNOWN_OCCLUSION, OnBadLine
from pemviz.pem.data.nuscenes_tables import Annotation, Box, Sample, box_of, read_samples
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN
from pemviz.pem.models.protocol import SALIENT_COLUMNS

CLASSES = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "bicycle": "Cyclist"}
"""Classes of the detection task that error models have; a bicycle only with its rider."""
RANGES_M = {"car": 50.0, "truck": 50.0, "pedestrian": 40.0, "bicycle": 40.0}
"""From the ego, as nuScenes' detection task evaluates them."""
RIDDEN = "cycle.with_rider"
MATCHED_BELOW_M = 2.0
"""The detection task's threshold for errors of what was detected."""
TABLE_COLUMNS = (
    *(*TRACK_COLUMNS, "type", *SALIENT_COLUMNS, OUTCOME_COLUMN),
    *("centre_distance_m", *PLANE_COLUMNS),
)


@dataclass
class NuscenesCounts(CollectedCounts):
    """What happened on the way."""

    samples: int = 0
    """Samples with an entry in the detections' file."""
    tracks: int = 0
    """Obstacles that were followed."""
    observations: int = 0
    """Rows written: an obstacle in a sample."""
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
    on_progress: Callable[[int, int], None] | None = None,
) -> NuscenesCounts:
    """Match every labelled obstacle of every sample, and write a row for it.

    ``centre_distance_m`` is that to the detection, and ``x_error_m``, ``z_error_m`` how far it is
    off to the right and forward, reported minus true; empty if missed. A track is an instance,
    rates follow from the samples' times. Samples of the tables that the detections' file does not
    name are of another split, and passed over.

    Args:
        labels: Folder of tables, such as v1.0-mini.
        detections: JSON as it is submitted: ``results``, a list of boxes for each sample's token.
        out: CSV to write; complete or not there.
        types: Of the error model's classes, such as Car; all that nuScenes has if empty.
        matched_below_m: Centres of a pair are nearer to each other than this.
        score_from: Detections of a lower score are ignored.
        drop_unknown: Whether obstacles without a labelled visibility are left out.
        skip_bad: Whether malformed labels and detections are counted and passed over.
        on_progress: Told (samples done, samples in all).

    Raises:
        PemError: Naming file and row of what is malformed, or what is missing.
    """
    if unknown := [name for name in types if name not in CLASSES.values()]:
        allowed = ", ".join(CLASSES.values())
        raise PemError(f"types: {unknown[0]!r} is no class of nuScenes' here, allowed: {allowed}")
    counts, rows = NuscenesCounts(), list[tuple[tuple[str, str, int], str]]()
    on_bad_line = counts.on_bad_line(skip_bad=skip_bad)
    found = _read_results(detections)
    samples = read_samples(labels, found, on_bad_line=on_bad_line)
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
    write_table(out, TABLE_COLUMNS, (line for _, line in sorted(rows)))
    return counts


def _read_results(path: Path) -> Mapping[str, Any]:
    """What was detected, by sample.

    Raises:
        PemError: It cannot be read, or has no results.
    """
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
                scored.append((score, number, box_of(entry, name, where=here)))
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
            index: _apart_m(one.box, box)
            for index, one in enumerate(present)
            if one.box.name == box.name and index not in found
        }
        nearest = min(free, key=free.__getitem__, default=None)
        if nearest is not None and free[nearest] < below_m:
            found[nearest] = box
    return [(one, found.get(index)) for index, one in enumerate(present)]


def _apart_m(first: Box, second: Box) -> float:
    """Distance of centres in the ground plane [m]."""
    return math.dist(first.centre_m[:2].tolist(), second.centre_m[:2].tolist())


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
    ahead = _turned(_conjugate(sample.pose.rotation), _turned(one.box.rotation, FORWARD))
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
    off = (_apart_m(one.box, found), reported[0] - right, reported[2] - forward)
    return ",".join((*cells, *(f"{value:.6g}" for value in off)))


FORWARD = np.array([1.0, 0.0, 0.0])


def _from_lidar(sample: Sample, place_m: FloatArray) -> tuple[float, float, float]:
    """A global place seen from the lidar: to the right, up and forward in the ego's axes [m]."""
    own = (
        _turned(_conjugate(sample.pose.rotation), place_m - sample.pose.ego_m) - sample.pose.lidar_m
    )
    forward, left, up = own.tolist()
    return -left, up, forward


def _conjugate(rotation: FloatArray) -> FloatArray:
    return rotation * np.array([1.0, -1.0, -1.0, -1.0])


def _turned(rotation: FloatArray, vector: FloatArray) -> FloatArray:
    """A vector ``[3]`` turned by a quaternion w, x, y, z of length 1."""
    twice = 2.0 * np.cross(rotation[1:], vector)
    return vector + rotation[0] * twice + np.cross(rotation[1:], twice)
