"""A data set that FiftyOne exported (``FiftyOneDataset``): two fields of one ``samples.json``.

A sample has ``filepath``, ``metadata`` (width and height, as ``compute_metadata`` writes them) and
fields of ``Detections``, whose boxes are shares of the image (left, top, width, height). A track is
a detection's ``index``; a sequence the folder of the sample's file, a frame its ``frame_number``,
else the digits that the file's name ends with. Without a field of labels, or of predictions, a
sample was not looked at, and is left out.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pemviz.errors import PemError
from pemviz.files.atomic import is_folder
from pemviz.files.json_text import read_json
from pemviz.pem.data.collect import DEFAULT_OPTIONS, CollectOptions, Progress, TrackCounts
from pemviz.pem.data.detections import Detection
from pemviz.pem.data.kitti_labels import FARTHEST_PX, Box
from pemviz.pem.data.labelled_images import (
    LabelledBox,
    LabelledImage,
    collect_images,
    frame_of,
    labelled_more,
)

SAMPLES = "samples.json"
OWN_KEYS = (
    "_id",
    "_cls",
    "label",
    "bounding_box",
    "index",
    "confidence",
    "tags",
    "mask",
    "mask_path",
    "attributes",
)


def collect_fiftyone(
    *,
    labels: Path,
    out: Path,
    labels_field: str,
    detections_field: str,
    rate_hz: float = 10.0,
    types: tuple[str, ...] = (),
    options: CollectOptions = DEFAULT_OPTIONS,
    on_progress: Progress | None = None,
) -> TrackCounts:
    """Match every labelled box with the predictions of its sample, and write a row for it.

    ``labels`` is the exported folder, or its ``samples.json``.

    Raises:
        PemError: Naming file and sample of what is malformed, or what is missing.
    """
    path = labels / SAMPLES if is_folder(labels) else labels
    content = read_json(path)
    samples: Any = content.get("samples") if isinstance(content, dict) else None
    if not isinstance(samples, list) or not samples:
        raise PemError(f"{path}: needs 'samples', a list, as FiftyOne exports them")
    fields = (labels_field, detections_field)
    for name in fields:
        if not any(isinstance(one, dict) and isinstance(one.get(name), dict) for one in samples):
            found = sorted({key for one in samples for key in _fields(one)})
            allowed = ", ".join(found) or "none"
            raise PemError(f"{path}: no sample has a field {name!r}, of Detections are: {allowed}")
    tracked = any(
        isinstance(one, dict) and one.get("index") is not None
        for sample in samples
        for one in _detections(sample, labels_field)
    )
    counts, images = TrackCounts(), list[LabelledImage]()
    for place, sample in enumerate(samples):
        where = f"{path}: sample {place}"
        if not isinstance(sample, dict) or not isinstance(sample.get("filepath"), str):
            raise PemError(f"{where}: must be an object with a 'filepath'")
        if not all(isinstance(sample.get(name), dict) for name in fields):
            counts.dropped += 1
            continue
        images.append(_image(sample, fields, where, frame=None if tracked else place))
    collect_images(
        images,
        labels=path,
        out=out,
        rate_hz=rate_hz,
        types=types,
        options=options,
        counts=counts,
        on_progress=on_progress,
    )
    return counts


def _fields(sample: object) -> Iterator[str]:
    """Names of a sample's fields of detections."""
    for name, value in sample.items() if isinstance(sample, dict) else ():
        if isinstance(value, dict) and isinstance(value.get("detections"), list):
            yield str(name)


def _detections(sample: Any, field: str) -> list[Any]:
    inside = sample.get(field) if isinstance(sample, dict) else None
    found = inside.get("detections") if isinstance(inside, dict) else None
    return found if isinstance(found, list) else []


def _image(
    sample: Mapping[str, Any], fields: tuple[str, str], where: str, *, frame: int | None
) -> LabelledImage:
    name = str(sample["filepath"])
    metadata: Any = sample.get("metadata")
    sides_of: Any = metadata if isinstance(metadata, dict) else {}
    size: tuple[Any, Any] = (sides_of.get("width"), sides_of.get("height"))
    if not all(type(side) in (int, float) and 0 < side <= FARTHEST_PX for side in size):
        raise PemError(
            f"{where}: 'metadata' must have width and height [px] (dataset.compute_metadata() "
            "writes them)"
        )
    boxes = tuple(
        LabelledBox(_track(one), str(one.get("label", "")), sides, _more(one))
        for one, sides in _boxes(sample, fields[0], size, where)
    )
    found = tuple(
        Detection(str(one.get("label", "")), sides, _score(one, where))
        for one, sides in _boxes(sample, fields[1], size, where)
    )
    at = frame if frame is not None else frame_of(name, sample.get("frame_number"), where=where)
    return LabelledImage(Path(name).name, str(Path(name).parent), at, boxes, found)


def _boxes(
    sample: Any, field: str, size: Any, where: str
) -> Iterator[tuple[Mapping[str, Any], Box]]:
    for number, one in enumerate(_detections(sample, field)):
        here = f"{where}: {field}, box {number}"
        shares: Any = one.get("bounding_box") if isinstance(one, dict) else None
        is_box = isinstance(shares, list) and len(shares) == 4
        if not is_box or not all(type(each) in (int, float) for each in shares):
            raise PemError(f"{here}: 'bounding_box' must be four numbers")
        left, top, width, height = shares
        if not all(-1.0 <= each <= 2.0 for each in shares) or min(width, height) < 0.0:
            raise PemError(f"{here}: 'bounding_box' is {shares}, allowed: shares of the image")
        wide, high = size
        sides = (left * wide, top * high, (left + width) * wide, (top + height) * high)
        yield one, sides


def _track(one: Mapping[str, Any]) -> str:
    return "" if one.get("index") is None else str(one["index"])


def _score(one: Mapping[str, Any], where: str) -> float:
    score = one.get("confidence")
    if score is None:
        return 1.0
    if type(score) not in (int, float):
        raise PemError(f"{where}: 'confidence' is {str(score)[:40]!r}, must be a number")
    return float(score)


def _more(one: Mapping[str, Any]) -> dict[str, str]:
    """What else is labelled; of FiftyOne's own attributes their values."""
    inner: Any = one.get("attributes")
    named: dict[str, Any] = {**(inner if isinstance(inner, dict) else {}), **one}
    values = {n: v.get("value") if isinstance(v, dict) else v for n, v in named.items()}
    return labelled_more(values, without=OWN_KEYS)
