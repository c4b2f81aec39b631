"""From label and detection files to the table that models learn from, and what collectors count.

Frames stand alone (:func:`collect`) or make sequences in which obstacles are followed
(:func:`collect_tracks`).
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder, write_text
from pemviz.files.text_files import writing
from pemviz.matching import PAPER_IOU, assign_boxes
from pemviz.pem.data.detections import (
    Detection,
    DetectionFormat,
    SequenceFormat,
    open_detections,
    read_sequence_detections,
)
from pemviz.pem.data.frame_shift import ShiftTally
from pemviz.pem.data.kitti_labels import (
    MISC,
    TYPES,
    UNKNOWN_OCCLUSION,
    Box,
    Obstacle,
    OnBadLine,
    read_labels,
    read_tracking_labels,
)
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN, TRACK_COLUMNS
from pemviz.pem.models.protocol import SALIENT_COLUMNS

OBSTACLE_COLUMNS = ("type", *SALIENT_COLUMNS, OUTCOME_COLUMN)
CLASS_ID = {name: index for index, name in enumerate(TYPES)}
NUMBERED_CLASSES = TYPES[:-1]
"""Names of the classes 0, 1, ... unless the user gives others: KITTI's, without DontCare."""

Progress = Callable[[int, int], None]
TrackRow = tuple[int, int, bool, str]
"""Track, frame, whether it was detected, and the line of the table."""
Label = TypeVar("Label")


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


DEFAULT_OPTIONS = CollectOptions()


@dataclass
class CollectedCounts:
    """What happened on the way, of every format."""

    missed: int = 0
    dropped: int = 0
    """Labels left out: what the options say, else class Misc or unknown occlusion."""
    bad_lines: int = 0
    first_bad: str = ""
    """What was wrong with the first of them."""
    doubts: tuple[str, ...] = ()
    """What looks wrong, but may be meant, in words."""

    def judge(
        self,
        rows: int,
        *,
        labels: Path,
        types: Sequence[str] = (),
        shift: ShiftTally | None = None,
    ) -> None:
        """Look at what came out of all files, whose ``rows`` are those of the table.

        Raises:
            PemError: There is no row.
        """
        if rows == 0:
            kinds = " ".join(types) or "any class"
            left_out = f", {self.dropped} are left out" if self.dropped else ""
            raise PemError(f"labels = {labels}: no obstacle of {kinds}{left_out}")
        if shift is not None and (words := shift.words()):
            self.doubts += (words,)

    def on_bad_line(self, *, skip_bad: bool) -> OnBadLine:
        """What a reader does with a malformed line: it is counted, or raised."""

        def on_bad_line(error: PemError) -> None:
            if not skip_bad:
                raise error
            self.bad_lines += 1
            self.first_bad = self.first_bad or str(error)

        return on_bad_line


@dataclass
class CollectCounts(CollectedCounts):
    """What happened on the way, where frames stand alone."""

    frames: int = 0
    obstacles: int = 0


@dataclass
class TrackCounts(CollectedCounts):
    """What happened on the way, where obstacles are followed."""

    sequences: int = 0
    tracks: int = 0
    observations: int = 0
    """Rows written: an obstacle in a frame."""
    gaps: int = 0
    """How often a track goes on after frames without a row; its dropped labels are such."""
    ignored_detections: int = 0
    """Detections of a lower score than asked for."""
    other_types: int = 0
    """Labels left out since they are of another class than asked for."""
    of_given_rate: int = 0
    """Sequences whose frames a second no file tells: they have the rate that was given."""

    def add_sequence(self, rows: Iterable[TrackRow]) -> list[str]:
        """Count a sequence's rows; gives their lines, by track and frame."""
        ordered = sorted(rows, key=lambda row: row[:2])
        self.sequences += 1
        self.tracks += len({track for track, *_ in ordered})
        self.observations += len(ordered)
        self.missed += sum(not detected for *_, detected, _ in ordered)
        self.gaps += sum(
            here[0] == after[0] and after[1] > here[1] + 1 for here, after in pairwise(ordered)
        )
        return [line for *_, line in ordered]


def collect(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    detection_format: DetectionFormat = "kitti",
    options: CollectOptions = DEFAULT_OPTIONS,
    class_names: tuple[str, ...] = NUMBERED_CLASSES,
    image_sizes: Path | None = None,
    missing_is_empty: bool = False,
    on_progress: Progress | None = None,
) -> CollectCounts:
    """Match every labelled obstacle with the detections and write one row for it.

    Where detections of ``kitti`` have a place, two more columns hold how far it is off, reported
    minus true, to the right and forward, as ``pemviz pem fit --position-errors`` reads them; empty
    if missed. The CSV ``out`` is complete or not there.

    Labels are a folder of KITTI label files, one a frame; detections and their class names, image
    sizes and missing files are those of :func:`open_detections`. ``on_progress`` is called with
    frames done and frames in all.

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
    rows: list[tuple[str, tuple[str, str] | None]] = []
    labelled, reported = dict[int, list[Box]](), dict[int, list[Box]]()
    for done, file in enumerate(files, start=1):
        obstacles = read_labels(file, on_bad_line=on_bad_line)
        boxes, types = [each.box_px for each in obstacles], [each.type for each in obstacles]
        seen = reader(file.stem)
        labelled[done], reported[done] = boxes, [each.box_px for each in seen]
        outcomes = _match(boxes, seen, options, types=types)
        for obstacle, (overlap, partner) in zip(obstacles, outcomes, strict=True):
            if options.drop_unknown and _is_unknown(obstacle):
                counts.dropped += 1
                continue
            detected = overlap > options.iou_above
            counts.obstacles += 1
            counts.missed += not detected
            cells = (file.stem, *_salient_cells(obstacle), str(int(detected)), f"{overlap:.4f}")
            rows.append((",".join(cells), _place_errors(partner, obstacle) if detected else None))
        counts.frames += 1
        if on_progress is not None:
            on_progress(done, len(files))
    shift = ShiftTally()
    shift.add(labelled, reported)
    counts.judge(counts.obstacles, labels=labels, shift=shift)
    header = ("frame", *OBSTACLE_COLUMNS, "iou")
    if any(errors is not None for _, errors in rows):
        lines = (",".join((cells, *(errors or ("", "")))) for cells, errors in rows)
        write_table(out, (*header, *PLANE_COLUMNS), lines)
    else:
        write_table(out, header, (cells for cells, _ in rows))
    return counts


def collect_tracks(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    sequence_format: SequenceFormat = "mot",
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Progress | None = None,
) -> TrackCounts:
    """Match every labelled obstacle of every frame, and write a row for it.

    Rows come by sequence, track and frame. Where detections have a place (``ab3dmot``), two more
    columns hold how far it is off, to the right and forward; empty if missed. Obstacles of class
    Misc or of unknown occlusion are left out if the options say so; what is left of their track
    then has a gap. The CSV ``out`` is complete or not there.

    Labels are a folder of KITTI tracking labels, a file a sequence; detections one of files of the
    same names. Only classes in ``types`` count as obstacles, all if it is empty. ``on_progress`` is
    called with sequences done and sequences in all.

    Raises:
        PemError: naming file, line and column of what is malformed, or what is missing.
    """
    files = sorted(labels.glob("*.txt")) if is_folder(labels) else []
    if not files:
        raise PemError(f"{labels}: no folder with KITTI tracking labels (*.txt)")
    if unknown := [name for name in types if name not in CLASS_ID]:
        raise PemError(f"types: {unknown[0]!r} is no class, allowed: {', '.join(CLASS_ID)}")
    counts, lines, shift = TrackCounts(), list[str](), ShiftTally()
    on_bad_line = counts.on_bad_line(skip_bad=options.skip_bad)
    placed = sequence_format == "ab3dmot"
    for done, file in enumerate(files, start=1):
        tracked = read_tracking_labels(file, on_bad_line=on_bad_line)
        own = detections / file.name
        if not is_file(own):
            raise PemError(f"{own}: no detections of this sequence")
        found = read_sequence_detections(
            own, sequence_format=sequence_format, on_bad_line=on_bad_line
        )
        kept = [each for each in tracked if not types or each.obstacle.type in types]
        counts.other_types += len(tracked) - len(kept)
        rows: list[TrackRow] = []
        boxes = ((each.frame, each.obstacle.box_px, each) for each in kept)
        for each, overlap, partner in match_frames(boxes, found, options, counts, shift):
            obstacle = each.obstacle
            if options.drop_unknown and _is_unknown(obstacle):
                counts.dropped += 1
                continue
            detected = overlap > options.iou_above
            errors = _place_errors(partner if detected else None, obstacle) or ("", "")
            who = (file.stem, str(each.frame), str(each.track), f"{rate_hz:g}")
            cells = (*who, *_salient_cells(obstacle), str(int(detected)), f"{overlap:.4f}")
            line = ",".join((*cells, *errors) if placed else cells)
            rows.append((each.track, each.frame, detected, line))
        lines += counts.add_sequence(rows)
        counts.of_given_rate += 1
        if on_progress is not None:
            on_progress(done, len(files))
    counts.judge(counts.observations, labels=labels, types=types, shift=shift)
    header = (*TRACK_COLUMNS, *OBSTACLE_COLUMNS, "iou")
    write_table(out, (*header, *PLANE_COLUMNS) if placed else header, lines)
    return counts


def match_frames(
    labels: Iterable[tuple[int, Box, Label]],
    found: Mapping[int, Sequence[Detection]],
    options: CollectOptions,
    counts: TrackCounts,
    shift: ShiftTally,
) -> Iterator[tuple[Label, float, Detection | None]]:
    """Each label of a sequence, given with its frame and box, with its partner and their overlap.

    Detections whose score is too low are counted; overlaps with frames around go into ``shift``.
    """
    by_frame: dict[int, list[tuple[Box, Label]]] = {}
    for frame, box, label in labels:
        by_frame.setdefault(frame, []).append((box, label))
    shift.add(
        {frame: [box for box, _ in present] for frame, present in by_frame.items()},
        {frame: [each.box_px for each in seen] for frame, seen in found.items()},
    )
    for frame, present in by_frame.items():
        seen = found.get(frame, [])
        counts.ignored_detections += sum(each.score < options.score_from for each in seen)
        outcomes = _match([box for box, _ in present], seen, options)
        for (_, label), outcome in zip(present, outcomes, strict=True):
            yield label, *outcome


def _match(
    boxes: Sequence[Box],
    seen: Sequence[Detection],
    options: CollectOptions,
    *,
    types: Sequence[str] = (),
) -> Iterator[tuple[float, Detection | None]]:
    """The overlap of each box with the detection assigned to it, and which that is."""
    kept = [each for each in seen if each.score >= options.score_from]
    class_aware = options.class_aware and bool(types)
    overlaps, partners = assign_boxes(
        boxes,
        [each.box_px for each in kept],
        types=(types, [each.type for each in kept]) if class_aware else None,
    )
    for overlap, partner in zip(overlaps.tolist(), partners.tolist(), strict=True):
        yield overlap, kept[partner] if partner >= 0 else None


def _is_unknown(obstacle: Obstacle) -> bool:
    """Whether no model can be fitted to it."""
    return obstacle.type == MISC or obstacle.occlusion == UNKNOWN_OCCLUSION


def _place_errors(found: Detection | None, obstacle: Obstacle) -> tuple[str, str] | None:
    """Reported minus true place, to the right and forward [m]; ``None`` without a place."""
    if found is None or found.location_m is None:
        return None
    reported, true = found.location_m, obstacle.location_m
    return f"{reported[0] - true[0]:.6g}", f"{reported[2] - true[2]:.6g}"


def _salient_cells(obstacle: Obstacle) -> tuple[str, ...]:
    """An obstacle's type, and its cells in the order of ``SALIENT_COLUMNS``."""
    values = (
        CLASS_ID[obstacle.type],
        obstacle.truncation,
        obstacle.occlusion,
        obstacle.alpha_rad,
        *obstacle.dimensions_m,
        *obstacle.location_m,
        obstacle.rotation_y_rad,
    )
    return (obstacle.type, *(f"{value:.10g}" for value in values))


def plain(name: object, where: object) -> str:
    """A name that can stand in a table.

    Raises:
        PemError: It is none.
    """
    if not isinstance(name, str) or not name.isprintable() or "," in name:
        raise PemError(f"{where}: {str(name)[:40]!r} must be a name without commas")
    return name


def write_table(out: Path, header: Iterable[str], lines: Iterable[str]) -> None:
    """A CSV that is complete, or not there.

    Raises:
        PemError: It cannot be written.
    """
    with writing(out):
        write_text(out, "\n".join([",".join(header), *lines]) + "\n")
