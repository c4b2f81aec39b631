"""Argoverse 2's feather files to a table: the same cars as in a rosbag give the same."""

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from pemviz.pem.data.argoverse import collect_argoverse
from pemviz.pem.data.rosbag import BagOptions, collect_rosbag
from pemviz.pem.data.table import load_tracks
from pemviz.pem.data.timed_boxes import MatchOptions
from tests.pem.helpers import assert_refused
from tests.pem.ros_files import write_mcap
from tests.pem.test_rosbag import FRAMES, TOPICS, is_seen, place, scene, time_ns

OFF = np.array([0.1, -0.2, 0.0])


def box(frame, at, category="REGULAR_VEHICLE"):
    turn = {"qw": np.cos(0.05), "qx": 0.0, "qy": 0.0, "qz": np.sin(0.05)}
    where = dict(zip(("tx_m", "ty_m", "tz_m"), map(float, at), strict=True))
    size = {"length_m": 4.2, "width_m": 1.8, "height_m": 1.5}
    return {"timestamp_ns": time_ns(frame), "category": category, **where, **turn, **size}


def files(tmp_path, change=lambda truth, found: None):
    """A log's annotations and a submission, as the benchmark's tools write them."""
    truth, found = [], []
    for frame in range(FRAMES):
        for track in range(3):
            at = np.array(place(frame, track))
            follows = {"track_uuid": f"car-{track}", "num_interior_pts": 9}
            truth.append({**box(frame, at), **follows})
            if is_seen(frame, track):
                found.append({**box(frame, at + OFF), "score": 0.9, "log_id": "drive"})
    change(truth, found)
    (tmp_path / "val" / "drive").mkdir(parents=True)
    labels = tmp_path / "val"
    feather.write_feather(pa.Table.from_pylist(truth), labels / "drive" / "annotations.feather")
    detections = tmp_path / "found.feather"
    feather.write_feather(pa.Table.from_pylist(found), detections)
    return {"labels": labels, "detections": detections, "out": tmp_path / "tracks.csv"}


def test_the_same_cars_as_in_a_rosbag_give_the_same_table(tmp_path):
    own = files(tmp_path)
    counts = collect_argoverse(**own, options=MatchOptions())
    assert (counts.sequences, counts.tracks, counts.doubts) == (1, 3, ())
    bag = write_mcap(tmp_path / "drive.mcap", scene())
    other = tmp_path / "bag.csv"
    collect_rosbag(labels=bag, detections=bag, out=other, options=BagOptions(**TOPICS))
    one, again = load_tracks(own["out"]), load_tracks(other)
    np.testing.assert_array_equal(one.detected, again.detected)
    np.testing.assert_allclose(one.obstacles.salient, again.obstacles.salient, atol=1e-9)
    np.testing.assert_array_equal(one.time_s, again.time_s)


def test_a_sweep_of_which_nothing_is_reported_is_missed_and_told(tmp_path):
    def change(truth, found):
        found[:] = [row for row in found if row["timestamp_ns"] != time_ns(7)]

    own = files(tmp_path, change)
    counts = collect_argoverse(**own, options=MatchOptions())
    assert counts.observations == 3 * FRAMES
    missed = sum(not is_seen(f, k) or f == 7 for f in range(FRAMES) for k in range(3))
    assert counts.missed == missed
    assert any("of 1 of 40 labelled sweeps nothing is reported" in each for each in counts.doubts)


def test_boxes_without_points_and_of_other_classes_are_left_out(tmp_path):
    def change(truth, found):
        truth[0]["num_interior_pts"] = 0
        truth[4]["category"] = "BOLLARD"

    counts = collect_argoverse(**files(tmp_path, change), options=MatchOptions())
    assert (counts.dropped, counts.other_types) == (1, 1)
    assert counts.observations == 3 * FRAMES - 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t, f: [row.pop("track_uuid") for row in t], "the header lacks track_uuid"),
        (lambda t, f: t[3].update(qw=0.0, qz=0.0), "row 4: qw begins no quaternion"),
        (lambda t, f: t[3].update(width_m=-1.0), "row 4: length_m or another side is not above 0"),
        (lambda t, f: t[3].update(tx_m=np.nan), "row 4: tx_m is 'nan', allowed"),
        (lambda t, f: [row.update(log_id="x") for row in f], "nothing of log 'drive'"),
        (
            lambda t, f: [row.update(timestamp_ns=row["timestamp_ns"] + 5) for row in f],
            "no sweep has",
        ),
        (lambda t, f: f.clear(), "found.feather:1: the header lacks log_id"),
        (lambda t, f: t.append(t[0]), "'car-0' is there twice"),
        (lambda t, f: [row.update(timestamp_ns=0.5) for row in t], "must hold whole numbers"),
    ],
)
def test_a_damaged_file_is_told_in_one_line(tmp_path, capsys, change, words):
    assert_refused(capsys, "argoverse", files(tmp_path, change), words)


def test_a_file_that_is_none_is_told(tmp_path, capsys):
    own = files(tmp_path)
    own["detections"].write_bytes(b"ARROW1 and then nothing of it")
    assert_refused(capsys, "argoverse", own, "found.feather: not a readable .feather file")
