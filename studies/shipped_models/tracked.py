"""Makes the shipped models with a memory: ``python -m studies.shipped_models.tracked --help``.

P(missed | state) and the memory of misses come from the same video, KITTI's tracking sequences,
and from a detector's published output on them. Seed 0, taken as it came.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from pemviz.errors import InputError, PemError
from pemviz.files.shipped import asset_path
from pemviz.pem.data.collect import CollectOptions, collect_tracks
from pemviz.pem.data.detections import SequenceFormat
from pemviz.pem.data.table import TrackTable, load_tracks
from pemviz.pem.fitting.fit import ModelKind, Provenance, fit_pem
from pemviz.pem.judging.memory_report import cross_fit, fit_report, memory_line, with_memory
from pemviz.pem.judging.predictive_check import check_held_out
from pemviz.pem.model_files import ASSET_FOLDER, SUFFIX, save_pem
from pemviz.pem.models.cards import KITTI_LICENCE, card_markdown

FLATTERY = (
    "The detector was trained on images of the same drives: its misses close by are fewer than on "
    "new roads, and these figures flatter it. How misses follow each other close by rests on the "
    "few misses counted under 'plain view'."
)

TrackedName = Literal["rrc", "pointrcnn"]
LABELS_FOLDER = "label_02"
KIND: ModelKind = "gb-raw"
OPTIONS = CollectOptions(iou_above=0.5, drop_unknown=True)
TYPES = ("Car",)
RATE_HZ = 10.0


@dataclass(frozen=True)
class Detector:
    """Whose output on KITTI's tracking sequences is collected."""

    words: str
    """What it is."""
    folder: str
    """Where its output lies, beside the labels."""
    sequence_format: SequenceFormat
    """How it is written."""


SHIPPED_TRACKED: dict[TrackedName, Detector] = {
    "rrc": Detector("RRC, a camera detector", "rrc_car", "mot"),
    "pointrcnn": Detector("PointRCNN, a lidar detector", "pointrcnn_car", "ab3dmot"),
}


@dataclass(frozen=True)
class ShipTrackedArguments:
    """Fit the shipped models that have a memory again."""

    data: Path
    """Folder with KITTI's tracking labels (label_02) and the detectors' output (rrc_car,
    pointrcnn_car)."""
    only: tuple[TrackedName, ...] = ("rrc", "pointrcnn")
    """Names of the models to fit."""
    out: Path | None = None
    """Folder to write to; that of the shipped models if not given."""


def provenance_of(detector: Detector, tracks: TrackTable) -> Provenance:
    """What the card says of the training data."""
    sequences = len(set(tracks.sequence.tolist()))
    return Provenance(
        data=(
            f"{len(tracks):,} observations of cars at {RATE_HZ:g} Hz in {sequences} of KITTI's "
            f"tracking sequences (no unknown occlusion) and what {detector.words} trained on the "
            "same drives, made of each (overlap above 0.5), published by X. Wang "
            "(github.com/wangxiyang2022/DeepFusionMOT)"
        ),
        licence=KITTI_LICENCE,
    )


def collect_detector(data: Path, detector: Detector) -> TrackTable:
    """The tracks of cars with what a detector made of them.

    Raises:
        PemError: A file is missing or malformed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / f"{detector.folder}.csv"
        collect_tracks(
            labels=data / LABELS_FOLDER,
            detections=data / detector.folder,
            out=out,
            sequence_format=detector.sequence_format,
            rate_hz=RATE_HZ,
            types=TYPES,
            options=OPTIONS,
        )
        return load_tracks(out)


def run(arguments: ShipTrackedArguments) -> int:
    """Collect, fit, score and write; gives the exit code.

    Raises:
        PemError: a name is none of SHIPPED_TRACKED, or the data cannot be used.
    """
    folder = arguments.out or asset_path(ASSET_FOLDER)
    for name in arguments.only:
        if name not in SHIPPED_TRACKED:
            raise PemError(f"unknown model {name!r}, allowed: {', '.join(SHIPPED_TRACKED)}")
        detector = SHIPPED_TRACKED[name]
        tracks = collect_detector(arguments.data, detector)
        print(f"{name}: folds of sequences", file=sys.stderr)
        held_out = cross_fit(tracks, model=KIND)
        print(f"{name}: memory", file=sys.stderr)
        report = fit_report(tracks, held_out)
        provenance = provenance_of(detector, tracks)
        whole = fit_pem(tracks.obstacles, model=KIND, name=name, provenance=provenance)
        print(f"{name}: predictive checks", file=sys.stderr)
        pem = with_memory(
            whole,
            tracks,
            cross_fitted=held_out,
            report=report,
            check=check_held_out(tracks, held_out, report.surface).check,
            flattery=FLATTERY,
        )
        save_pem(pem, folder / f"{name}{SUFFIX}")
        text = card_markdown(pem.card, digest=pem.digest)
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
        print(f"{name}: {memory_line(report)}", file=sys.stderr)
    return 0


def main() -> int:
    """Command line; gives the exit code."""
    try:
        return run(tyro.cli(ShipTrackedArguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
