"""What a detector found: all to boxes in pixels.

One frame at a time: KITTI result files, YOLO text files, COCO json. Whole sequences, a file a
sequence with commas, are either ``mot`` (frame, left, top, right, bottom, score; MOTChallenge's
order without its identity) or ``ab3dmot`` (frame, class, the four sides, score, then height, width,
length, x, y, z, rotation_y, alpha).
"""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.json_text import read_json
from pemviz.files.text_files import check_columns, open_text
from pemviz.pem.data.kitti_labels import (
    FARTHEST_PX,
    NOT_AN_OBSTACLE,
    SCORED_COLUMNS,
    Box,
    OnBadLine,
    box,
    numbers,
    parsed_lines,
    whole_number,
)

SequenceFormat = Literal["mot", "ab3dmot"]
DetectionFormat = Literal["kitti", "yolo", "coco"]
_WHOLE_NUMBER = re.compile("[0-9]{1,9}")
UNKNOWN_M = -1000.0
"""What KITTI's results have for a place that the detector does not tell; its sides are then -1."""
YOLO_COLUMNS = ("class", "centre_x", "centre_y", "width", "height", "score")
MOT_COLUMNS = ("frame", "left", "top", "right", "bottom", "score")
AB3DMOT_COLUMNS = (
    *("frame", "class", "left", "top", "right", "bottom", "score"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "alpha"),
)


@dataclass(frozen=True)
class Detection:
    """One box of a detector."""

    type: str
    """Its class by name; the class's number as text if its name is not known."""
    box_px: Box
    score: float
    """The detector's confidence, 0 to 1; 1 where the file gives none."""
    location_m: tuple[float, float, float] | None = None
    """Place of a 3D box as KITTI labels one, x right, y down, z forward [m]; None without one."""


FrameDetections = Callable[[str], list[Detection]]
"""Detections of a frame by its name, such as 000007."""


def open_detections(
    path: Path,
    *,
    detection_format: DetectionFormat,
    class_names: Sequence[str],
    image_sizes: Path | None,
    missing_is_empty: bool,
    on_bad_line: OnBadLine,
) -> FrameDetections:
    """A reader of detections, one frame at a time.

    The path is that of a folder of text files for ``kitti`` and ``yolo``, of a json file for
    ``coco``. ``class_names`` are those of the classes 0, 1, ... where the format has numbers,
    ``image_sizes`` is a CSV with frame, width_px, height_px, which ``yolo`` needs. A frame without
    a file (or, in ``coco``, without an entry) has no detections if ``missing_is_empty``.

    Raises:
        PemError: the path, the sizes or the json cannot be used.
    """
    if detection_format == "coco":
        return _open_coco(
            path, class_names=class_names, missing_is_empty=missing_is_empty, on_bad=on_bad_line
        )
    if not is_folder(path):
        raise PemError(f"{path}: no folder of detections")
    sizes = _read_sizes(image_sizes) if detection_format == "yolo" else {}

    def of_frame(frame: str) -> list[Detection]:
        file = path / f"{frame}.txt"
        if not is_file(file):
            if missing_is_empty:
                return []
            raise PemError(f"{file}: no detections of this frame (allow that if none were made)")
        if detection_format == "yolo" and frame not in sizes:
            raise PemError(f"{image_sizes}: no size of frame {frame}")

        def parse(cells: list[str], where: str) -> Detection | None:
            if cells[0] == NOT_AN_OBSTACLE:
                return None
            if detection_format == "kitti":
                return _kitti_detection(cells, where)
            return _yolo_detection(cells, where, size_px=sizes[frame], class_names=class_names)

        return list(parsed_lines(file, parse, on_bad_line=on_bad_line))

    return of_frame


def _kitti_detection(cells: list[str], where: str) -> Detection:
    check_columns(cells, SCORED_COLUMNS, where=where, optional=1)
    values = numbers(cells, SCORED_COLUMNS, first=1, where=where)
    left, top, right, bottom = values[3:7]
    score = values[14] if len(cells) == len(SCORED_COLUMNS) else 1.0
    sides, place = values[7:10], (values[10], values[11], values[12])
    has_place = min(sides) > 0.0 and UNKNOWN_M not in place
    sides_px = box(left, top, right, bottom, column=5, where=where)
    return Detection(cells[0], sides_px, score, place if has_place else None)


def _yolo_detection(
    cells: list[str], where: str, *, size_px: tuple[float, float], class_names: Sequence[str]
) -> Detection:
    check_columns(cells, YOLO_COLUMNS, where=where, optional=1)
    values = numbers(cells, YOLO_COLUMNS, first=0, where=where)
    number, centre_x, centre_y, width, height = values[:5]
    for index, value in enumerate(values[1:5], start=1):
        if not -0.5 <= value <= 1.5:
            raise PemError(
                f"{where}: column {index + 1} ({YOLO_COLUMNS[index]}) is {cells[index]}, "
                "not a share of the image"
            )
    if number < 0 or number != int(number):
        raise PemError(f"{where}: column 1 (class) is {cells[0]}, not a class number")
    width_px, height_px = size_px
    sides = box(
        (centre_x - width / 2) * width_px,
        (centre_y - height / 2) * height_px,
        (centre_x + width / 2) * width_px,
        (centre_y + height / 2) * height_px,
        column=4,
        where=where,
    )
    score = values[5] if len(values) > 5 else 1.0
    return Detection(_class_name(int(number), class_names), sides, score)


def _class_name(number: int, class_names: Sequence[str]) -> str:
    return class_names[number] if number < len(class_names) else str(number)


def _read_sizes(path: Path | None) -> dict[str, tuple[float, float]]:
    if path is None:
        raise PemError("YOLO detections are shares of the image: give the image sizes as CSV")
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    sizes: dict[str, tuple[float, float]] = {}
    with open_text(path) as stream:
        reader = csv.DictReader(stream)
        try:
            if not {"frame", "width_px", "height_px"} <= set(reader.fieldnames or ()):
                raise PemError(f"{path}:1: the header must hold frame, width_px, height_px")
            for row in reader:
                where = f"{path}:{reader.line_num}"
                try:
                    size = float(row["width_px"]), float(row["height_px"])
                except (TypeError, ValueError):
                    raise PemError(f"{where}: a size is not a number") from None
                if not all(0.0 < side <= FARTHEST_PX for side in size):
                    allowed = f"above 0 and at most {FARTHEST_PX:g} px"
                    raise PemError(f"{where}: a size must be {allowed}")
                sizes[row["frame"]] = size
        except csv.Error as error:
            raise PemError(f"{path}:{reader.line_num}: not CSV ({error})") from None
    return sizes


def _open_coco(
    path: Path, *, class_names: Sequence[str], missing_is_empty: bool, on_bad: OnBadLine
) -> FrameDetections:
    content = read_json(path)
    entries: Any = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(entries, list):
        raise PemError(f"{path}: need a list of results, or an object with 'annotations'")
    whole: Mapping[str, Any] = content if isinstance(content, dict) else {}
    frames = _coco_names(whole, "images", "file_name", where=str(path))
    types = _coco_names(whole, "categories", "name", where=str(path))
    by_frame: dict[str, list[Detection]] = {frame: [] for frame in frames.values()}
    for index, entry in enumerate(entries):
        try:
            image, category, found = coco_entry(entry, where=f"{path}: entry {index}")
        except PemError as error:
            on_bad(error)
            continue
        frame = frames.get(image, image.zfill(6))
        name = types.get(category) or _class_name(int(category), class_names)
        by_frame.setdefault(frame, []).append(Detection(name, found.box_px, found.score))

    def of_frame(frame: str) -> list[Detection]:
        if frame not in by_frame and not missing_is_empty:
            raise PemError(f"{path}: no detections of frame {frame} (allow that if none were made)")
        return by_frame.get(frame, [])

    return of_frame


def _coco_names(
    content: Mapping[str, Any], section: str, key: str, *, where: str
) -> dict[str, str]:
    """Names of images (without folder and ending) or categories, by id as text."""
    try:
        return {
            str(item["id"]): Path(str(item[key])).stem if key == "file_name" else str(item[key])
            for item in content.get(section, [])
        }
    except (KeyError, TypeError):
        raise PemError(f"{where}: an entry of {section!r} lacks 'id' or {key!r}") from None


def coco_entry(entry: Any, *, where: str) -> tuple[str, str, Detection]:
    """Image id, category id and detection (its type left empty) of one entry.

    Raises:
        PemError: It is malformed; begins with ``where``.
    """
    if not isinstance(entry, dict):
        raise PemError(f"{where}: not an object")
    for key in ("image_id", "category_id", "bbox"):
        if key not in entry:
            raise PemError(f"{where}: field {key!r} is missing")
    sides: Any = entry["bbox"]
    if not isinstance(sides, list) or len(sides) != 4:
        raise PemError(f"{where}: field 'bbox' must hold x, y, width, height")
    names = ("bbox x", "bbox y", "bbox width", "bbox height", "score")
    texts = [str(value) for value in (*sides, entry.get("score", 1.0))]
    x, y, width, height, score = numbers(texts, names, first=0, where=where)
    if not _WHOLE_NUMBER.fullmatch(str(entry["category_id"])):
        raise PemError(f"{where}: field 'category_id' must be a whole number of at most 9 digits")
    sides_px = box(x, y, x + width, y + height, column=3, where=where)
    return str(entry["image_id"]), str(entry["category_id"]), Detection("", sides_px, score)


def read_sequence_detections(
    path: Path, *, sequence_format: SequenceFormat, on_bad_line: OnBadLine
) -> dict[int, list[Detection]]:
    """What was detected in each frame of a sequence; a frame without an entry has none.

    Raises:
        PemError: What ``on_bad_line`` raises of a malformed line.
    """
    has_class = sequence_format == "ab3dmot"
    columns = AB3DMOT_COLUMNS if has_class else MOT_COLUMNS
    first_side = columns.index("left")

    def parse(cells: list[str], where: str) -> tuple[int, Detection]:
        check_columns(cells, columns, where=where)
        frame = whole_number(cells[0], column=1, name="frame", where=where)
        values = numbers(cells, columns, first=first_side, where=where)
        sides = box(values[0], values[1], values[2], values[3], column=first_side + 1, where=where)
        place = (values[8], values[9], values[10]) if has_class else None
        return frame, Detection(cells[1] if has_class else "", sides, values[4], place)

    by_frame: dict[int, list[Detection]] = {}
    for frame, found in parsed_lines(path, parse, on_bad_line=on_bad_line, separator=","):
        by_frame.setdefault(frame, []).append(found)
    return by_frame
