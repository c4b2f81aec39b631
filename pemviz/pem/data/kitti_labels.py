"""KITTI label files: the obstacles that were there to be detected."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.text_files import open_text

LABEL_COLUMNS = (
    "type",
    "truncated",
    "occluded",
    "alpha",
    "bbox_left",
    "bbox_top",
    "bbox_right",
    "bbox_bottom",
    "height",
    "width",
    "length",
    "x",
    "y",
    "z",
    "rotation_y",
)
TYPES = (
    "Car",
    "Van",
    "Truck",
    "Pedestrian",
    "Person_sitting",
    "Cyclist",
    "Tram",
    "Misc",
    "DontCare",
)
NOT_AN_OBSTACLE = "DontCare"
MISC = "Misc"
UNKNOWN_OCCLUSION = 3

Box = tuple[float, float, float, float]
"""Left, top, right, bottom [px]."""

FARTHEST_PX = 1e6
"""No side of a box lies farther from the image's corner than this [px]."""

OnBadLine = Callable[[PemError], None]
"""What to do about a malformed line: raise, or count."""


@dataclass(frozen=True)
class Obstacle:
    """One labelled object."""

    type: str
    """One of TYPES."""
    truncation: float
    """Share of it that lies outside the image, 0 to 1."""
    occlusion: int
    """0 none, 1 partly, 2 largely, 3 unknown."""
    alpha_rad: float
    """Observation angle [rad]."""
    box_px: Box
    """Box in the image."""
    dimensions_m: tuple[float, float, float]
    """Height, width, length [m]."""
    location_m: tuple[float, float, float]
    """Centre of the bottom face in the camera frame: x right, y down, z forward [m]."""
    rotation_y_rad: float
    """Rotation about the camera's y axis [rad]."""


def read_labels(path: Path, *, on_bad_line: OnBadLine) -> list[Obstacle]:
    """Obstacles of one frame, 'DontCare' regions left out.

    Args:
        path: a file of KITTI's ``label_2`` folder.
        on_bad_line: called with what is wrong; the line is passed over if that returns.
    """
    obstacles: list[Obstacle] = []
    for number, cells in cells_of_lines(path):
        try:
            if cells[0] != NOT_AN_OBSTACLE:
                obstacles.append(obstacle_of(cells, where=f"{path}:{number}"))
        except PemError as error:
            on_bad_line(error)
    return obstacles


def cells_of_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and white-space separated cells of each line that is not blank."""
    with open_text(path) as stream:
        for number, line in enumerate(stream, start=1):
            cells = line.split()
            if cells:
                yield number, cells


def numbers(
    cells: list[str],
    names: tuple[str, ...],
    *,
    first: int,
    where: str,
    columns_before: int = 0,
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


def obstacle_of(cells: list[str], *, where: str, columns_before: int = 0) -> Obstacle:
    """The obstacle of a label's cells.

    Args:
        cells: a label's columns, and perhaps a score.
        where: file and line.
        columns_before: how many columns of the line stand before them, for messages.

    Raises:
        PemError: naming the column that is not as KITTI writes it.
    """
    if len(cells) not in (len(LABEL_COLUMNS), len(LABEL_COLUMNS) + 1):
        needed = len(LABEL_COLUMNS) + columns_before
        raise PemError(f"{where}: {len(cells) + columns_before} columns where {needed} are needed")
    shift = columns_before
    if cells[0] not in TYPES:
        raise PemError(
            f"{where}: column {1 + shift} (type) is {cells[0]!r}, allowed: {', '.join(TYPES)}"
        )
    names = (*LABEL_COLUMNS, "score")
    values = numbers(cells, names, first=1, where=where, columns_before=shift)
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
