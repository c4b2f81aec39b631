"""KITTI's label and tracking label files: the obstacles that were there to be detected.

A tracking label is a line of frame and track id, then the columns of a label, of which 'truncated'
is a level, 0 to 2.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pemviz.errors import PemError
from pemviz.files.text_files import check_columns, open_text
from pemviz.matching import Box

LABEL_COLUMNS = (
    *("type", "truncated", "occluded", "alpha"),
    *("bbox_left", "bbox_top", "bbox_right", "bbox_bottom"),
    *("height", "width", "length", "x", "y", "z", "rotation_y"),
)
SCORED_COLUMNS = (*LABEL_COLUMNS, "score")
TYPES = (
    *("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram"),
    *("Misc", "DontCare"),
)
NOT_AN_OBSTACLE = "DontCare"
MISC = "Misc"
UNKNOWN_OCCLUSION = 3
TRACKING_NAMES = {"Person": "Person_sitting"}
"""What the tracking labels call a class of the object labels."""
MOST_TRUNCATED = 2.0
FARTHEST_PX = 1e6
"""No side of a box lies farther from the image's corner than this [px]."""
LARGEST_NUMBER = 10**9

OnBadLine = Callable[[PemError], None]
"""What to do about a malformed line: raise, or count and pass over it."""

Item = TypeVar("Item")


@dataclass(frozen=True)
class Obstacle:
    """One labelled object."""

    type: str
    truncation: float
    """Share of it that lies outside the image, 0 to 1."""
    occlusion: int
    """0 none, 1 partly, 2 largely, 3 unknown."""
    alpha_rad: float
    box_px: Box
    dimensions_m: tuple[float, float, float]
    """Height, width, length [m]."""
    location_m: tuple[float, float, float]
    """Centre of the bottom face in the camera frame: x right, y down, z forward [m]."""
    rotation_y_rad: float


@dataclass(frozen=True)
class TrackedObstacle:
    """A labelled object of one frame, counted from 0, with the number of its track."""

    frame: int
    track: int
    obstacle: Obstacle
    """What was labelled; its truncation is the level's share of the highest."""


def read_labels(path: Path, *, on_bad_line: OnBadLine) -> list[Obstacle]:
    """Obstacles of one frame, from a file of ``label_2``, 'DontCare' regions left out."""

    def parse(cells: list[str], where: str) -> Obstacle | None:
        if cells[0] == NOT_AN_OBSTACLE:
            return None
        check_columns(cells, SCORED_COLUMNS, where=where, optional=1)
        return _obstacle(cells, where=where)

    return list(parsed_lines(path, parse, on_bad_line=on_bad_line))


def read_tracking_labels(path: Path, *, on_bad_line: OnBadLine) -> list[TrackedObstacle]:
    """The tracked obstacles of one sequence, from a file of ``label_02``, 'DontCare' left out."""
    return list(parsed_lines(path, _tracked, on_bad_line=on_bad_line))


def _tracked(cells: list[str], where: str) -> TrackedObstacle | None:
    if cells[2:3] == [NOT_AN_OBSTACLE]:
        return None
    check_columns(cells, ("frame", "track", *SCORED_COLUMNS), where=where, optional=1)
    frame = whole_number(cells[0], column=1, name="frame", where=where)
    track = whole_number(cells[1], column=2, name="track", where=where)
    level = cells[3]
    if level not in ("0", "1", "2"):
        raise PemError(f"{where}: column 4 (truncated) is {level!r}, allowed: 0, 1, 2")
    kind = TRACKING_NAMES.get(cells[2], cells[2])
    label = [kind, str(float(level) / MOST_TRUNCATED), *cells[4:]]
    return TrackedObstacle(frame, track, _obstacle(label, where=where, columns_before=2))


def _obstacle(cells: list[str], *, where: str, columns_before: int = 0) -> Obstacle:
    shift = columns_before
    if cells[0] not in TYPES:
        raise PemError(
            f"{where}: column {1 + shift} (type) is {cells[0]!r}, allowed: {', '.join(TYPES)}"
        )
    values = numbers(cells, SCORED_COLUMNS, first=1, where=where, columns_before=shift)
    truncation, occlusion, alpha, left, top, right, bottom, *rest = values
    if not 0.0 <= truncation <= 1.0:
        raise PemError(f"{where}: column {2 + shift} (truncated) is {cells[1]}, allowed: 0 to 1")
    if occlusion not in (0.0, 1.0, 2.0, 3.0):
        raise PemError(f"{where}: column {3 + shift} (occluded) is {cells[2]}, allowed: 0, 1, 2, 3")
    return Obstacle(
        type=cells[0],
        truncation=truncation,
        occlusion=int(occlusion),
        alpha_rad=alpha,
        box_px=box(left, top, right, bottom, column=5 + shift, where=where),
        dimensions_m=(rest[0], rest[1], rest[2]),
        location_m=(rest[3], rest[4], rest[5]),
        rotation_y_rad=rest[6],
    )


def parsed_lines(
    path: Path,
    parse: Callable[[list[str], str], Item | None],
    *,
    on_bad_line: OnBadLine,
    separator: str | None = None,
) -> Iterator[Item]:
    """What ``parse`` makes of the cells of each line that is not blank, if it makes something.

    It gets file and line too, for the message of the :class:`PemError` that it raises.

    Args:
        path: The file.
        parse: Reads a line.
        on_bad_line: Called with what is wrong; the line is passed over if that returns.
        separator: Between cells; white space if ``None``.
    """
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            if not line.strip():
                continue
            cells = [cell.strip() for cell in line.split(separator)]
            try:
                item = parse(cells, f"{path}:{number}")
            except PemError as error:
                on_bad_line(error)
                continue
            if item is not None:
                yield item


def numbers(
    cells: list[str], names: tuple[str, ...], *, first: int, where: str, columns_before: int = 0
) -> list[float]:
    """The cells from index ``first`` on as finite numbers.

    Args:
        cells: all cells of a line.
        names: names of all columns, for the message.
        first: index of the first numeric column.
        where: file and line.
        columns_before: how many columns of the line stand before the cells.

    Raises:
        PemError: naming the column that is not a finite number.
    """
    values: list[float] = []
    for index in range(first, len(cells)):
        try:
            value = float(cells[index])
        except ValueError:
            value = float("nan")
        if not abs(value) < float("inf"):
            raise PemError(
                f"{where}: column {index + 1 + columns_before} ({names[index]}) is "
                f"{cells[index]!r}, not a number"
            )
        values.append(value)
    return values


def whole_number(cell: str, *, column: int, name: str, where: str) -> int:
    """A cell as a whole number from 0 on.

    Raises:
        PemError: It is none.
    """
    if not (cell.isascii() and cell.isdigit() and int(cell) < LARGEST_NUMBER):
        raise PemError(f"{where}: column {column} ({name}) is {cell!r}, not a whole number")
    return int(cell)


def box(left: float, top: float, right: float, bottom: float, *, column: int, where: str) -> Box:
    """A box whose sides are in order.

    Raises:
        PemError: right is left of left, or bottom above top, or a side is far from any image.
    """
    if not all(abs(side) <= FARTHEST_PX for side in (left, top, right, bottom)):
        raise PemError(
            f"{where}: column {column} begins a box beyond any image, "
            f"allowed: sides from {-FARTHEST_PX:g} to {FARTHEST_PX:g} px"
        )
    if right < left or bottom < top:
        raise PemError(f"{where}: column {column} begins a box with a negative side")
    return left, top, right, bottom
