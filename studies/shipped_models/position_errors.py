"""Makes shipped models of position errors: ``python -m studies.shipped_models.position_errors``.

Both are lidar detectors. PointPillars on nuScenes' validation drives, which it was not trained on;
PointRCNN on KITTI's tracking sequences, which it was. Seed 0, taken as they came.
"""

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from pemviz.errors import InputError, PemError
from pemviz.files.shipped import asset_path
from pemviz.pem.data.collect import CollectOptions, collect_tracks
from pemviz.pem.data.position_errors import PositionErrorTable, load_error_csv, load_nuscenes_errors
from pemviz.pem.judging.position_error_report import FitSettings, fit_position_errors
from pemviz.pem.model_files import POSITION_ASSET_FOLDER, SUFFIX, save_position_errors
from pemviz.pem.models.cards import KITTI_LICENCE, position_card_markdown
from studies.shipped_models.tracked import LABELS_FOLDER, RATE_HZ, SHIPPED_TRACKED, TYPES

NUSCENES_LICENCE = "CC BY-NC-SA 4.0 (nuScenes, from which the model is made; non-commercial)"
PositionName = Literal["pointpillars", "pointrcnn"]
NUSCENES_FOLDER, KITTI_FOLDER = "nuscenes_pointpillars", "kitti_tracking"
NAMES: tuple[PositionName, ...] = ("pointpillars", "pointrcnn")
FLATTERY = (
    "The detector was trained on images of the same drives: its errors are smaller than on new "
    "roads. A pair is one if the boxes in the image overlap by more than half, so that a few of "
    "the largest errors are another car's place."
)


@dataclass(frozen=True)
class ShipPositionArguments:
    """Fit the shipped models of position errors again."""

    data: Path
    """Folder with nuscenes_pointpillars and kitti_tracking."""
    only: tuple[PositionName, ...] = NAMES
    """Names of the models to fit."""
    out: Path | None = None
    """Folder to write to; that of the shipped models if not given."""


def shipped_table(data: Path, name: PositionName) -> PositionErrorTable:
    """What a shipped model is made from.

    Args:
        data: Folder with the data.
        name: The model's.

    Raises:
        PemError: The data cannot be used.
    """
    if name == "pointpillars":
        return load_nuscenes_errors(data / NUSCENES_FOLDER)
    detector = SHIPPED_TRACKED["pointrcnn"]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / f"{detector.folder}.csv"
        collect_tracks(
            labels=data / KITTI_FOLDER / LABELS_FOLDER,
            detections=data / KITTI_FOLDER / detector.folder,
            out=out,
            sequence_format=detector.sequence_format,
            rate_hz=RATE_HZ,
            types=TYPES,
            options=CollectOptions(iou_above=0.5, drop_unknown=True),
        )
        return replace(load_error_csv(out), note=FLATTERY)


def settings_of(name: PositionName, table: PositionErrorTable) -> FitSettings:
    """How a shipped model is fitted, and what its card says of its data."""
    if name == "pointpillars":
        data = (
            f"{len(table):,} cars of nuScenes' validation drives, at 2 Hz, and where PointPillars, "
            "a lidar detector, reported them, published by C. Innes "
            "(github.com/craigiedon/CommonRules)"
        )
        return FitSettings(name=name, data=data, licence=NUSCENES_LICENCE)
    data = (
        f"{len(table):,} observations of cars at {RATE_HZ:g} Hz in KITTI's tracking sequences (no "
        "unknown occlusion) and where PointRCNN, a lidar detector trained on the same drives, "
        "reported them (overlap above 0.5), published by X. Wang "
        "(github.com/wangxiyang2022/DeepFusionMOT)"
    )
    return FitSettings(name=name, data=data, licence=KITTI_LICENCE)


def run(arguments: ShipPositionArguments) -> int:
    """Collect, fit and write; gives the exit code.

    Raises:
        PemError: A name is none of NAMES, or the data cannot be used.
    """
    folder = arguments.out or asset_path(POSITION_ASSET_FOLDER)
    for name in arguments.only:
        if name not in NAMES:
            raise PemError(f"unknown model {name!r}, allowed: {', '.join(NAMES)}")
        table = shipped_table(arguments.data, name)
        model = fit_position_errors(table, settings_of(name, table))
        save_position_errors(model, folder / f"{name}{SUFFIX}")
        page = position_card_markdown(model.card, digest=model.digest)
        (folder / f"{name}.md").write_text(page, encoding="utf-8")
        print(f"{name}: {len(table):,} errors", file=sys.stderr)
    return 0


def main() -> int:
    """Command line; gives the exit code."""
    try:
        return run(tyro.cli(ShipPositionArguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    raise SystemExit(main())
