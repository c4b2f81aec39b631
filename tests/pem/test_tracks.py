"""Collecting tracks from KITTI's tracking labels and sequence detections; bad lines."""

import numpy as np
import pytest

from pemviz.pem import PemError, load_table
from pemviz.pem.data.collect import CollectOptions, collect_tracks
from pemviz.pem.data.table import load_tracks
from pemviz.pem.judging.cross_validation import split_folds
from pemviz.pem.models.protocol import COLUMN
from tests.conftest import shared
from tests.pem.helpers import collect_command, rows_of

CAR = (
    "{frame} {track} {type} {truncated} {occluded} 1.55 100 100 200 200 "
    "1.57 1.73 4.15 1.0 1.7 {z} 1.6"
)
MOT = "{frame},100,100,200,190,0.9"
AB3DMOT = "{frame},2,100,100,200,190,7.5,1.5,1.7,4.1,1.0,1.7,13.2,1.6,1.5"


def label(frame, track=3, type="Car", truncated=0, occluded=0, z=13.2):
    return CAR.format(
        frame=frame, track=track, type=type, truncated=truncated, occluded=occluded, z=z
    )


def sequence(tmp_path, labels, detections, name="0000.txt"):
    for folder, lines in (("labels", labels), ("detections", detections)):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_text("\n".join(lines) + "\n")
    return {
        "labels": tmp_path / "labels",
        "detections": tmp_path / "detections",
        "out": tmp_path / "tracks.csv",
    }


def collect_and_load(paths):
    collect_tracks(**paths)
    return load_tracks(paths["out"])


def test_tracks_leave_come_back_and_are_in_order(tmp_path):
    labels = [
        label(4),
        label(0),
        label(1),
        label(1, track=9, z=30.0),
        label(2, occluded=3),
        label(0, track=-1, type="DontCare"),
        label(1, track=7, type="Pedestrian"),
    ]
    detections = [MOT.format(frame=frame) for frame in (0, 4)]
    paths = sequence(tmp_path, labels, detections)
    counts = collect_tracks(**paths, types=("Car",), options=CollectOptions(drop_unknown=True))
    assert (counts.sequences, counts.tracks, counts.observations) == (1, 2, 4)
    assert (counts.missed, counts.other_types, counts.dropped, counts.gaps) == (2, 1, 1, 1)
    tracks = load_tracks(paths["out"])
    np.testing.assert_array_equal(tracks.frame, [0, 1, 4, 1])
    np.testing.assert_array_equal(tracks.detected, [True, False, True, False])
    np.testing.assert_array_equal(tracks.follows, [False, True, True, False])
    np.testing.assert_allclose(tracks.since_s, [np.inf, 0.1, 0.3, np.inf])
    np.testing.assert_array_equal(tracks.missed_before, [False, False, True, False])
    assert tracks.gaps == 1
    np.testing.assert_array_equal(load_table(paths["out"]).detected, tracks.detected)


def test_both_formats_of_detections_give_the_same(tmp_path):
    rows = {}
    for name, line in (("mot", MOT), ("ab3dmot", AB3DMOT)):
        folder = tmp_path / name
        folder.mkdir()
        paths = sequence(folder, [label(0), label(1)], [line.format(frame=1)])
        collect_tracks(**paths, sequence_format=name)
        rows[name] = paths["out"].read_text()
    # 3D boxes have a place: two more columns
    flat = [line.rsplit(",", 2)[0] for line in rows["ab3dmot"].splitlines()]
    assert rows["mot"].splitlines() == flat


def test_scores_below_zero_count_unless_told_otherwise(tmp_path):
    """PointRCNN's scores are logits."""
    paths = sequence(tmp_path, [label(0)], [MOT.format(frame=0).replace("0.9", "-0.4")])
    assert collect_tracks(**paths).missed == 0
    counts = collect_tracks(**paths, options=CollectOptions(score_from=0.0))
    assert (counts.missed, counts.ignored_detections) == (1, 1)


def test_truncation_levels_become_shares_and_persons_sit(tmp_path):
    paths = sequence(tmp_path, [label(0, truncated=1), label(0, track=4, type="Person")], [])
    collect_tracks(**paths)
    salient = load_tracks(paths["out"]).obstacles.salient
    np.testing.assert_array_equal(salient[:, COLUMN["truncation"]], [0.5, 0.0])
    np.testing.assert_array_equal(salient[:, COLUMN["class_id"]], [0.0, 4.0])


@pytest.mark.parametrize(
    ("labels", "detections", "words"),
    [
        (["0 x Car"], [], r"/0000.txt:1: 3 columns where 17 or 18 are needed: frame, tr"),
        ([label(0, track="x")], [], r"0000.txt:1: column 2 \(track\) is 'x'"),
        ([label(0), label("-1")], [], r"0000.txt:2: column 1 \(frame\) is '-1'"),
        ([label(0, truncated=3)], [], r"column 4 \(truncated\) is '3', allowed: 0, 1, 2"),
        ([label(0, occluded=7)], [], r"column 5 \(occluded\) is 7, allowed"),
        ([label(0, z="far")], [], r"column 16 \(z\) is 'far', not a number"),
        ([label(0)], ["0,1,2,3"], r"detections/0000.txt:1: 4 columns where 6 are needed"),
        ([label(0)], ["0,100,100,200,x,1"], r"column 5 \(bottom\) is 'x'"),
        ([label(0)], ["0,200,100,100,190,1"], r"column 2 begins a box with a negative side"),
        ([label(0), label(0)], [], r"track 3 of sequence 0000 is there twice in frame 0"),
    ],
)
def test_malformed_lines_name_file_line_and_column(tmp_path, labels, detections, words):
    paths = sequence(tmp_path, labels, detections)
    with pytest.raises(PemError, match=words) as caught:
        collect_and_load(paths)
    assert "\n" not in str(caught.value)


def test_bad_lines_may_be_counted_and_passed_over(tmp_path):
    paths = sequence(tmp_path, [label(0), "nonsense"], [MOT.format(frame=0), "1,2"])
    counts = collect_tracks(**paths, options=CollectOptions(skip_bad=True))
    assert (counts.observations, counts.bad_lines) == (1, 2)
    assert "0000.txt:2" in counts.first_bad


def test_a_sequence_without_detections_file_is_told(tmp_path):
    paths = sequence(tmp_path, [label(0)], [])
    (paths["detections"] / "0000.txt").unlink()
    with pytest.raises(PemError, match="no detections of this sequence"):
        collect_tracks(**paths)
    assert not paths["out"].exists()


def test_a_table_of_ones_own_needs_a_rate(tmp_path):
    paths = sequence(tmp_path, [label(0), label(1)], [])
    collect_tracks(**paths)
    lines = [line.split(",") for line in paths["out"].read_text().splitlines()]
    without = "\n".join(",".join(cells[:3] + cells[4:]) for cells in lines)
    own = tmp_path / "own.csv"
    own.write_text(without + "\n")
    with pytest.raises(PemError, match="lacks rate_hz; give the rate"):
        load_tracks(own)
    assert load_tracks(own, rate_hz=25.0).since_s[1] == pytest.approx(0.04)


def test_a_table_without_the_state_serves_where_none_is_asked_for(tmp_path):
    own = tmp_path / "own.csv"
    own.write_text("sequence,frame,track,detected\na,0,1,1\na,2,1,0\nb,0,1,0\n")
    tracks = load_tracks(own, rate_hz=10.0, needs_state=False)
    assert not tracks.has_state
    np.testing.assert_array_equal(tracks.detected, [True, False, False])
    np.testing.assert_allclose(tracks.since_s, [np.inf, 0.2, np.inf])
    with pytest.raises(PemError, match=r"own\.csv:1: the header lacks class_id, truncation"):
        load_tracks(own, rate_hz=10.0)
    own.write_text("sequence,frame,track,z_m,detected\na,0,1,9,1\n")
    with pytest.raises(PemError, match=r"own\.csv:1: the header lacks class_id, truncation"):
        load_tracks(own, rate_hz=10.0, needs_state=False)


def test_folds_keep_sequences_of_video_whole(tmp_path):
    labels = [label(frame, track=track) for frame in range(4) for track in (1, 2)]
    detections = [MOT.format(frame=frame) for frame in (0, 2)]
    for name in ("0000.txt", "0001.txt", "0002.txt"):
        paths = sequence(tmp_path, labels, detections, name=name)
    collect_tracks(**paths)
    table = load_table(paths["out"])
    assert table.sequence.tolist() == [0] * 8 + [1] * 8 + [2] * 8
    for train, held_out in split_folds(table, folds=3):
        assert not set(table.sequence[train]) & set(table.sequence[held_out])
    with pytest.raises(PemError, match="folds is 4, allowed: 2 to 3"):
        split_folds(table, folds=4)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("a,x,1,1", r"own.csv:3: column 2 \(frame\) is 'x', not a number"),
        ("a,1,1,yes", r"own.csv:3: column 4 \(detected\) is 'yes', not a number"),
        ("a,1,1,2", "column 'detected' must hold 0 or 1 only"),
        ("a,1.5,1,1", "column 'frame' must hold whole numbers from 0 on"),
        ("a,0,1,1", "track 1 of sequence a is there twice in frame 0"),
        ("a,1,1", "own.csv:3: 3 columns where 4 are needed: sequence, frame, track, detected$"),
    ],
)
def test_a_malformed_table_of_ones_own_is_told_in_one_line(tmp_path, line, words):
    own = tmp_path / "own.csv"
    own.write_text(f"sequence,frame,track,detected\na,0,1,1\n{line}\n")
    with pytest.raises(PemError, match=words) as caught:
        load_tracks(own, rate_hz=10.0, needs_state=False)
    assert "\n" not in str(caught.value)


def test_a_rate_that_changes_within_a_track_is_counted(tmp_path):
    """The time between two frames is that of the later one's rate."""
    own = tmp_path / "own.csv"
    rows = ["a,0,1,10,1", "a,1,1,10,1", "a,2,1,20,0", "a,9,1,20,1"]
    own.write_text("\n".join(["sequence,frame,track,rate_hz,detected", *rows]) + "\n")
    tracks = load_tracks(own, needs_state=False)
    np.testing.assert_allclose(tracks.since_s, [np.inf, 0.1, 0.05, 0.35])
    assert (tracks.rate_changes, tracks.gaps) == (1, 1)


def test_kitti_tracking_is_collected_whole(tmp_path):
    data = shared("kitti_tracking")
    out = tmp_path / "rrc.csv"
    counts = collect_tracks(
        labels=data / "label_02",
        detections=data / "rrc_car",
        out=out,
        types=("Car",),
        options=CollectOptions(iou_above=0.5, drop_unknown=True),
    )
    assert (counts.sequences, counts.tracks, counts.observations) == (19, 489, 22179)
    tracks = load_tracks(out)
    next_frame = tracks.since_s < 0.11
    missed = ~tracks.detected
    # published figures of this detector, with labels of unknown occlusion: 0.79 and 0.021
    assert missed[next_frame & tracks.missed_before].mean() == pytest.approx(0.79, abs=0.02)
    assert missed[next_frame & ~tracks.missed_before].mean() == pytest.approx(0.02, abs=0.005)


@pytest.mark.parametrize("said", [True, False])
def test_a_rate_that_nobody_said_is_said_to_be_assumed(said, tmp_path, capsys):
    paths = sequence(tmp_path, [label(0), label(1)], [MOT.format(frame=0)])
    words = ["--rate-hz", "10"] if said else []
    assert collect_command("mot", paths, *words) == 0
    told = capsys.readouterr().err
    assert ("no file tells the frames a second of 1 sequences: 10 are assumed" in told) != said
    assert {row["rate_hz"] for row in rows_of(paths["out"])} == {"10"}
    assert collect_command("mot", paths, "--rate-hz", "0") == 2
