"""Two topics of a rosbag to a table: boxes met in time and place, by bags that others wrote."""

import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from pemviz.cli.main import main
from pemviz.pem.data.rosbag import BagOptions, collect_rosbag
from pemviz.pem.data.table import load_tracks
from pemviz.pem.models.protocol import COLUMN
from tests.pem.helpers import assert_refused, rows_of
from tests.pem.ros_files import (
    detection_2d,
    detection_3d,
    header,
    pose,
    tracked_object,
    write_mcap,
    write_rosbag2,
)

ARRAY = "vision_msgs/Detection3DArray"
FRAMES = 40
TOPICS = {"labels_topic": "/truth", "detections_topic": "/found"}
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000


def time_ns(frame):
    return START_NS + frame * STEP_NS


def place(frame, track):
    return (12.0 + 6.0 * track + 0.4 * frame, 3.5 * track - 3.5, 0.75)


def is_seen(frame, track):
    return (frame + track) % 4 != 0


def array(at_ns, boxes, frame="base_link"):
    return (at_ns, {"header": header(at_ns, frame), "detections": boxes})


def scene(*, late_ns=0, off=(0.1, -0.2), shift=0, every=1, frame="base_link"):
    """Three cars that drive away, reported a little off in three frames of four."""
    truth, found = [], []
    for number in range(FRAMES):
        at = time_ns(number)
        boxes = [
            detection_3d(at, place(number, track), 0.1, who=f"car-{track}") for track in range(3)
        ]
        truth.append(array(at, boxes))
        at += late_ns
        seen = []
        for track in range(3):
            x, y, z = place(number - shift, track)
            if is_seen(number - shift, track):
                seen.append(detection_3d(at, (x + off[0], y + off[1], z), 0.1, frame=frame))
        if number % every == 0:
            found.append(array(at, seen, frame))
    return {"/truth": (ARRAY, truth), "/found": (ARRAY, found)}


def written(tmp_path, topics, **options):
    bag = write_mcap(tmp_path / "drive.mcap", topics)
    files = {"labels": bag, "detections": bag, "out": tmp_path / "tracks.csv"}
    return files, collect_rosbag(**files, options=BagOptions(**TOPICS, **options))


def test_boxes_of_two_topics_meet_in_time_and_place(tmp_path):
    files, counts = written(tmp_path, scene(late_ns=5_000_000))
    assert (counts.moments, counts.alone, counts.tracks) == (FRAMES, 0, 3)
    assert counts.doubts == ()
    tracks = load_tracks(files["out"])
    assert len(tracks) == 3 * FRAMES
    expected = [is_seen(frame, track) for track in range(3) for frame in range(FRAMES)]
    np.testing.assert_array_equal(tracks.detected, expected)
    np.testing.assert_allclose(tracks.since_s[tracks.follows], 0.1, atol=1e-6)
    salient = tracks.obstacles.salient
    truth = np.array([place(frame, track) for track in range(3) for frame in range(FRAMES)])
    np.testing.assert_allclose(salient[:, COLUMN["z_m"]], truth[:, 0])
    np.testing.assert_allclose(salient[:, COLUMN["x_m"]], -truth[:, 1])
    np.testing.assert_allclose(salient[:, COLUMN["y_m"]], 0.0, atol=1e-9)
    np.testing.assert_allclose(salient[:, COLUMN["rotation_y_rad"]], -np.pi / 2 - 0.1, rtol=1e-8)
    sizes = salient[:, [COLUMN[name] for name in ("length_m", "width_m", "height_m")]]
    np.testing.assert_array_equal(sizes, np.tile((4.2, 1.8, 1.5), (len(tracks), 1)))
    hit = next(row for row in rows_of(files["out"]) if row["detected"] == "1")
    errors = [float(hit[name]) for name in ("x_error_m", "z_error_m", "centre_distance_m")]
    np.testing.assert_allclose(errors, [0.2, 0.1, np.hypot(0.2, 0.1)], rtol=1e-5)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_folder_of_ros_2_gives_the_same(tmp_path, storage):
    files, _ = written(tmp_path, scene())
    text = files["out"].read_text()
    bag = write_rosbag2(tmp_path / "folder" / "drive", scene(), storage=storage)
    for path in (bag, bag.parent):
        counts = collect_rosbag(
            labels=path, detections=path, out=files["out"], options=BagOptions(**TOPICS)
        )
        assert counts.sequences == 1
        assert files["out"].read_text() == text


def test_autoware_s_objects_on_a_map_are_turned_into_the_ego_s_frame(tmp_path):
    """The ego drives a circle; seen from it the cars are where they are in its own frame."""
    truth, found, ego = [], [], []
    for number in range(FRAMES):
        at, yaw = time_ns(number), 0.05 * number
        origin = np.array([100.0 + 2.0 * number, -50.0 + number, 3.0])
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        on_map = [origin + turn @ np.array(place(number, track)) for track in range(3)]
        head = header(at, "map")
        objects = [tracked_object(on_map[k], yaw + 0.1, who=k + 1) for k in range(3)]
        seen = [one for k, one in enumerate(objects) if is_seen(number, k)]
        truth.append((at, {"header": head, "objects": objects}))
        found.append((at, {"header": head, "objects": seen}))
        ego.append((at, {"header": head, "pose": pose(origin, yaw)}))
    kind = "autoware_perception_msgs/TrackedObjects"
    topics = {"/truth": (kind, truth), "/found": (kind, found)}
    topics["/ego"] = ("geometry_msgs/PoseStamped", ego)
    files, _ = written(tmp_path, topics, ego_topic="/ego")
    own = load_tracks(files["out"]).obstacles.salient
    files, _ = written(tmp_path, scene())
    np.testing.assert_allclose(own, load_tracks(files["out"]).obstacles.salient, atol=1e-6)


def test_boxes_in_an_image_make_a_table_for_memory(tmp_path, capsys):
    truth, found = [], []
    for number in range(FRAMES):
        at = time_ns(number)
        boxes = [detection_2d(at, 100.0 * k + number, 50.0, who=str(k)) for k in range(3)]
        truth.append(array(at, boxes, "camera"))
        seen = [box for k, box in enumerate(boxes) if is_seen(number, k)]
        found.append(array(at, seen, "camera"))
    kind = "vision_msgs/Detection2DArray"
    files, counts = written(tmp_path, {"/truth": (kind, truth), "/found": (kind, found)})
    assert counts.missed == sum(not is_seen(f, k) for f in range(FRAMES) for k in range(3))
    assert load_tracks(files["out"], needs_state=False).has_state is False


def test_one_message_of_detections_serves_one_moment(tmp_path):
    """Else a miss of a slower detector would count twice, and misses seem to follow each other."""
    _, counts = written(tmp_path, scene(every=2), time_tolerance_s=0.15)
    assert (counts.moments, counts.alone) == (FRAMES // 2, FRAMES // 2)
    assert any("20 of 40 labelled moments have no detections" in each for each in counts.doubts)


def test_a_clock_that_is_late_and_a_frame_that_is_are_told(tmp_path):
    _, counts = written(tmp_path, scene(late_ns=30_000_000))
    assert any("0.03 s later than those of labels" in doubt for doubt in counts.doubts)
    _, counts = written(tmp_path, scene(off=(0.0, 0.0), shift=1))
    assert any("detections seem 1 frame late" in doubt for doubt in counts.doubts)


def test_from_a_bag_to_an_error_model(tmp_path, capsys):
    bag = write_mcap(tmp_path / "drive.mcap", scene())
    table, out = tmp_path / "tracks.csv", tmp_path / "own.safetensors"
    words = ["--labels", str(bag), "--detections", str(bag), "--format", "rosbag"]
    words += ["--labels-topic", "/truth", "--detections-topic", "/found", "--out", str(table)]
    assert main(["pem", "collect", *words]) == 0
    assert "1 logs, 40 moments, 3 tracks, 120 observations, 30 missed" in capsys.readouterr().out
    fit = ["--table", str(table), "--model", "lr", "--folds", "0", "--out", str(out)]
    assert main(["pem", "fit", *fit]) == 0


def cut(bag):
    bag.write_bytes(bag.read_bytes()[:3000])


def garbled(bag):
    content = bytearray(bag.read_bytes())
    content[200:260] = bytes(60)
    bag.write_bytes(bytes(content))


def remade(**options):
    return lambda bag: write_mcap(bag, scene(**options))


def with_message(change):
    def make(bag):
        topics = scene()
        change(topics["/truth"][1][5][1], topics)
        write_mcap(bag, topics)

    return make


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut, "drive.mcap: not a readable rosbag"),
        (garbled, "drive.mcap: not a readable rosbag"),
        (lambda bag: bag.write_bytes(b""), "drive.mcap: not a readable rosbag"),
        (lambda bag: shutil.move(bag, bag.with_suffix(".txt")), "no rosbag"),
        (remade(late_ns=3_000_000_000_000), "the nearest are .* s away .* two clocks"),
        (remade(frame="lidar"), "the frames 'base_link' and 'lidar'; both topics must be in one"),
        (with_message(lambda m, t: m["header"].update(header(0, "base_link"))), "no time stamp"),
        (
            with_message(lambda m, t: t["/truth"][1].append(t["/truth"][1][5])),
            "stamp of another",
        ),
        (
            with_message(lambda m, t: m["detections"].append(m["detections"][0])),
            "'car-0' is there",
        ),
        (with_message(lambda m, t: m["header"].update(frame_id="map")), "ego_topic must say where"),
        (
            with_message(lambda m, t: m["detections"][0]["bbox"]["size"].update(x=-1.0)),
            "size is",
        ),
        (with_message(lambda m, t: t.pop("/found")), "'/found' is not in it, allowed: /truth"),
    ],
)
def test_a_damaged_bag_is_told_in_one_line(tmp_path, capsys, damage, words):
    bag = write_mcap(tmp_path / "drive.mcap", scene())
    damage(bag)
    files = {"labels": bag, "detections": bag, "out": tmp_path / "tracks.csv"}
    files |= {"labels-topic": "/truth", "detections-topic": "/found"}
    assert_refused(capsys, "rosbag", files, words)


def test_sizes_in_centimetres_are_told(tmp_path, capsys):
    topics = scene()
    for _, message in topics["/truth"][1]:
        for box in message["detections"]:
            box["bbox"]["size"] = {"x": 420.0, "y": 180.0, "z": 150.0}
    bag = write_mcap(tmp_path / "drive.mcap", topics)
    files = {"labels": bag, "detections": bag, "out": tmp_path / "tracks.csv"}
    files |= {"labels-topic": "/truth", "detections-topic": "/found"}
    assert_refused(capsys, "rosbag", files, "in centimetres it would be 1.5 m")


def test_without_the_package_a_line_says_what_to_install(tmp_path, capsys, monkeypatch):
    bag = write_mcap(tmp_path / "drive.mcap", scene())
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    files = {"labels": bag, "detections": bag, "out": tmp_path / "tracks.csv"}
    files |= {"labels-topic": "/truth", "detections-topic": "/found"}
    assert_refused(capsys, "rosbag", files, r"pip install 'pemviz\[logs\]'")
