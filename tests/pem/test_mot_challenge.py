"""MOTChallenge's files: known outcomes, the sequences' own rates, and what is wrong with them."""

import re

import numpy as np
import pytest

from pemviz.errors import PemError
from pemviz.pem.data.collect import CollectOptions
from pemviz.pem.data.mot_challenge import collect_mot
from pemviz.pem.data.table import load_table, load_tracks
from tests.pem.helpers import assert_refused, collect_command, rows_of

GROUND_TRUTH = """1, 2, 100, 100, 10, 20, 1, 1, 0.9
2,2,102,100,10,20,1,1,0.5
4,2,106,100,10,20,1,1,1
1,7,300,50,40,40,1,3,0
1,9,104,100,10,20,0,8,1

2,9,400,100,10,20,1,7,1
"""
DETECTIONS = """1,-1,105,100,10,20,0.9,-1,-1,-1
1,-1,310,50,40,40,0.8,-1,-1,-1
2,-1,102,100,10,20,0.2
4,-1,106,110,10,20,-0.4
"""


@pytest.fixture
def files(tmp_path):
    folder = tmp_path / "train" / "MOT17-02"
    for name, text in (
        ("gt/gt.txt", GROUND_TRUTH),
        ("det/det.txt", DETECTIONS),
        ("seqinfo.ini", "[Sequence]\nname=MOT17-02\nframeRate=30\nimDir=100%\n"),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return {"labels": tmp_path / "train", "detections": tmp_path / "train",
            "out": tmp_path / "own.csv"}  # fmt: skip


def test_boxes_are_matched_by_overlap_and_what_is_ignored_takes_its_detection(files) -> None:
    counts = collect_mot(**files, options=CollectOptions(iou_above=0.3))
    assert (counts.sequences, counts.tracks, counts.observations) == (1, 3, 5)
    assert (counts.missed, counts.gaps, counts.dropped) == (2, 1, 1)
    rows = rows_of(files["out"])
    told = [(r["track"], r["frame"], r["type"], r["detected"], r["visibility"]) for r in rows]
    assert told == [
        ("2", "1", "pedestrian", "0", "0.9"),  # the distractor's overlap is the larger
        ("2", "2", "pedestrian", "1", "0.5"),
        ("2", "4", "pedestrian", "1", "1"),
        ("7", "1", "car", "1", "0"),
        ("9", "2", "static_person", "0", "1"),
    ]
    assert [r["iou"] for r in rows] == ["0.0000", "1.0000", "0.3333", "0.6000", "0.0000"]
    assert [float(rows[3][side]) for side in ("left_px", "top_px", "right_px", "bottom_px")] == [
        300, 50, 340, 90,
    ]  # fmt: skip
    tracks = load_tracks(files["out"], needs_state=False)
    np.testing.assert_allclose(tracks.since_s, [np.inf, 1 / 30, 2 / 30, np.inf, np.inf])
    np.testing.assert_array_equal(tracks.detected, [False, True, True, True, False])
    with pytest.raises(PemError, match="the header lacks class_id, truncation"):
        load_table(files["out"])


def test_files_a_sequence_scores_classes_and_a_rate_of_ones_own(files, tmp_path) -> None:
    flat = {"labels": tmp_path / "gt", "detections": tmp_path / "found"}
    oldest = re.sub(r", *1, *[0-9]+, *[0-9.]+\n", ",1,-1,-1,-1\n", GROUND_TRUTH)
    for name, text in (("labels", oldest.replace(",0,8,1", ",0,-1,-1,-1")),
                       ("detections", DETECTIONS)):  # fmt: skip
        flat[name].mkdir()
        (flat[name] / "one.txt").write_text(text)
    counts = collect_mot(
        **flat, out=files["out"], rate_hz=5.0, options=CollectOptions(score_from=0.0)
    )
    rows = rows_of(files["out"])
    assert {(r["sequence"], r["rate_hz"], r["type"], r["visibility"]) for r in rows} == {
        ("one", "5", "pedestrian", "")
    }
    assert (counts.ignored_detections, counts.missed) == (1, 3)
    cars = collect_mot(**files, types=("car",))
    assert (cars.observations, cars.other_types) == (1, 5)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("gt/gt.txt", "2,2,102", "0,2,102", r"gt\.txt:2: column 1 \(frame\) is '0', not a whole"),
        ("gt/gt.txt", "2,2,102", "2,-2,102", r"gt\.txt:2: column 2 \(id\) is '-2', not a whole"),
        ("gt/gt.txt", ",1,3,0", ",1,99,0", r"gt\.txt:4: column 8 \(class\) is '99', allowed: 1 to"),
        ("gt/gt.txt", ",1,3,0", ",1,3,2", r"gt\.txt:4: column 9 \(visibility\) is '2', allowed: 0"),
        ("gt/gt.txt", "40,40", "-40,40", r"gt\.txt:4: column 3 begins a box with a negative side$"),
        (
            "gt/gt.txt",
            "40,40,1,3,0",
            "40",
            r"gt\.txt:4: 5 columns where 7 to 10 are needed: frame,",
        ),
        ("det/det.txt", "0.8", "x", r"det\.txt:2: column 7 \(conf\) is 'x', not a number$"),
        ("det/det.txt", "310", "1e300", r"det\.txt:2: column 3 begins a box beyond any image"),
        ("seqinfo.ini", "30", "fast", r"seqinfo\.ini: needs frameRate, above 0 to 10000, in"),
        ("seqinfo.ini", "[Sequence]", "", r"seqinfo\.ini: needs frameRate"),
        ("det/det.txt", None, None, r"train: no MOTChallenge files \(SEQUENCE/det/det\.txt, or"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(files, capsys, file, old, new, words) -> None:
    path = files["labels"] / "MOT17-02" / file
    if old is None:
        path.unlink()
    else:
        assert old in path.read_text()
        path.write_text(path.read_text().replace(old, new, 1))
    assert_refused(capsys, "motchallenge", files, words)


def test_the_command_tells_what_it_found(files, capsys) -> None:
    path = files["labels"] / "MOT17-02/gt/gt.txt"
    path.write_text(GROUND_TRUTH + "x\n")
    assert collect_command("motchallenge", files, "--skip-bad") == 0
    told = capsys.readouterr()
    assert "own.csv: 1 sequences, 3 tracks, 5 observations, 2 missed, 1 gaps in" in told.out
    assert "1 marked to be ignored" in told.out
    assert "warning: 1 malformed lines skipped" in told.err
    with pytest.raises(PemError, match="'Car' is no class, allowed: pedestrian, person_on_"):
        collect_mot(**files, types=("Car",))
