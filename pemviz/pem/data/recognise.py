"""Which of the formats that are read a detector's files are in, by what stands in them.

A kind of labels and a kind of detections make a format of :mod:`pemviz.cli.pem.collect`. The first
lines that hold something decide; whether every line is as the format wants it the reader of the
format says.
"""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.shipped import asset_path
from pemviz.files.text_files import open_text
from pemviz.pem.data.argoverse import ANNOTATIONS
from pemviz.pem.data.detections import AB3DMOT_COLUMNS, MOT_COLUMNS, DetectionFormat, SequenceFormat
from pemviz.pem.data.fiftyone import SAMPLES
from pemviz.pem.data.kitti_labels import LABEL_COLUMNS
from pemviz.pem.data.mot_challenge import COLUMNS, WORLD
from pemviz.pem.data.ros_bags import holds_bags
from pemviz.pem.data.table import INPUTS_FILE, LABELS_FILE
from pemviz.pem.models.protocol import SALIENT_COLUMNS

CollectedFormat = Literal[
    DetectionFormat, SequenceFormat, "nuscenes", "motchallenge", "log", "argoverse", "rosbag",
    "fiftyone",
]  # fmt: skip
"""How a detector's files are written."""
FileFormat = Literal[CollectedFormat, "table"]
"""Or they are a table of obstacles and outcomes already."""

KITTI, TRACKING = "KITTI labels", "KITTI tracking labels"
NUSCENES, MOT_CHALLENGE = "nuScenes' tables", "MOTChallenge's ground truth"
ROWS = "rows of a log"
KITTI_RESULTS, YOLO, COCO = "KITTI results", "YOLO text", "COCO json"
MOT, AB3DMOT = "boxes by frame (mot)", "3D boxes by frame (ab3dmot)"
ARGOVERSE, ARGOVERSE_FOUND = "Argoverse 2's annotations", "a feather file of detections"
BAGS, FIFTYONE = "rosbags", "a data set of FiftyOne's"
NUSCENES_RESULTS, MOT_RESULTS = "nuScenes' detection results", "MOTChallenge's detections"
PAIRS: Mapping[tuple[str, str], FileFormat] = MappingProxyType(
    {
        (KITTI, KITTI_RESULTS): "kitti",
        (KITTI, YOLO): "yolo",
        (KITTI, COCO): "coco",
        (COCO, COCO): "coco",
        (TRACKING, MOT): "mot",
        (TRACKING, AB3DMOT): "ab3dmot",
        (NUSCENES, NUSCENES_RESULTS): "nuscenes",
        (MOT_CHALLENGE, MOT_RESULTS): "motchallenge",
        (ROWS, ROWS): "log",
        (ARGOVERSE, ARGOVERSE_FOUND): "argoverse",
        (BAGS, BAGS): "rosbag",
        (FIFTYONE, FIFTYONE): "fiftyone",
    }
)
"""The format of labels and detections that belong together."""
NUSCENES_TABLES = ("scene.json", "sample.json", "sample_annotation.json")
FIRST_CHARACTERS = 65_536
"""Of a json file, within which its keys tell what it is; results begin behind a few settings."""
MOST_FILES = 200
"""Of a folder, among which one holds a line."""
WORD = re.compile("[A-Za-z]")


@dataclass(frozen=True)
class Recognised:
    """A detector's files and how they are written.

    Attributes:
        words: What labels and detections are, for people.
        mapping: A shipped mapping that reads a log; else ``None``.
    """

    file_format: FileFormat
    labels: Path
    detections: Path
    words: str
    mapping: Path | None = None


def recognise(labels: Path, detections: Path) -> Recognised:
    """What a detector's files are, each a file or a folder.

    Raises:
        PemError: A path is not there or empty, holds nothing that is known, or they do not belong
            together; one line says which, and what is allowed.
    """
    if _is_published(labels):
        inputs, outcomes = labels / INPUTS_FILE, detections / LABELS_FILE
        if not is_file(outcomes):
            raise PemError(f"detections = {detections}: must be a folder with {LABELS_FILE}, too")
        if len(_first_cells(inputs)) == len(SALIENT_COLUMNS) and labels == detections:
            words = "published obstacles and outcomes"
            return Recognised("table", labels, detections, words)
        labels, detections = inputs, outcomes
    labelled = _kind_of(labels, "labels")
    reported = _kind_of(detections, "detections")
    words = ", ".join(dict.fromkeys((labelled, reported)))
    known = PAIRS.get((labelled, reported))
    if known is None:
        allowed = " or ".join(other for one, other in PAIRS if one == labelled)
        raise PemError(
            f"detections = {detections}: {reported}; beside {labelled} must be {allowed}"
        )
    if known == "kitti" and labels.resolve() == detections.resolve():
        raise PemError(f"detections = {detections}: are the labels themselves")
    mapping = _shipped_mapping(labels, detections) if known == "log" else None
    return Recognised(known, labels, detections, words, mapping)


def _is_published(folder: Path) -> bool:
    return is_folder(folder) and is_file(folder / INPUTS_FILE)


def _kind_of(path: Path, role: Literal["labels", "detections"]) -> str:
    """What a file or folder is.

    Raises:
        PemError: It is not there, empty, or nothing that is known in its role.
    """
    if is_folder(path):
        kind = _folder_kind(path, role)
    elif is_file(path):
        kind = _file_kind(path, role)
    else:
        raise PemError(f"{role} = {path}: there is no such file or folder")
    allowed = dict.fromkeys(pair[role == "detections"] for pair in PAIRS)
    if kind in allowed:
        return kind
    of_other = kind in {pair[role == "labels"] for pair in PAIRS}
    what = f"{kind}; they are no {role}" if of_other else f"no {role} that are known"
    raise PemError(f"{role} = {path}: {what}{_inner_folders(path, role)}; allowed: "
                   f"{', '.join(allowed)}")  # fmt: skip


def _folder_kind(path: Path, role: Literal["labels", "detections"]) -> str:
    """What a folder is; empty if nothing is known of it.

    Raises:
        PemError: There is nothing in it.
    """
    if not any(path.iterdir()):
        raise PemError(f"{role} = {path}: the folder is empty")
    if all(is_file(path / name) for name in NUSCENES_TABLES):
        return NUSCENES
    if holds_bags(path):
        return BAGS
    if is_file(path / SAMPLES):
        return FIFTYONE
    if any(is_file(one / ANNOTATIONS) for one in (path, *path.iterdir())):
        return ARGOVERSE
    inner = "gt/gt.txt" if role == "labels" else "det/det.txt"
    if any(path.glob(f"*/{inner}")):
        return MOT_CHALLENGE if role == "labels" else MOT_RESULTS
    files = list(islice(sorted(path.glob("*.txt")), MOST_FILES))
    rows = (_first_cells(file) for file in files)
    cells = next((row for row in rows if row), ())
    if files and not cells:
        raise PemError(f"{role} = {path}: its files hold no line")
    return _line_kind(cells, role)


def _file_kind(path: Path, role: Literal["labels", "detections"]) -> str:
    if holds_bags(path):
        return BAGS
    if path.suffix == ".feather":
        return ARGOVERSE if role == "labels" else ARGOVERSE_FOUND
    if path.suffix == ".json":
        with open_text(path) as stream:
            start = stream.read(FIRST_CHARACTERS).lstrip()
        if not start:
            raise PemError(f"{role} = {path}: the file is empty")
        if start[0] == "{" and '"samples"' in start:
            return FIFTYONE
        if start[0] == "{" and '"results"' in start:
            return NUSCENES_RESULTS
        is_coco = start[0] == "[" or '"annotations"' in start or '"images"' in start
        return COCO if is_coco and start[0] in "[{" else ""
    if not _first_cells(path):
        raise PemError(f"{role} = {path}: the file holds no line")
    return ROWS if path.suffix in (".csv", ".txt", ".tsv") else ""


def _line_kind(cells: Sequence[str], role: Literal["labels", "detections"]) -> str:
    """What a line of a text file is of; empty if nothing is known of it."""
    count, kind = len(cells), ""
    words = [WORD.match(cell) is not None for cell in cells]
    if count > len(LABEL_COLUMNS) + 1 and words[2] and not any(words[:2]):
        kind = TRACKING
    elif count in (len(LABEL_COLUMNS), len(LABEL_COLUMNS) + 1) and words[0]:
        kind = KITTI if role == "labels" and count == len(LABEL_COLUMNS) else KITTI_RESULTS
    elif any(words):
        kind = ""
    elif not isinstance(cells, _Commas):
        kind = YOLO if count in (5, 6) else ""
    elif count in (len(MOT_COLUMNS), len(AB3DMOT_COLUMNS)):
        kind = MOT if count == len(MOT_COLUMNS) else AB3DMOT
    elif len(COLUMNS) <= count <= len(WORLD):
        kind = MOT_CHALLENGE if role == "labels" else MOT_RESULTS
    return kind


class _Commas(tuple[str, ...]):
    """Cells that stood between commas."""

    __slots__ = ()


def _first_cells(path: Path) -> tuple[str, ...]:
    """The cells of a file's first line that holds something; of none, nothing."""
    with open_text(path) as stream:
        lines = (line.strip() for line in stream)
        line = next((one for one in lines if one and not one.startswith("#")), "")
    return _Commas(line.split(",")) if "," in line else tuple(line.split())


def _inner_folders(path: Path, role: Literal["labels", "detections"]) -> str:
    """Which folders in a folder could have been meant."""
    if not is_folder(path):
        return ""
    meant = [inner.name for inner in sorted(path.iterdir()) if _fits(inner, role)]
    return f"; in it is {', '.join(meant)}" if meant else ""


def _fits(path: Path, role: Literal["labels", "detections"]) -> bool:
    if not is_folder(path):
        return False
    try:
        return _folder_kind(path, role) in {pair[role == "detections"] for pair in PAIRS}
    except PemError:
        return False


def _shipped_mapping(labels: Path, detections: Path) -> Path | None:
    """The shipped mapping with as many columns as the two files of a log have."""
    counts = len(_first_cells(labels)), len(_first_cells(detections))
    for path in sorted(asset_path("mappings").glob("*.toml")):
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        headers = (table.get(part, {}).get("header", ()) for part in ("labels", "detections"))
        if tuple(len(header) for header in headers) == counts:
            return path
    return None
