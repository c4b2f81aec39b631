"""From label and detection files to the table that models learn from, one frame at a time."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.atomic import is_folder
from pemviz.pem.data.collected import CollectedCounts, salient_cells, write_table
from pemviz.pem.data.detections import Detection, DetectionFormat, FrameDetections, open_detections
from pemviz.pem.data.kitti_labels import MISC, TYPES, UNKNOWN_OCCLUSION, Obstacle, read_labels
from pemviz.pem.data.matching import PAPER_IOU, assign_boxes
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN
from pemviz.pem.models.protocol import SALIENT_COLUMNS

TABLE_COLUMNS = ("frame", "type", *SALIENT_COLUMNS, OUTCOME_COLUMN, "iou")
NUMBERED_CLASSES = TYPES[:-1]
"""Names of the classes 0, 1, ... unless the user gives others: KITTI's, without DontCare."""


@dataclass(frozen=True)
class CollectOptions:
    """What counts as a detection, and what is left out."""

    iou_above: float = PAPER_IOU
    """A pair of boxes counts as a detection above this overlap."""
    class_aware: bool = False
    """Whether only a detection of the obstacle's own class counts."""
    score_from: float = -math.inf
    """Detections with a lower score are ignored; scores may be logits, as below 0."""
    drop_unknown: bool = False
    """Whether obstacles of class Misc or of unknown occlusion are left out."""
    skip_bad: bool = False
    """Whether malformed lines are counted and passed over."""


@dataclass
class CollectCounts(CollectedCounts):
    """What happened on the way."""

    frames: int = 0
    """Frames read."""
    obstacles: int = 0
    """Obstacles written."""


def collect(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    detection_format: DetectionFormat = "kitti",
    options: CollectOptions = CollectOptions(),
    class_names: tuple[str, ...] = NUMBERED_CLASSES,
    image_sizes: Path | None = None,
    missing_is_empty: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> CollectCounts:
    """Match every labelled obstacle with the detections and write one row for it.

    Where detections of ``kitti`` have a place, two more columns hold how far it is off, reported
    minus true, to the right and forward, as ``pemviz pem fit --position-errors`` reads them; empty
    if missed.

    Args:
        labels: folder of KITTI label files, one a frame.
        detections: folder or file of detections.
        out: CSV to write; complete or not there.
        detection_format: how the detections are written.
        options: what counts as a detection, and what is left out.
        class_names: names of numbered classes.
        image_sizes: CSV with frame, width_px, height_px, for YOLO.
        missing_is_empty: whether a frame without detections file means that none were made.
        on_progress: told (frames done, frames in all).

    Raises:
        PemError: naming file, line and column of what is malformed, or what is missing.
    """
    files = sorted(labels.glob("*.txt")) if is_folder(labels) else []
    if not files:
        raise PemError(f"{labels}: no folder with KITTI label files (*.txt)")
    counts = CollectCounts()
    on_bad_line = counts.on_bad_line(skip_bad=options.skip_bad)
    reader = open_detections(
        detections,
        detection_format=detection_format,
        class_names=class_names,
        image_sizes=image_sizes,
        missing_is_empty=missing_is_empty,
        on_bad_line=on_bad_line,
    )
    rows: list[_Row] = []
    for done, file in enumerate(files, start=1):
        obstacles = read_labels(file, on_bad_line=on_bad_line)
        rows += _rows(file.stem, obstacles, reader, options=options, counts=counts)
        if on_progress is not None:
            on_progress(done, len(files))
    placed = any(row.errors is not None for row in rows)
    header = (*TABLE_COLUMNS, *PLANE_COLUMNS) if placed else TABLE_COLUMNS
    write_table(
        out, header, (",".join((row.cells, *(row.errors or ("", "")) * placed)) for row in rows)
    )
    return counts


@dataclass(frozen=True)
class _Row:
    cells: str
    errors: tuple[str, str] | None


def place_errors(found: Detection | None, obstacle: Obstacle) -> tuple[str, str] | None:
    """Reported minus true place, to the right and forward [m]; ``None`` without a place."""
    if found is None or found.location_m is None:
        return None
    reported, true = found.location_m, obstacle.location_m
    return f"{reported[0] - true[0]:.6g}", f"{reported[2] - true[2]:.6g}"


def _rows(
    frame: str,
    obstacles: list[Obstacle],
    reader: FrameDetections,
    *,
    options: CollectOptions,
    counts: CollectCounts,
) -> Iterator[_Row]:
    counts.frames += 1
    for obstacle, overlap, partner in _outcomes(obstacles, reader(frame), options=options):
        if options.drop_unknown and is_unknown(obstacle):
            counts.dropped += 1
            continue
        detected = overlap > options.iou_above
        counts.obstacles += 1
        counts.missed += not detected
        cells = (frame, *salient_cells(obstacle))
        errors = place_errors(partner, obstacle) if detected else None
        yield _Row(",".join((*cells, str(int(detected)), f"{overlap:.4f}")), errors)


def _outcomes(
    obstacles: list[Obstacle], found: list[Detection], *, options: CollectOptions
) -> Iterator[tuple[Obstacle, float, Detection | None]]:
    """Each obstacle with its partner's overlap, and the partner if there is one."""
    kept = [detection for detection in found if detection.score >= options.score_from]
    overlaps, partners = assign_boxes(
        [obstacle.box_px for obstacle in obstacles],
        [detection.box_px for detection in kept],
        obstacle_types=[each.type for each in obstacles] if options.class_aware else None,
        detection_types=[each.type for each in kept] if options.class_aware else None,
    )
    chosen = [kept[partner] if partner >= 0 else None for partner in partners.tolist()]
    return zip(obstacles, overlaps.tolist(), chosen, strict=True)


def is_unknown(obstacle: Obstacle) -> bool:
    """Whether no model can be fitted to it: class Misc, or unknown occlusion."""
    return obstacle.type == MISC or obstacle.occlusion == UNKNOWN_OCCLUSION
