"""MOTChallenge's ground truth and detections to a table of who is missed when.

These files tell nothing of places in the world: the table has no salient variables. It serves
``pemviz pem memory --model guess-mu``, how misses follow each other; no error model can be fitted.

A line is ``frame, id, left, top, width, height, conf, ...`` (pixels; frame and id from 1). In
ground truth conf 0 marks what is to be ignored, and since MOT16 a class and the visible share
follow; in detections conf is the score, and the id -1 or a tracker's. As in the benchmark's folders
a sequence is ``SEQUENCE/gt/gt.txt`` or ``SEQUENCE/det/det.txt``, with its rate in
``SEQUENCE/seqinfo.ini``; or, as trackers' results are, ``SEQUENCE.txt``.
"""

from configparser import ConfigParser
from configparser import Error as IniError
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pemviz.errors import PemError
from pemviz.files.atomic import is_file, is_folder
from pemviz.files.text_files import check_columns, open_text
from pemviz.pem.data.collect import (
    DEFAULT_OPTIONS,
    CollectOptions,
    Progress,
    TrackCounts,
    TrackRow,
    match_frames,
    plain,
    write_table,
)
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.frame_shift import ShiftTally
from pemviz.pem.data.kitti_labels import LARGEST_NUMBER, Box, box, numbers, parsed_lines
from pemviz.pem.data.table import OUTCOME_COLUMN, TRACK_COLUMNS

COLUMNS = ("frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf")
CLASSED = (*COLUMNS, "class", "visibility")
WORLD = (*COLUMNS, "x", "y", "z")
EITHER = (*COLUMNS, "class or x", "visibility or y", "z")
CLASSES = (
    *("pedestrian", "person_on_vehicle", "car", "bicycle", "motorbike", "non_motorized_vehicle"),
    *("static_person", "distractor", "occluder", "occluder_on_ground", "occluder_full"),
    *("reflection", "crowd"),
)
"""The classes 1, 2, ...; files with ``x, y, z`` in their place tell of none: pedestrians."""
SEQUENCE_INFO = "seqinfo.ini"
FASTEST_HZ = 1e4
BOX_COLUMNS = ("left_px", "top_px", "right_px", "bottom_px")
TABLE_COLUMNS = (*TRACK_COLUMNS, "type", "visibility", *BOX_COLUMNS, OUTCOME_COLUMN, "iou")


@dataclass(frozen=True)
class MotObstacle:
    """A labelled box of one frame.

    Attributes:
        frame: Counted from 1.
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


def collect_mot(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Progress | None = None,
) -> TrackCounts:
    """Match every labelled box of every frame, and write a row for it.

    All labelled boxes take part in the matching, as KITTI's do; those that are marked to be ignored
    (``dropped``), or of another class than one of ``types`` if there are some, get no row. The CSV
    ``out`` is complete or not there.

    Labels and detections are folders of sequences, perhaps the same; ``rate_hz`` is that of
    sequences whose ``seqinfo.ini`` does not tell. ``on_progress`` is called with sequences done and
    sequences in all.

    Raises:
        PemError: Naming file, line and column of what is malformed, or what is missing.
    """
    if unknown := [name for name in types if name not in CLASSES]:
        raise PemError(f"types: {unknown[0]!r} is no class, allowed: {', '.join(CLASSES)}")
    files, reported = _sequence_files(labels, "gt"), _sequence_files(detections, "det")
    counts, lines, shift = TrackCounts(), list[str](), ShiftTally()
    on_bad_line = counts.on_bad_line(skip_bad=options.skip_bad)
    for done, (sequence, file) in enumerate(files.items(), start=1):
        plain(sequence, labels)
        if sequence not in reported:
            raise PemError(f"{detections}: no detections of sequence {sequence!r}")
        found: dict[int, list[Detection]] = {}
        read = parsed_lines(reported[sequence], _detection, on_bad_line=on_bad_line, separator=",")
        for frame, detection in read:
            found.setdefault(frame, []).append(detection)
        truth = list(parsed_lines(file, _obstacle, on_bad_line=on_bad_line, separator=","))
        told = _sequence_rate_hz(file)
        rate = rate_hz if told is None else told
        counts.of_given_rate += told is None
        boxes = ((each.frame, each.box_px, each) for each in truth)
        rows: list[TrackRow] = []
        for each, overlap, _ in match_frames(boxes, found, options, counts, shift):
            if types and each.type not in types:
                counts.other_types += 1
            elif not each.counts:
                counts.dropped += 1
            else:
                detected = overlap > options.iou_above
                line = _line(sequence, rate, each, detected=detected, overlap=overlap)
                rows.append((each.track, each.frame, detected, line))
        lines += counts.add_sequence(rows)
        if on_progress is not None:
            on_progress(done, len(files))
    counts.judge(counts.observations, labels=labels, types=types, shift=shift)
    write_table(out, TABLE_COLUMNS, lines)
    return counts


def _line(
    sequence: str, rate_hz: float, one: MotObstacle, *, detected: bool, overlap: float
) -> str:
    visible = "" if one.visibility is None else f"{one.visibility:.6g}"
    who = (sequence, str(one.frame), str(one.track), f"{rate_hz:g}", one.type, visible)
    sides = (f"{side:.10g}" for side in one.box_px)
    return ",".join((*who, *sides, str(int(detected)), f"{overlap:.4f}"))


def _sequence_files(folder: Path, kind: Literal["gt", "det"]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    if is_folder(folder):
        found = {path.parents[1].name: path for path in folder.glob(f"*/{kind}/{kind}.txt")}
        found = found or {path.stem: path for path in folder.glob("*.txt")}
    if not found:
        raise PemError(f"{folder}: no MOTChallenge files (SEQUENCE/{kind}/{kind}.txt, or *.txt)")
    return dict(sorted(found.items()))


def _sequence_rate_hz(file: Path) -> float | None:
    """Frames a second of a sequence by its file of ground truth; ``None`` if nothing tells."""
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


def _values(cells: list[str], where: str) -> tuple[int, int, Box, list[float]]:
    """Frame, identity, box, and the numbers from ``conf`` on."""
    check_columns(cells, EITHER, where=where, optional=len(EITHER) - len(COLUMNS))
    names = WORLD if len(cells) == len(WORLD) else CLASSED
    frame, identity, left, top, width, height, *rest = numbers(cells, names, first=0, where=where)
    if not (1 <= frame < LARGEST_NUMBER and frame == int(frame)):
        raise PemError(f"{where}: column 1 (frame) is {cells[0]!r}, not a whole number from 1 on")
    if not (abs(identity) < LARGEST_NUMBER and identity == int(identity)):
        raise PemError(f"{where}: column 2 (id) is {cells[1]!r}, not a whole number")
    sides = box(left, top, left + width, top + height, column=3, where=where)
    return int(frame), int(identity), sides, rest


def _detection(cells: list[str], where: str) -> tuple[int, Detection]:
    frame, _, sides, (score, *_) = _values(cells, where)
    return frame, Detection("", sides, score)


def _obstacle(cells: list[str], where: str) -> MotObstacle:
    frame, track, sides, (counts, *others) = _values(cells, where)
    kind, visibility = CLASSES[0], None
    if len(COLUMNS) < len(cells) < len(WORLD):
        if not (1 <= others[0] <= len(CLASSES) and others[0] == int(others[0])):
            raise PemError(
                f"{where}: column 8 (class) is {cells[7]!r}, allowed: 1 to {len(CLASSES)}"
            )
        kind = CLASSES[int(others[0]) - 1]
        visibility = others[1] if len(others) > 1 else None
    if visibility is not None and not 0.0 <= visibility <= 1.0:
        raise PemError(f"{where}: column 9 (visibility) is {cells[8]!r}, allowed: 0 to 1")
    if track < 0:
        raise PemError(f"{where}: column 2 (id) is {cells[1]!r}, not a whole number from 0 on")
    return MotObstacle(frame, track, sides, kind, visibility, counts != 0.0)
