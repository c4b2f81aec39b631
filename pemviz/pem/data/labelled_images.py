"""Labelled boxes of images and a detector's, whatever file they are from, to a table.

Images know nothing of places in the world: the table has boxes in pixels and what else is labelled
of each. It serves ``pemviz pem memory --model guess-mu`` where boxes have tracks, and ``pemviz pem
fit --features height_px,type`` in any case. An image in which nothing was reported is one in which
everything was missed, as COCO's own evaluation has it.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from pemviz.errors import PemError
from pemviz.matching import assign_boxes
from pemviz.pem.data.collect import (
    CollectOptions,
    Progress,
    TrackCounts,
    plain,
    write_table,
)
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.frame_shift import ShiftTally
from pemviz.pem.data.kitti_labels import Box
from pemviz.pem.data.table import OUTCOME_COLUMN, TRACK_COLUMNS

BOX_COLUMNS = ("left_px", "top_px", "right_px", "bottom_px", "width_px", "height_px")
LAST_DIGITS = re.compile(r"(\d{1,15})$")
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,40}")
"""What may be a column's name."""


@dataclass(frozen=True)
class LabelledBox:
    """A labelled obstacle in an image.

    Attributes:
        track: Who it is; empty if nothing says so.
        more: What else is labelled of it, by name.
    """

    track: str
    type: str
    box_px: Box
    more: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True)
class LabelledImage:
    """An image.

    Attributes:
        sequence: Which video it is of, or which folder.
        frame: Which frame of it.
        boxes: Its labels.
        found: What the detector reported.
    """

    name: str
    sequence: str
    frame: int
    boxes: tuple[LabelledBox, ...]
    found: tuple[Detection, ...]


def labelled_more(attributes: Mapping[str, Any], *, without: Collection[str]) -> dict[str, str]:
    """Those of a label's attributes that are one word or number, as a table's cells."""
    found: dict[str, str] = {}
    for name, value in attributes.items():
        if isinstance(value, bool):
            value = "true" if value else "false"  # noqa: PLW2901
        text = str(value) if isinstance(value, int | float | str) else ""
        if text and "," not in text and name not in without:
            found[str(name)] = text
    return found


def frame_of(name: str, stated: object, *, where: str) -> int:
    """The number of a frame: the stated one, else the digits that its file's name ends with.

    Raises:
        PemError: There is neither; a number is not made up.
    """
    if isinstance(stated, int) and not isinstance(stated, bool) and stated >= 0:
        return stated
    found = LAST_DIGITS.search(Path(name).stem)
    if stated is not None or found is None:
        raise PemError(
            f"{where}: image {name!r}: must have a frame number from 0 on, or digits at its name's "
            "end"
        )
    return int(found[1])


def collect_images(
    images: Sequence[LabelledImage],
    *,
    labels: Path,
    out: Path,
    rate_hz: float,
    types: tuple[str, ...],
    options: CollectOptions,
    counts: TrackCounts,
    on_progress: Progress | None = None,
) -> None:
    """Match every labelled box with the detections of its image, and write a row for it.

    All labelled boxes take part in the matching; those of another class than one of ``types``, if
    there are some, get no row. The table has tracks if every box has one.

    Raises:
        PemError: Some boxes have a track and others none, or one is there twice, or no box is left.
    """
    followed = [bool(box.track) for image in images for box in image.boxes]
    if any(followed) and not all(followed):
        raise PemError(
            f"{labels}: {len(followed) - sum(followed)} of {len(followed)} labels have no track, "
            "the others have one: all or none"
        )
    is_followed = bool(followed) and followed[0]
    if is_followed:
        _check_frames(images, labels)
    more = _common(images)
    shift = ShiftTally()
    rows: list[tuple[tuple[str, str, int], str]] = []
    for done, image in enumerate(images, start=1):
        for box, overlap in _outcomes(image, options, counts):
            if types and box.type not in types:
                counts.other_types += 1
                continue
            detected = overlap > options.iou_above
            counts.missed += not detected
            cells = _cells(image, box, more, detected=detected, overlap=overlap)
            if is_followed:
                who = (image.sequence, str(image.frame), box.track, f"{rate_hz:.10g}")
                cells = (*(plain(cell, labels) for cell in who), *cells)
            rows.append(((image.sequence, box.track, image.frame), ",".join(cells)))
        if on_progress is not None:
            on_progress(done, len(images))
    for sequence in dict.fromkeys(image.sequence for image in images):
        own = [image for image in images if image.sequence == sequence]
        shift.add(
            {image.frame: [box.box_px for box in image.boxes] for image in own},
            {image.frame: [each.box_px for each in image.found] for image in own},
        )
    _count(counts, rows, images, is_followed=is_followed)
    counts.judge(len(rows), labels=labels, types=types, shift=shift)
    header = (*(TRACK_COLUMNS if is_followed else ()), "image", "type", *BOX_COLUMNS, *more)
    write_table(out, (*header, OUTCOME_COLUMN, "iou"), (line for _, line in sorted(rows)))


def _outcomes(
    image: LabelledImage, options: CollectOptions, counts: TrackCounts
) -> Iterator[tuple[LabelledBox, float]]:
    kept = [each for each in image.found if each.score >= options.score_from]
    counts.ignored_detections += len(image.found) - len(kept)
    types = [box.type for box in image.boxes], [each.type for each in kept]
    overlaps, _ = assign_boxes(
        [box.box_px for box in image.boxes],
        [each.box_px for each in kept],
        types=types if options.class_aware else None,
    )
    yield from zip(image.boxes, overlaps.tolist(), strict=True)


def _cells(
    image: LabelledImage,
    box: LabelledBox,
    more: Sequence[str],
    *,
    detected: bool,
    overlap: float,
) -> tuple[str, ...]:
    left, top, right, bottom = box.box_px
    sides = (left, top, right, bottom, right - left, bottom - top)
    return (
        plain(image.name, "image"),
        plain(box.type, image.name),
        *(f"{side:.10g}" for side in sides),
        *(plain(box.more[name], image.name) for name in more),
        str(int(detected)),
        f"{overlap:.4f}",
    )


def _common(images: Sequence[LabelledImage]) -> list[str]:
    """What is labelled of every box, by names that a column can have."""
    counted = Counter(name for image in images for box in image.boxes for name in box.more)
    boxes = sum(len(image.boxes) for image in images)
    taken = {*TRACK_COLUMNS, "image", "type", *BOX_COLUMNS, OUTCOME_COLUMN, "iou"}
    return [
        name
        for name, count in counted.items()
        if count == boxes and NAME.fullmatch(name) and name not in taken
    ]


def _check_frames(images: Sequence[LabelledImage], labels: Path) -> None:
    places = Counter((image.sequence, image.frame) for image in images)
    (sequence, frame), count = places.most_common(1)[0]
    if count > 1:
        raise PemError(f"{labels}: {count} images are frame {frame} of sequence {sequence!r}")
    for image in images:
        tracks = Counter(box.track for box in image.boxes)
        who, count = max(tracks.items(), key=lambda each: each[1], default=("", 0))
        if count > 1:
            raise PemError(
                f"{labels}: track {who} of sequence {image.sequence!r} is there twice in frame "
                f"{image.frame}"
            )


def _count(
    counts: TrackCounts,
    rows: Sequence[tuple[tuple[str, str, int], str]],
    images: Sequence[LabelledImage],
    *,
    is_followed: bool,
) -> None:
    counts.observations = len(rows)
    counts.sequences = len({image.sequence for image in images})
    counts.tracks = len({key[:2] for key, _ in rows}) if is_followed else 0
    counts.of_given_rate = counts.sequences if is_followed else 0
    keys = sorted(key for key, _ in rows) if is_followed else []
    counts.gaps = sum(
        one[:2] == other[:2] and other[2] > one[2] + 1 for one, other in pairwise(keys)
    )
    silent = sum(not image.found for image in images if image.boxes)
    labelled = sum(bool(image.boxes) for image in images)
    if silent:
        counts.doubts += (
            f"in {silent} of {labelled} labelled images nothing was reported: all in them counts "
            "as missed; was the detector run on all?",
        )
