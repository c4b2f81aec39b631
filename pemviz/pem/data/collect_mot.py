"""MOTChallenge's ground truth and detections to a table of who is missed when.

These files tell nothing of places in the world: the table has no salient variables. It serves
``pemviz pem memory --model guess-mu``, how misses follow each other; no error model can be fitted.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pemviz.errors import PemError
from pemviz.pem.data.collect import CollectOptions
from pemviz.pem.data.collect_tracks import DEFAULT_OPTIONS, TRACK_COLUMNS
from pemviz.pem.data.collected import TrackCounts, write_table
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.matching import assign_boxes
from pemviz.pem.data.mot_challenge import (
    CLASSES,
    MotObstacle,
    read_detections,
    read_ground_truth,
    sequence_files,
    sequence_rate_hz,
)
from pemviz.pem.data.nuscenes_tables import plain
from pemviz.pem.data.table import OUTCOME_COLUMN

BOX_COLUMNS = ("left_px", "top_px", "right_px", "bottom_px")
TABLE_COLUMNS = (*TRACK_COLUMNS, "type", "visibility", *BOX_COLUMNS, OUTCOME_COLUMN, "iou")


@dataclass(frozen=True)
class _Row:
    obstacle: MotObstacle
    detected: bool
    overlap: float

    @property
    def place(self) -> tuple[int, int]:
        return self.obstacle.track, self.obstacle.frame


def collect_mot(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Callable[[int, int], None] | None = None,
) -> TrackCounts:
    """Match every labelled box of every frame, and write a row for it.

    All labelled boxes take part in the matching, as KITTI's do; those that are marked to be ignored
    (``dropped``), or of another class than asked for, get no row.

    Args:
        labels: Folder of sequences with ground truth.
        detections: Folder of sequences with detections; may be the same.
        out: CSV to write; complete or not there.
        rate_hz: Frames a second of sequences whose ``seqinfo.ini`` does not tell.
        types: Classes that get a row, such as pedestrian; all if empty.
        options: What counts as a detection.
        on_progress: Told (sequences done, sequences in all).

    Raises:
        PemError: Naming file, line and column of what is malformed, or what is missing.
    """
    if unknown := [name for name in types if name not in CLASSES]:
        raise PemError(f"types: {unknown[0]!r} is no class, allowed: {', '.join(CLASSES)}")
    files, reported = sequence_files(labels, "gt"), sequence_files(detections, "det")
    counts, lines = TrackCounts(), list[str]()
    on_bad_line = counts.on_bad_line(skip_bad=options.skip_bad)
    for done, (sequence, file) in enumerate(files.items(), start=1):
        plain(sequence, labels)
        if sequence not in reported:
            raise PemError(f"{detections}: no detections of sequence {sequence!r}")
        found = read_detections(reported[sequence], on_bad_line=on_bad_line)
        obstacles = read_ground_truth(file, on_bad_line=on_bad_line)
        rate = sequence_rate_hz(file) or rate_hz
        rows = sorted(_rows(obstacles, found, types, options, counts), key=lambda row: row.place)
        lines += [_line(sequence, rate, row) for row in rows]
        counts.add_sequence(
            [row.place for row in rows], missed=sum(not row.detected for row in rows)
        )
        if on_progress is not None:
            on_progress(done, len(files))
    write_table(out, TABLE_COLUMNS, lines)
    return counts


def _rows(
    obstacles: list[MotObstacle],
    found: dict[int, list[Detection]],
    types: tuple[str, ...],
    options: CollectOptions,
    counts: TrackCounts,
) -> Iterator[_Row]:
    by_frame: dict[int, list[MotObstacle]] = {}
    for each in obstacles:
        by_frame.setdefault(each.frame, []).append(each)
    for frame, present in by_frame.items():
        seen = found.get(frame, [])
        kept = [each for each in seen if each.score >= options.score_from]
        counts.ignored_detections += len(seen) - len(kept)
        overlaps, _ = assign_boxes(
            [each.box_px for each in present], [each.box_px for each in kept]
        )
        for each, overlap in zip(present, overlaps.tolist(), strict=True):
            if types and each.type not in types:
                counts.other_types += 1
            elif not each.counts:
                counts.dropped += 1
            else:
                yield _Row(each, overlap > options.iou_above, overlap)


def _line(sequence: str, rate_hz: float, row: _Row) -> str:
    one = row.obstacle
    visible = "" if one.visibility is None else f"{one.visibility:.6g}"
    who = (sequence, str(one.frame), str(one.track), f"{rate_hz:g}", one.type, visible)
    sides = (f"{side:.10g}" for side in one.box_px)
    return ",".join((*who, *sides, str(int(row.detected)), f"{row.overlap:.4f}"))
