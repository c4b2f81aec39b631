"""From tracked labels and a detector's output to a table that keeps who is seen when."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.pem.data.collect import CollectOptions, is_unknown, place_errors
from pemviz.pem.data.collected import CLASS_ID, TrackCounts, salient_cells, write_table
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.matching import assign_boxes
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN
from pemviz.pem.data.tracking import (
    SequenceFormat,
    TrackedObstacle,
    read_sequence_detections,
    read_tracking_labels,
)
from pemviz.pem.models.protocol import SALIENT_COLUMNS

TRACK_COLUMNS = ("sequence", "frame", "track", "rate_hz")
DEFAULT_OPTIONS = CollectOptions()
TABLE_COLUMNS = (*TRACK_COLUMNS, "type", *SALIENT_COLUMNS, OUTCOME_COLUMN, "iou")


def collect_tracks(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    sequence_format: SequenceFormat = "mot",
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Callable[[int, int], None] | None = None,
) -> TrackCounts:
    """Match every labelled obstacle of every frame, and write a row for it.

    Rows come by sequence, track and frame. Where detections have a place (``ab3dmot``), two more
    columns hold how far it is off, to the right and forward; empty if missed. Obstacles of class
    Misc or of unknown occlusion are left out if the options say so; what is left of their track
    then has a gap.

    Args:
        labels: folder of KITTI tracking labels, a file a sequence.
        detections: folder of detections, a file of the same name a sequence.
        out: CSV to write; complete or not there.
        sequence_format: how the detections are written.
        rate_hz: frames a second of all sequences.
        types: classes that count as obstacles; all if empty.
        options: what counts as a detection, and what is left out.
        on_progress: told (sequences done, sequences in all).

    Raises:
        PemError: naming file, line and column of what is malformed, or what is missing.
    """
    files = sorted(labels.glob("*.txt")) if is_folder(labels) else []
    if not files:
        raise PemError(f"{labels}: no folder with KITTI tracking labels (*.txt)")
    if unknown := [name for name in types if name not in CLASS_ID]:
        raise PemError(f"types: {unknown[0]!r} is no class, allowed: {', '.join(CLASS_ID)}")
    counts = TrackCounts()
    on_bad_line = counts.on_bad_line(skip_bad=options.skip_bad)
    placed = sequence_format == "ab3dmot"
    lines: list[str] = []
    for done, file in enumerate(files, start=1):
        tracked = read_tracking_labels(file, on_bad_line=on_bad_line)
        found = _detections_of(
            detections / file.name, sequence_format=sequence_format, on_bad_line=on_bad_line
        )
        rows = _outcomes(tracked, found, types=types, options=options, counts=counts)
        rows.sort(key=_by_track)
        lines += [_line(file.stem, rate_hz, row, placed=placed) for row in rows]
        counts.add_sequence(
            [_by_track(row) for row in rows], missed=sum(not row.detected for row in rows)
        )
        if on_progress is not None:
            on_progress(done, len(files))
    write_table(out, (*TABLE_COLUMNS, *PLANE_COLUMNS) if placed else TABLE_COLUMNS, lines)
    return counts


@dataclass(frozen=True)
class _Row:
    tracked: TrackedObstacle
    detected: bool
    overlap: float
    found: Detection | None


def _by_track(row: _Row) -> tuple[int, int]:
    return row.tracked.track, row.tracked.frame


def _detections_of(
    path: Path, *, sequence_format: SequenceFormat, on_bad_line: Callable[[PemError], None]
) -> dict[int, list[Detection]]:
    if not is_file(path):
        raise PemError(f"{path}: no detections of this sequence")
    return read_sequence_detections(path, sequence_format=sequence_format, on_bad_line=on_bad_line)


def _outcomes(
    tracked: list[TrackedObstacle],
    found: dict[int, list[Detection]],
    *,
    types: tuple[str, ...],
    options: CollectOptions,
    counts: TrackCounts,
) -> list[_Row]:
    by_frame: dict[int, list[TrackedObstacle]] = {}
    for each in tracked:
        if types and each.obstacle.type not in types:
            counts.other_types += 1
        else:
            by_frame.setdefault(each.frame, []).append(each)
    rows: list[_Row] = []
    for frame, present in by_frame.items():
        seen = found.get(frame, [])
        kept = [each for each in seen if each.score >= options.score_from]
        counts.ignored_detections += len(seen) - len(kept)
        overlaps, partners = assign_boxes(
            [each.obstacle.box_px for each in present], [each.box_px for each in kept]
        )
        matches = zip(present, overlaps.tolist(), partners.tolist(), strict=True)
        for each, overlap, partner in matches:
            if options.drop_unknown and is_unknown(each.obstacle):
                counts.dropped += 1
                continue
            detected = overlap > options.iou_above
            rows.append(_Row(each, detected, overlap, kept[partner] if detected else None))
    return rows


def _line(sequence: str, rate_hz: float, row: _Row, *, placed: bool) -> str:
    obstacle = row.tracked.obstacle
    who = (sequence, str(row.tracked.frame), str(row.tracked.track), f"{rate_hz:g}")
    cells = (*who, *salient_cells(obstacle))
    errors = (place_errors(row.found, obstacle) or ("", "")) if placed else ()
    return ",".join((*cells, str(int(row.detected)), f"{row.overlap:.4f}", *errors))
