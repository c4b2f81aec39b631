"""Targets that read logs of other programs: bags, Arrow's files, boxes in images."""

import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from pyarrow import csv, feather, parquet

from pemviz.errors import PemError
from pemviz.pem.data.argoverse import collect_argoverse
from pemviz.pem.data.coco import collect_coco
from pemviz.pem.data.fiftyone import collect_fiftyone
from pemviz.pem.data.mapped_log import collect_log
from pemviz.pem.data.rosbag import BagOptions, collect_rosbag
from pemviz.pem.data.table import load_table, load_tracks
from pemviz.pem.data.timed_boxes import MatchOptions
from tests.fuzz.harness import Case, Target
from tests.fuzz.mutate import damage_bytes
from tests.pem import test_argoverse, test_labelled_images, test_mapped_log, test_rosbag
from tests.pem.ros_files import write_mcap, write_rosbag2
from tests.pem.test_wrong_tables import tracks_file

FIELDS = {"labels_field": "ground_truth", "detections_field": "predictions"}


@cache
def _valid() -> dict[str, Path]:
    """One file or folder of each form, made once a process."""
    folder = Path(mkdtemp(prefix="pemviz-fuzz-logs-"))
    for name in ("argoverse", "coco"):
        (folder / name).mkdir()
    log = {name: folder / f"{name}.txt" for name in ("labels", "detections", "mapping")}
    texts = (test_mapped_log.LABELS, test_mapped_log.DETECTIONS, test_mapped_log.MAPPING)
    for path, text in zip(log.values(), texts, strict=True):
        path.write_text(text)
    made = {form: test_mapped_log.in_other_form(log, form)["labels"] for form in ("jsonl", "arrow")}
    table = csv.read_csv(tracks_file(folder / "tracks.csv"))
    parquet.write_table(table, folder / "tracks.parquet")
    feather.write_feather(table, folder / "tracks.feather")
    return {
        **made,
        "mapping": log["mapping"],
        "parquet": folder / "tracks.parquet",
        "feather": folder / "tracks.feather",
        "mcap": write_mcap(folder / "drive.mcap", test_rosbag.scene()),
        "rosbag2": write_rosbag2(folder / "drive", test_rosbag.scene()),
        "argoverse": test_argoverse.files(folder / "argoverse")["labels"].parent,
        "coco": test_labelled_images.coco_files(folder / "coco")["labels"].parent,
        "fiftyone": test_labelled_images.fiftyone_file(folder),
    }


def _damaged(case: Case, path: Path) -> Path:
    """A copy with some bytes changed; of a folder one of its files."""
    copy = case.folder / path.name
    if path.is_dir():
        shutil.copytree(path, copy)
        file = case.rng.choice(sorted(each for each in copy.rglob("*") if each.is_file()))
    else:
        shutil.copy(path, copy)
        file = copy
    file.write_bytes(damage_bytes(case.rng, file.read_bytes(), [b"\0" * 64, b"[" * 500]))
    return copy


def read_bag(case: Case) -> None:
    """A bag, as a file or a folder."""
    bag = _damaged(case, _valid()[case.rng.choice(("mcap", "rosbag2"))])
    options, out = BagOptions(**test_rosbag.TOPICS), case.folder / "out.csv"
    counts = collect_rosbag(labels=bag, detections=bag, out=out, options=options)
    assert counts.observations > 0


def read_boxes(case: Case) -> None:
    """Boxes of Argoverse 2, of COCO or of FiftyOne."""
    kind, out = case.rng.choice(("argoverse", "coco", "fiftyone")), case.folder / "out.csv"
    path = _damaged(case, _valid()[kind])
    if kind == "argoverse":
        files = {"labels": path / "val", "detections": path / "found.feather", "out": out}
        collect_argoverse(**files, options=MatchOptions())
    elif kind == "coco":
        collect_coco(labels=path / "truth.json", detections=path / "found.json", out=out)
    else:
        collect_fiftyone(labels=path, out=out, **FIELDS)
    assert out.is_file()


def read_log(case: Case) -> None:
    """A log by a mapping, or a table, of Arrow's or of JSON lines."""
    kind = case.rng.choice(("jsonl", "arrow", "parquet", "feather"))
    path = _damaged(case, _valid()[kind])
    if kind in ("jsonl", "arrow"):
        log = {"labels": path, "detections": path, "mapping": _valid()["mapping"]}
        collect_log(**log, out=case.folder / "out.csv")
        return
    try:
        load_tracks(path)
    except PemError:
        load_table(path)


TARGETS = (
    Target("log-bag", read_bag, 4),
    Target("log-boxes", read_boxes, 4),
    Target("log-arrow", read_log, 4),
)
