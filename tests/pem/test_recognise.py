"""Formats are found out from the files; what does not belong together is told in one line."""

import json
import re

import pytest

from pemviz.errors import PemError
from pemviz.files.shipped import asset_path
from pemviz.pem.data.recognise import recognise
from tests.pem import test_argoverse
from tests.pem.detector_files import write_kitti, write_lines, write_mot_challenge, write_tracking
from tests.pem.ros_files import write_mcap
from tests.pem.test_labelled_images import fiftyone_file
from tests.pem.test_nuscenes import annotation, beside, detection, write_nuscenes
from tests.pem.test_rosbag import scene


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Labels and detections by format."""
    root = tmp_path_factory.mktemp("files")
    short = {"sequences": 1, "frames": 8}
    paths = {
        "kitti": write_kitti(root / "kitti", frames=6),
        "mot": write_tracking(root / "mot", **short),
        "ab3dmot": write_tracking(root / "ab3dmot", places=True, **short),
        "motchallenge": write_mot_challenge(root / "challenge", **short),
    }
    (root / "nuscenes").mkdir()
    nuscenes = write_nuscenes(
        root / "nuscenes", [annotation(beside(3, 10))], {"s0": [detection(beside(3, 10))]}
    )
    paths["nuscenes"] = nuscenes["labels"], nuscenes["detections"]
    labels = paths["kitti"][0]
    write_lines(root / "yolo", {"000000.txt": [], "000001.txt": ["0 0.5 0.5 0.1 0.2 0.9"]})
    paths["yolo"] = labels, root / "yolo"
    coco = root / "coco.json"
    coco.write_text(json.dumps([{"image_id": 0, "category_id": 0, "bbox": [1, 2, 3, 4]}]))
    paths["coco"] = labels, coco
    log = root / "log"
    write_lines(log, {"salient_inputs.txt": ["# a comment", "1 9 0.3 4.2 1.7 1.5 4"],
                      "salient_labels.txt": ["1 0.1 0.1 3.1"]})  # fmt: skip
    paths["log"] = log, log
    for name in ("argoverse", "images", "bags"):
        (root / name).mkdir()
    argoverse = test_argoverse.files(root / "argoverse")
    paths["argoverse"] = argoverse["labels"], argoverse["detections"]
    bag = write_mcap(root / "bags" / "drive.mcap", scene())
    paths["rosbag"] = bag, bag.parent
    samples = fiftyone_file(root / "images")
    paths["fiftyone"] = samples, samples.parent
    return paths


@pytest.mark.parametrize(
    "name",
    [
        "kitti",
        "yolo",
        "coco",
        "mot",
        "ab3dmot",
        "nuscenes",
        "motchallenge",
        "log",
        "argoverse",
        "rosbag",
        "fiftyone",
    ],
)
def test_a_format_is_found_out_from_the_files(files, name):
    found = recognise(*files[name])
    assert found.file_format == name
    mapping = asset_path("mappings", "nuscenes-cars.toml") if name == "log" else None
    assert found.mapping == mapping


def test_labels_and_detections_of_two_formats_are_refused(files):
    belong = {("kitti", "yolo"), ("kitti", "coco"), ("yolo", "coco"), ("mot", "ab3dmot")}
    for one in files:
        for other in files:
            if one == other or tuple(sorted((one, other))) in {tuple(sorted(b)) for b in belong}:
                continue
            labels, detections = files[one][0], files[other][1]
            with pytest.raises(PemError, match=r"(labels|detections) = .*(must be|allowed|no )"):
                recognise(labels, detections)


def test_trackers_results_are_files_a_sequence_too(tmp_path):
    write_lines(tmp_path / "gt", {"one.txt": ["1,1,10,10,20,40,1,1,1"]})
    write_lines(tmp_path / "found", {"one.txt": ["1,-1,10,10,20,40,0.9,-1,-1,-1"]})
    assert recognise(tmp_path / "gt", tmp_path / "found").file_format == "motchallenge"


@pytest.mark.parametrize(
    ("labels", "detections", "words"),
    [
        ("absent", "mot/found", r"labels = .*absent: there is no such file or folder$"),
        ("mot/labels", "absent", r"detections = .*absent: there is no such file or folder$"),
        ("x" * 300, "mot/found", "there is no such file or folder$"),
        ("mot", "mot/found", r"labels = .*mot: no labels that are known; in it is labels; allowed"),
        ("mot/labels", "mot", r"detections = .*: no detections that are known; in it is found; al"),
        ("mot/found", "mot/labels", r"labels = .*: boxes by frame \(mot\); they are no labels; al"),
        ("mot/labels", "kitti/results", r": KITTI results; beside KITTI tracking labels must be b"),
        ("kitti/label_2", "kitti/label_2", "are the labels themselves"),
        ("empty", "mot/found", r"labels = .*empty: the folder is empty$"),
        ("mot/labels", "empty", r"detections = .*empty: the folder is empty$"),
        ("mot/labels", "blank", r"detections = .*blank: its files hold no line$"),
        ("mot/labels", "blank/0000.txt", r"detections = .*0000.txt: the file holds no line$"),
        ("mot/labels", "empty.json", r"detections = .*empty.json: the file is empty$"),
        ("mot/labels", "other.json", "no detections that are known; allowed: KITTI results, YOLO"),
        ("mot/labels", "binary", "no detections that are known"),
        ("log", "mot/found", r"detections = .*: must be a folder with salient_labels.txt, too$"),
    ],
)
def test_what_cannot_be_used_is_told_in_one_line(files, labels, detections, words):
    root = files["mot"][0].parents[1]
    (root / "empty").mkdir(exist_ok=True)
    write_lines(root / "blank", {"0000.txt": [], "0001.txt": ["", " "]})
    write_lines(root, {"empty.json": [], "other.json": ['{"nothing": 1}']})
    (root / "binary").mkdir(exist_ok=True)
    (root / "binary" / "a.txt").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(PemError) as raised:
        recognise(root / labels, root / detections)
    assert re.search(words, str(raised.value)), str(raised.value)
    assert "\n" not in str(raised.value)
