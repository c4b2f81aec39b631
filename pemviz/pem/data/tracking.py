"""Tracked ground truth and detections of whole sequences: a file a sequence, a frame a line.

Labels are KITTI's tracking labels (frame, track id, then the columns of a KITTI label; here
'truncated' is a level, 0 to 2). Detections are either ``mot`` (frame, left, top, right, bottom,
score; MOTChallenge's order without its identity) or ``ab3dmot`` (frame, class, the four sides,
score, then height, width, length, x, y, z, rotation_y, alpha).
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from pemviz.errors import PemError
from pemviz.files.text_files import open_text
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.kitti_labels import (
    LABEL_COLUMNS,
    NOT_AN_OBSTACLE,
    Obstacle,
    OnBadLine,
    box,
    cells_of_lines,
    numbers,
    obstacle_of,
)

SequenceFormat = Literal["mot", "ab3dmot"]
MOT_COLUMNS = ("frame", "left", "top", "right", "bottom", "score")
AB3DMOT_COLUMNS = (
    *("frame", "class", "left", "top", "right", "bottom", "score"),
    *("height", "width", "length", "x", "y", "z", "rotation_y", "alpha"),
)
TRACKING_NAMES = {"Person": "Person_sitting"}
"""What the tracking labels call a class of the object labels."""
MOST_TRUNCATED = 2.0
LARGEST_NUMBER = 10**9

Item = TypeVar("Item")


@dataclass(frozen=True)
class TrackedObstacle:
    """A labelled object of one frame, with the track that it belongs to."""

    frame: int
    """Zero-based."""
    track: int
    """Its number in the sequence."""
    obstacle: Obstacle
    """What was labelled; its truncation is the level's share of the highest."""


def read_tracking_labels(path: Path, *, on_bad_line: OnBadLine) -> list[TrackedObstacle]:
    """The tracked obstacles of one sequence, 'DontCare' regions left out.

    Args:
        path: a file of KITTI's tracking ``label_02`` folder.
        on_bad_line: called with what is wrong; the line is passed over if that returns.
    """
    tracked: list[TrackedObstacle] = []
    for number, cells in cells_of_lines(path):
        try:
            if len(cells) < 3 or cells[2] != NOT_AN_OBSTACLE:
                tracked.append(_tracked(cells, where=f"{path}:{number}"))
        except PemError as error:
            on_bad_line(error)
    return tracked


def _tracked(cells: list[str], *, where: str) -> TrackedObstacle:
    if len(cells) < len(LABEL_COLUMNS) + 2:
        raise PemError(f"{where}: {len(cells)} columns where {len(LABEL_COLUMNS) + 2} are needed")
    frame = _whole(cells[0], column=1, name="frame", where=where)
    track = _whole(cells[1], column=2, name="track", where=where)
    level = cells[3]
    if level not in ("0", "1", "2"):
        raise PemError(f"{where}: column 4 (truncated) is {level!r}, allowed: 0, 1, 2")
    kind = TRACKING_NAMES.get(cells[2], cells[2])
    label = [kind, str(float(level) / MOST_TRUNCATED), *cells[4:]]
    return TrackedObstacle(frame, track, obstacle_of(label, where=where, columns_before=2))


def read_sequence_detections(
    path: Path, *, sequence_format: SequenceFormat, on_bad_line: OnBadLine
) -> dict[int, list[Detection]]:
    """What was detected in each frame of a sequence; a frame without an entry has none.

    Args:
        path: a text file with commas.
        sequence_format: ``mot`` or ``ab3dmot``.
        on_bad_line: called with what is wrong; the line is passed over if that returns.
    """
    parse = _mot if sequence_format == "mot" else _ab3dmot
    by_frame: dict[int, list[Detection]] = {}
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if not line.strip():
                continue
            cells = [cell.strip() for cell in line.split(",")]
            read = _or_told(lambda cells=cells, number=number: parse(cells, f"{path}:{number}"),
                            on_bad_line)  # fmt: skip
            if read is not None:
                by_frame.setdefault(read[0], []).append(read[1])
    return by_frame


def _or_told(read: Callable[[], Item], on_bad_line: OnBadLine) -> Item | None:
    try:
        return read()
    except PemError as error:
        on_bad_line(error)
        return None


def _mot(cells: list[str], where: str) -> tuple[int, Detection]:
    return _detection(cells, where, columns=MOT_COLUMNS, first_side=1, kind="")


def _ab3dmot(cells: list[str], where: str) -> tuple[int, Detection]:
    return _detection(cells, where, columns=AB3DMOT_COLUMNS, first_side=2, kind=cells[1:2])


def _detection(
    cells: list[str],
    where: str,
    *,
    columns: tuple[str, ...],
    first_side: int,
    kind: str | list[str],
) -> tuple[int, Detection]:
    if len(cells) != len(columns):
        raise PemError(f"{where}: {len(cells)} columns where {len(columns)} are needed")
    frame = _whole(cells[0], column=1, name="frame", where=where)
    values = numbers(cells, columns, first=first_side, where=where)
    sides = box(values[0], values[1], values[2], values[3], column=first_side + 1, where=where)
    place = None
    if columns is AB3DMOT_COLUMNS:
        x, y, z = (values[columns.index(name) - first_side] for name in ("x", "y", "z"))
        place = (x, y, z)
    return frame, Detection("".join(kind), sides, values[4], place)


def _whole(cell: str, *, column: int, name: str, where: str) -> int:
    if not (cell.isascii() and cell.isdigit() and int(cell) < LARGEST_NUMBER):
        raise PemError(f"{where}: column {column} ({name}) is {cell!r}, not a whole number")
    return int(cell)
