"""MOTChallenge's files: who was where in the image, and what a detector or tracker reported.

A line is ``frame, id, left, top, width, height, conf, ...`` (pixels; frame and id from 1). In
ground truth conf 0 marks what is to be ignored, and since MOT16 a class and the visible share
follow; in detections conf is the score, and the id -1 or a tracker's. As in the benchmark's folders
a sequence is ``SEQUENCE/gt/gt.txt`` or ``SEQUENCE/det/det.txt``, with its rate in
``SEQUENCE/seqinfo.ini``; or, as trackers' results are, ``SEQUENCE.txt``.
"""

from collections.abc import Iterator
from configparser import ConfigParser
from configparser import Error as IniError
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import open_text
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.kitti_labels import Box, OnBadLine, box, numbers
from pemviz.pem.data.tracking import LARGEST_NUMBER

COLUMNS = ("frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf")
CLASSED = (*COLUMNS, "class", "visibility")
WORLD = (*COLUMNS, "x", "y", "z")
CLASSES = (
    *("pedestrian", "person_on_vehicle", "car", "bicycle", "motorbike", "non_motorized_vehicle"),
    *("static_person", "distractor", "occluder", "occluder_on_ground", "occluder_full"),
    *("reflection", "crowd"),
)
"""The classes 1, 2, ...; files with ``x, y, z`` in their place tell of none: pedestrians."""
SEQUENCE_INFO = "seqinfo.ini"
FASTEST_HZ = 1e4


@dataclass(frozen=True)
class MotObstacle:
    """A labelled box of one frame.

    Attributes:
        frame: Counted from 1.
        track: Its identity in the sequence.
        box_px: In the image.
        type: One of ``CLASSES``.
        visibility: Share of it that is seen, 0 to 1; ``None`` where none is labelled.
        counts: Whether it is not marked to be ignored.
    """

    frame: int
    track: int
    box_px: Box
    type: str
    visibility: float | None
    counts: bool


def sequence_files(folder: Path, kind: Literal["gt", "det"]) -> dict[str, Path]:
    """The file of each sequence, by name.

    Args:
        folder: Of sequences' folders, or of a file a sequence.
        kind: Ground truth or detections.

    Raises:
        PemError: There is none.
    """
    found: dict[str, Path] = {}
    if is_folder(folder):
        found = {path.parents[1].name: path for path in folder.glob(f"*/{kind}/{kind}.txt")}
        found = found or {path.stem: path for path in folder.glob("*.txt")}
    if not found:
        raise PemError(f"{folder}: no MOTChallenge files (SEQUENCE/{kind}/{kind}.txt, or *.txt)")
    return dict(sorted(found.items()))


def sequence_rate_hz(file: Path) -> float | None:
    """Frames a second of a sequence by its file of ground truth; ``None`` if nothing tells.

    Raises:
        PemError: What should tell it is malformed.
    """
    info = file.parents[1] / SEQUENCE_INFO
    if file.name != "gt.txt" or not is_file(info):
        return None
    reader = ConfigParser(interpolation=None)
    try:
        with open_text(info) as stream:
            reader.read_file(stream)
        rate_hz = reader.getfloat("Sequence", "frameRate")
    except (IniError, ValueError):
        rate_hz = -1.0
    if not 0.0 < rate_hz <= FASTEST_HZ:
        raise PemError(f"{info}: needs frameRate, above 0 to {FASTEST_HZ:g}, in [Sequence]")
    return rate_hz


def read_ground_truth(path: Path, *, on_bad_line: OnBadLine) -> list[MotObstacle]:
    """The labelled boxes of a sequence.

    Args:
        path: A file of ground truth.
        on_bad_line: Called with what is wrong; the line is passed over if that returns.
    """
    found: list[MotObstacle] = []
    for where, cells in _lines(path):
        try:
            found.append(_obstacle(cells, where))
        except PemError as error:
            on_bad_line(error)
    return found


def read_detections(path: Path, *, on_bad_line: OnBadLine) -> dict[int, list[Detection]]:
    """What was reported in each frame of a sequence; a frame without a line has nothing.

    Args:
        path: A file of detections, or of tracks.
        on_bad_line: Called with what is wrong; the line is passed over if that returns.
    """
    found: dict[int, list[Detection]] = {}
    for where, cells in _lines(path):
        try:
            frame, _, values = _values(cells, where)
            found.setdefault(frame, []).append(Detection("", _box(values, where), values[4]))
        except PemError as error:
            on_bad_line(error)
    return found


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if line.strip():
                yield f"{path}:{number}", [cell.strip() for cell in line.split(",")]


def _values(cells: list[str], where: str) -> tuple[int, int, list[float]]:
    """Frame, identity, and the numbers from ``bb_left`` on."""
    if not len(COLUMNS) <= len(cells) <= len(WORLD):
        wanted = f"{len(COLUMNS)} to {len(WORLD)}"
        raise PemError(f"{where}: {len(cells)} columns where {wanted} are needed")
    names = WORLD if len(cells) == len(WORLD) else CLASSED
    values = numbers(cells, names, first=0, where=where)
    frame, identity = values[:2]
    if not (1 <= frame < LARGEST_NUMBER and frame == int(frame)):
        raise PemError(f"{where}: column 1 (frame) is {cells[0]!r}, not a whole number from 1 on")
    if not (abs(identity) < LARGEST_NUMBER and identity == int(identity)):
        raise PemError(f"{where}: column 2 (id) is {cells[1]!r}, not a whole number")
    return int(frame), int(identity), values[2:]


def _box(values: list[float], where: str) -> Box:
    left, top, width, height = values[:4]
    return box(left, top, left + width, top + height, column=3, where=where)


def _obstacle(cells: list[str], where: str) -> MotObstacle:
    frame, track, values = _values(cells, where)
    kind, visibility = CLASSES[0], None
    if len(COLUMNS) < len(cells) < len(WORLD):
        if not (1 <= values[5] <= len(CLASSES) and values[5] == int(values[5])):
            raise PemError(
                f"{where}: column 8 (class) is {cells[7]!r}, allowed: 1 to {len(CLASSES)}"
            )
        kind = CLASSES[int(values[5]) - 1]
        visibility = values[6] if len(values) > 6 else None
    if visibility is not None and not 0.0 <= visibility <= 1.0:
        raise PemError(f"{where}: column 9 (visibility) is {cells[8]!r}, allowed: 0 to 1")
    if track < 0:
        raise PemError(f"{where}: column 2 (id) is {cells[1]!r}, not a whole number from 0 on")
    return MotObstacle(frame, track, _box(values, where), kind, visibility, values[4] != 0.0)
