"""Labelled sequences and what the detector said of them, as files that KITTI's users have.

Labels are those of KITTI's tracking benchmark (``label_02``), a file a sequence; detections a file
of the same name, ``frame, left, top, right, bottom, score``, as ``pemviz pem collect --format mot``
reads. Beside them stands what no user has: each sequence's light and weather.
"""

import json
from pathlib import Path

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.files.atomic import write_text
from studies.detector_in_the_loop.camera import CAMERA_HEIGHT_M
from studies.detector_in_the_loop.detector import Detections, Detector
from studies.detector_in_the_loop.drives import DT_S, FRAMES, DriveKind, Labels, draw_drive
from studies.detector_in_the_loop.render import render
from studies.detector_in_the_loop.scene import LIGHTS, WEATHERS, Domain

RATE_HZ = 1.0 / DT_S
AT_A_TIME = 20
"""Sequences."""
PARTLY, LARGELY = 0.1, 0.5
"""Occluded shares from which on a car is partly and largely occluded, as encounters have it."""


def write_sequences(
    domain: Domain,
    detector: Detector,
    folder: Path,
    *,
    count: int,
    seeds: np.random.SeedSequence,
    offset: int = 0,
    kind: DriveKind = "usual",
) -> None:
    """Render, detect and write sequences ``offset`` to ``offset + count``.

    They go into ``folder/label_02`` and ``folder/boxes``, their hidden light and weather into
    ``folder/hidden``; ``kind`` as of :func:`.drives.draw_drive`. A sequence depends on the
    seeds and on its own block alone.

    Raises:
        OSError: A file cannot be written.
    """
    for name in ("label_02", "boxes", "hidden"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for start in range(offset, offset + count, AT_A_TIME):
        block = np.random.SeedSequence(seeds.entropy, spawn_key=(*seeds.spawn_key, start))
        drive = draw_drive(domain, count=AT_A_TIME, seeds=block, kind=kind)
        written = min(AT_A_TIME, offset + count - start)
        sequence = np.repeat(np.arange(written), FRAMES)
        step = np.tile(np.arange(FRAMES), written)
        labels = drive.labels(sequence, step)
        found = detector.detect(render(*drive.at(sequence, step)))
        for own in range(written):
            name, rows = f"{start + own:06d}.txt", slice(own * FRAMES, (own + 1) * FRAMES)
            write_text(folder / "label_02" / name, label_lines(labels, rows))
            write_text(folder / "boxes" / name, detection_lines(found, rows))
            values = drive.scenes.take(np.array([own]))
            hidden = {
                "light": LIGHTS[int(values.column("light")[0])],
                "weather": WEATHERS[int(values.column("weather")[0])],
            }
            write_text(folder / "hidden" / f"{start + own:06d}.json", json.dumps(hidden))


def label_lines(labels: Labels, rows: slice) -> str:
    """A sequence's labels, frames counted from 0."""
    lines: list[str] = []
    first = rows.start
    for row in range(rows.start, rows.stop):
        for car in np.flatnonzero(labels.visible[row]):
            lines.append(f"{row - first} {car} {_cells(labels, row, int(car))}")
    return "".join(f"{line}\n" for line in lines)


def _cells(labels: Labels, row: int, car: int) -> str:
    place = (row, car)
    truncated, occluded = labels.truncated[place], labels.occluded[place]
    level = 0 if truncated < 0.05 else 1 if truncated < 0.5 else 2
    occlusion = int(occluded >= PARTLY) + int(occluded >= LARGELY)
    rotation = -np.pi / 2 - labels.heading_rad[place]
    x_m, z_m = labels.x_m[place], labels.z_m[place]
    alpha = _wrapped(rotation - np.arctan2(x_m, z_m))
    numbers: list[FloatArray | float] = [
        *labels.box_px[place],
        *labels.size_m[place],
        *(x_m, CAMERA_HEIGHT_M, z_m, rotation),
    ]
    text = " ".join(f"{value:.3f}" for value in numbers)
    return f"Car {level} {occlusion} {alpha:.4f} {text}"


def _wrapped(angle_rad: float) -> float:
    return float(np.angle(np.exp(1j * angle_rad)))


def detection_lines(found: Detections, rows: slice) -> str:
    """A sequence's detections, of every score that the detector tells."""
    lines: list[str] = []
    for row in range(rows.start, rows.stop):
        for place in np.flatnonzero(found.score[row] > 0.0):
            sides = ",".join(f"{side:.3f}" for side in found.box_px[row, place])
            lines.append(f"{row - rows.start},{sides},{found.score[row, place]:.5f}\n")
    return "".join(lines)
