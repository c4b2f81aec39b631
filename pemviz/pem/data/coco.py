"""COCO's ground truth and results: boxes in images, with tracks where annotations have them.

Ground truth is an object of ``images``, ``annotations`` and ``categories``; results a list of
``image_id, category_id, bbox, score``, or such an object too (images then meet by their file's
name). A track is an annotation's ``track_id`` (or ``instance_id``), in itself or among its
``attributes``, as CVAT writes it; a sequence an image's ``video_id``, or the folder in its file's
name; a frame its ``frame_id`` (or ``frame_index``), else the digits that the name ends with.
Annotations of crowds are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pemviz.errors import PemError
from pemviz.files.json_text import read_json
from pemviz.pem.data.collect import DEFAULT_OPTIONS, CollectOptions, Progress, TrackCounts
from pemviz.pem.data.detections import Detection, coco_entry
from pemviz.pem.data.kitti_labels import OnBadLine
from pemviz.pem.data.labelled_images import (
    LabelledBox,
    LabelledImage,
    collect_images,
    frame_of,
    labelled_more,
)

TRACK_KEYS = ("track_id", "instance_id")
FRAME_KEYS = ("frame_id", "frame_index")
NO_TRACK = -1


@dataclass(frozen=True)
class _Image:
    name: str
    sequence: str
    frame: int


def collect_coco(
    *,
    labels: Path,
    detections: Path,
    out: Path,
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Progress | None = None,
) -> TrackCounts:
    """Match every annotation with the results of its image, and write a row for it.

    Raises:
        PemError: Naming file and entry of what is malformed, or what is missing.
    """
    counts = TrackCounts()
    on_bad = counts.on_bad_line(skip_bad=options.skip_bad)
    truth = read_json(labels)
    if not isinstance(truth, dict) or not isinstance(truth.get("annotations"), list):
        raise PemError(f"{labels}: ground truth must be an object with 'images' and 'annotations'")
    names = _named(truth, "categories", "name", where=str(labels))
    images = _images(truth, where=str(labels))
    boxes: dict[str, list[LabelledBox]] = {key: [] for key in images}
    for index, entry in enumerate(truth["annotations"]):
        where = f"{labels}: annotation {index}"
        try:
            image, kind, found = coco_entry(entry, where=where)
            if image not in images:
                raise PemError(f"{where}: image_id {image} is none of 'images'")
            if kind not in names:
                raise PemError(f"{where}: category_id {kind} is none of 'categories'")
        except PemError as error:
            on_bad(error)
            continue
        if entry.get("iscrowd"):
            counts.dropped += 1
            continue
        attributes: Any = entry.get("attributes")
        inner = attributes if isinstance(attributes, dict) else {}
        more = labelled_more(inner, without=TRACK_KEYS)
        boxes[image].append(LabelledBox(_track(entry), names[kind], found.box_px, more))
    seen = _results(detections, images, names, on_bad)
    collect_images(
        [
            LabelledImage(one.name, one.sequence, one.frame, tuple(boxes[key]), tuple(seen[key]))
            for key, one in images.items()
        ],
        labels=labels,
        out=out,
        rate_hz=rate_hz,
        types=types,
        options=options,
        counts=counts,
        on_progress=on_progress,
    )
    return counts


def _named(content: Mapping[str, Any], section: str, key: str, *, where: str) -> dict[str, str]:
    """Names by id as text.

    Raises:
        PemError: An entry lacks one, or an id is there twice.
    """
    entries = content.get(section, [])
    try:
        found = {str(item["id"]): str(item[key]) for item in entries}
    except (KeyError, TypeError):
        raise PemError(f"{where}: an entry of {section!r} lacks 'id' or {key!r}") from None
    if len(found) < len(entries):
        raise PemError(f"{where}: an id of {section!r} is there twice")
    return found


def _images(content: Mapping[str, Any], *, where: str) -> dict[str, _Image]:
    names = _named(content, "images", "file_name", where=where)
    if not names:
        raise PemError(f"{where}: no 'images'")
    videos = _named(content, "videos", "name", where=where) if "videos" in content else {}
    tracked = any(_track(entry) for entry in content["annotations"] if isinstance(entry, dict))
    found: dict[str, _Image] = {}
    for place, item in enumerate(content["images"]):
        key, name = str(item["id"]), names[str(item["id"])]
        video = str(item.get("video_id", ""))
        sequence = videos.get(video, video) or str(Path(name).parent)
        stated = next((item[key] for key in FRAME_KEYS if key in item), None)
        frame = frame_of(name, stated, where=where) if tracked else place
        found[key] = _Image(name, sequence, frame)
    return found


def _track(entry: Mapping[str, Any]) -> str:
    """Who an annotation is of, as text; empty if it does not say."""
    attributes = entry.get("attributes")
    for where in (entry, attributes if isinstance(attributes, dict) else {}):
        for key in TRACK_KEYS:
            if where.get(key) not in (None, "", NO_TRACK):
                return str(where[key])
    return ""


def _results(
    path: Path, images: Mapping[str, _Image], names: Mapping[str, str], on_bad: OnBadLine
) -> dict[str, list[Detection]]:
    """What was reported in each image, by the ground truth's id."""
    content = read_json(path)
    entries = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(entries, list):
        raise PemError(f"{path}: need a list of results, or an object with 'annotations'")
    by_name = {one.name: key for key, one in images.items()}
    own_names, own_images = dict(names), {key: key for key in images}
    if isinstance(content, dict):
        own_names = _named(content, "categories", "name", where=str(path)) or own_names
        listed = _named(content, "images", "file_name", where=str(path))
        own_images = {key: by_name.get(name, "") for key, name in listed.items()} or own_images
    found: dict[str, list[Detection]] = {key: [] for key in images}
    for index, entry in enumerate(entries):
        where = f"{path}: entry {index}"
        try:
            image, kind, one = coco_entry(entry, where=where)
            if own_images.get(image, "") not in found:
                raise PemError(f"{where}: image_id {image} is none of the ground truth's images")
        except PemError as error:
            on_bad(error)
            continue
        name = own_names.get(kind, kind)
        found[own_images[image]].append(Detection(name, one.box_px, one.score))
    return found
