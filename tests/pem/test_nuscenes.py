"""nuScenes' tables and detections: places, matching and errors with known answers."""

import json
import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pemviz.errors import PemError
from pemviz.files.json_text import CHUNK, json_rows
from pemviz.pem.data.nuscenes import collect_nuscenes
from pemviz.pem.data.position_errors import load_error_csv, sight_errors
from pemviz.pem.data.table import load_table, load_tracks
from pemviz.pem.models.protocol import COLUMN

from .helpers import assert_refused, collect_command, rows_of

EGO_M = (100.0, 200.0, 0.0)
LIDAR_M = (0.94, 0.0, 1.84)
CATEGORIES = ("vehicle.car", "vehicle.bicycle", "vehicle.bus.rigid", "human.pedestrian.adult")
LEVELS = ("v0-40", "v40-60", "v60-80", "v80-100")


def quaternion(rotation):
    x, y, z, w = rotation.as_quat().tolist()
    return [w, x, y, z]


def yaw(degrees):
    return Rotation.from_euler("z", degrees, degrees=True)


NORTH = yaw(90)


def annotation(place, *, who="a", sample="s0", turned=NORTH, visible="4", points=5, **own):
    """A labelled box; a and b are cars, c a bicycle, d a bus, e a person."""
    return {
        "token": f"{who}-{sample}",
        "sample_token": sample,
        "instance_token": who,
        "attribute_tokens": [],
        "visibility_token": visible,
        "translation": list(place),
        "size": [1.8, 4.5, 1.5],
        "rotation": quaternion(turned),
        "num_lidar_pts": points,
        "num_radar_pts": 0,
        **own,
    }


def detection(place, *, name="car", score=0.5, **own):
    """A reported box of the same size."""
    return {
        "sample_token": "s0",
        "translation": list(place),
        "size": [1.8, 4.5, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0],
        "detection_name": name,
        "detection_score": score,
        "attribute_name": "",
        **own,
    }


def write_nuscenes(folder, annotations, results, *, ego=NORTH):
    """One scene of three samples, half a second apart; the ego heads along the global y axis."""
    tables, samples = folder / "v1.0-mini", ("s0", "s1", "s2")
    tables.mkdir()
    kinds = {"a": 0, "b": 0, "c": 1, "d": 2, "e": 3}
    content = {
        "scene": [{"token": "scene", "name": "scene-0061"}],
        "sample": [
            {"token": token, "timestamp": 1_532_402_927_000_000 + 500_000 * index,
             "scene_token": "scene"}
            for index, token in reversed(list(enumerate(samples)))
        ],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP"},
                   {"token": "camera", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {"token": "on-car", "sensor_token": "lidar", "translation": list(LIDAR_M)},
            {"token": "front", "sensor_token": "camera", "translation": [1.7, 0.0, 1.5]},
        ],
        "sample_data": [
            {"token": f"{kind}-{token}-{is_key}", "sample_token": token,
             "ego_pose_token": f"pose-{token}" if is_key and kind == "lidar" else "elsewhere",
             "calibrated_sensor_token": place, "is_key_frame": is_key}
            for token in samples
            for kind, place in (("lidar", "on-car"), ("camera", "front"))
            for is_key in (True, False)
        ],
        "ego_pose": [
            {"token": "elsewhere", "translation": [0, 0, 0], "rotation": [1, 0, 0, 0]},
            *({"token": f"pose-{token}", "translation": list(EGO_M), "rotation": quaternion(ego)}
              for token in samples),
        ],
        "category": [{"token": f"kind-{name}", "name": name} for name in CATEGORIES],
        "attribute": [{"token": "ridden", "name": "cycle.with_rider"}],
        "visibility": [{"token": str(n), "level": level} for n, level in enumerate(LEVELS, 1)],
        "instance": [{"token": who, "category_token": f"kind-{CATEGORIES[kind]}"}
                     for who, kind in kinds.items()],
        "sample_annotation": annotations,
    }  # fmt: skip
    for name, rows in content.items():
        (tables / f"{name}.json").write_text(json.dumps(rows, indent=0))
    submitted = {"meta": {"use_lidar": True}, "results": results}
    (folder / "results.json").write_text(json.dumps(submitted))
    return {"labels": tables, "detections": folder / "results.json", "out": folder / "own.csv"}


def beside(right, ahead, up=0.75):
    """A global place, so far from the lidar (up: from the road) of an ego that heads along y."""
    return (EGO_M[0] + right, EGO_M[1] + ahead + LIDAR_M[0], up)


def test_an_obstacle_is_told_as_kitti_would_from_the_lidar(tmp_path) -> None:
    paths = write_nuscenes(
        tmp_path, [annotation(beside(3.0, 10.0))], {"s0": [detection(beside(3.5, 9.75))]}
    )
    counts = collect_nuscenes(**paths)
    assert (counts.samples, counts.tracks, counts.observations, counts.missed) == (1, 1, 1, 0)
    (row,) = rows_of(paths["out"])
    said = {name: row[name] for name in ("sequence", "frame", "track", "rate_hz", "type")}
    assert said == {
        "sequence": "scene-0061", "frame": "0", "track": "a", "rate_hz": "2", "type": "Car",
    }  # fmt: skip
    wanted = {
        "class_id": 0, "truncation": 0, "occlusion": 0, "height_m": 1.5, "width_m": 1.8,
        "length_m": 4.5, "x_m": 3.0, "y_m": 1.84, "z_m": 10.0, "rotation_y_rad": -math.pi / 2,
        "alpha_rad": -math.pi / 2 - math.atan2(3.0, 10.0), "detected": 1,
        "centre_distance_m": math.hypot(0.5, 0.25), "x_error_m": 0.5, "z_error_m": -0.25,
    }  # fmt: skip
    for name, value in wanted.items():
        assert float(row[name]) == pytest.approx(value, abs=1e-6), name


def test_places_and_headings_of_a_tilted_ego_follow_rotation_matrices(tmp_path) -> None:
    ego = Rotation.from_euler("zyx", [37, 4, -3], degrees=True)
    rng = np.random.default_rng(5)
    inside = rng.uniform((-20, -20, 0), (20, 20, 2), size=(3, 3))
    turned = [Rotation.from_euler("z", angle) for angle in rng.uniform(-3, 3, 3)]
    places = ego.apply(inside) + EGO_M
    labels = [
        annotation(place, sample=f"s{index}", turned=turned[index])
        for index, place in enumerate(places.tolist())
    ]
    paths = write_nuscenes(tmp_path, labels, {"s0": [], "s1": [], "s2": []}, ego=ego)
    collect_nuscenes(**paths)
    salient = load_table(paths["out"]).salient
    seen = inside - LIDAR_M
    np.testing.assert_allclose(salient[:, COLUMN["x_m"]], -seen[:, 1], atol=1e-8)
    np.testing.assert_allclose(salient[:, COLUMN["z_m"]], seen[:, 0], atol=1e-8)
    np.testing.assert_allclose(salient[:, COLUMN["y_m"]], 0.75 - seen[:, 2], atol=1e-8)
    ahead = np.array([(ego.inv() * each).apply([1.0, 0.0, 0.0]) for each in turned])
    in_image = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    in_image /= np.hypot(*in_image.T)[:, None]
    angle = salient[:, COLUMN["rotation_y_rad"]]
    np.testing.assert_allclose(np.stack([np.cos(angle), -np.sin(angle)], 1), in_image, atol=1e-8)


@pytest.mark.parametrize(
    ("reported", "found"),
    [
        ([detection(beside(0, 8.1))], {"a": 1.9}),
        ([detection(beside(2, 10.0))], {}),  # 2 m are not below 2 m
        ([detection(beside(0, 10.0, up=9.0))], {"a": 0.0}),  # heights do not count
        ([detection(beside(0, 10.0), name="truck")], {}),
        # the higher score has the first choice, even where that leaves nothing for the other
        ([detection(beside(0, 10.5), score=0.4), detection(beside(0, 11.2), score=0.9)],
         {"a": 1.2}),
        ([detection(beside(0, 10.5), score=0.9), detection(beside(0, 11.2), score=0.4)],
         {"a": 0.5, "b": 1.8}),
        ([detection(beside(0, 10.1), score=0.9), detection(beside(0, 10.0), score=0.8)],
         {"a": 0.1}),
        ([detection(beside(0, 10.0), score=0.2)], {}),  # below score_from
    ],
)  # fmt: skip
def test_matching_is_greedy_by_score_and_nearest_below_two_metres(
    tmp_path, reported, found
) -> None:
    labels = [annotation(beside(0, 10.0)), annotation(beside(0, 13.0), who="b")]
    paths = write_nuscenes(tmp_path, labels, {"s0": reported})
    counts = collect_nuscenes(**paths, score_from=0.3)
    rows = rows_of(paths["out"])
    distances = {
        row["track"]: float(row["centre_distance_m"]) for row in rows if row["detected"] == "1"
    }
    assert distances == pytest.approx(found, abs=1e-6)
    assert counts.missed == 2 - len(found)


def test_who_is_left_out_and_what_visibility_means(tmp_path) -> None:
    near = {"s0": [], "s2": []}
    labels = [
        annotation(beside(0, 10), visible="1"),
        annotation(beside(0, 10), sample="s1"),  # of a sample that the results do not name
        annotation(beside(1, 11), sample="s2", visible="3"),
        annotation(beside(0, 20), who="b", points=0),
        annotation(beside(0, 51), who="b", sample="s2"),
        annotation(beside(5, 5), who="c"),  # a bicycle without its rider
        annotation(beside(5, 5), who="c", sample="s2", attribute_tokens=["ridden"], visible="2"),
        annotation(beside(9, 9), who="d"),  # a bus
        annotation(beside(9, 9), who="e", visible=""),
    ]
    paths = write_nuscenes(tmp_path, labels, near)
    counts = collect_nuscenes(**paths, drop_unknown=True)
    assert (counts.observations, counts.tracks, counts.missed) == (3, 2, 3)
    left = (counts.other_types, counts.without_points, counts.beyond, counts.dropped)
    assert left == (2, 1, 1, 1)
    table = load_tracks(paths["out"])
    np.testing.assert_array_equal(table.frame, [0, 2, 2])
    np.testing.assert_array_equal(table.obstacles.salient[:, COLUMN["occlusion"]], [2, 1, 2])
    np.testing.assert_array_equal(table.obstacles.salient[:, COLUMN["class_id"]], [0, 0, 5])
    np.testing.assert_allclose(table.since_s, [np.inf, 1.0, np.inf])
    assert collect_nuscenes(**paths, types=("Car",), drop_unknown=True).observations == 2


def test_errors_come_back_as_they_were_put_in_with_who_and_when(tmp_path) -> None:
    rng = np.random.default_rng(11)
    right, ahead = rng.uniform(-15, 15, 240), rng.uniform(5, 35, 240)
    off = rng.normal(0, 0.2, (240, 2))
    labels, results = [], {"s0": [], "s1": [], "s2": []}
    for index, error in enumerate(off.tolist()):
        who, sample = f"car-{index // 3:02}", f"s{index % 3}"
        beyond_range = 100 * (index // 3 % 2)
        place = beside(right[index] + beyond_range, ahead[index])
        labels.append(annotation(place, sample=sample, instance_token=who))
        reported = [place[0] + error[0], place[1] + error[1], place[2]]
        results[sample].append(detection(reported, score=rng.uniform()))
    paths = write_nuscenes(tmp_path, labels, results)
    instances = [{"token": f"car-{n:02}", "category_token": "kind-vehicle.car"} for n in range(80)]
    (paths["labels"] / "instance.json").write_text(json.dumps(instances))
    collect_nuscenes(**paths)
    table = load_error_csv(paths["out"])
    assert len(table) == 120
    near = np.arange(240) // 3 % 2 == 0
    put_in = sight_errors(right[near], ahead[near], x_error_m=off[near, 0], z_error_m=off[near, 1])
    alone = np.abs(table.errors - put_in).max(axis=1) < 1e-5
    assert np.mean(alone) > 0.8  # of the others a neighbour's detection was the nearer
    np.testing.assert_array_equal(table.track, np.arange(120) // 3)
    np.testing.assert_allclose(table.time_s, np.arange(120) % 3 / 2)


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("v1.0-mini/scene.json", None, None, r"scene\.json: no such file; nuScenes' tables"),
        ("v1.0-mini/scene.json", "scene-0061", "a,b", r"scene\.json: 'a,b' must be a name"),
        ("v1.0-mini/sample.json", '"s0"', '"sX"', r"no sample 's0', which has detections$"),
        ("v1.0-mini/sample.json", "]", "", r"sample\.json: the list is cut off$"),
        ("v1.0-mini/sample.json", '"timestamp"', '"time"', r"row 0 lacks 'timestamp'$"),
        ("v1.0-mini/ego_pose.json", "pose-s0", "gone", r"ego_pose\.json: no row 'pose-s0', which"),
        ("v1.0-mini/sample_data.json", "[", "{", r"sample_data\.json: not a JSON list of objects$"),
        ("v1.0-mini/sensor.json", "LIDAR_TOP", "L", r"sample_data\.json: no row 's0', which LIDAR"),
        ("v1.0-mini/sample_annotation.json", "1.8", "-1.8", r"'a-s0': 'size' must be above 0$"),
        ("v1.0-mini/sample_annotation.json", '"4"', '"9"', r"visibility\.json: no row '9', which"),
        ("v1.0-mini/visibility.json", "v80-100", "all", r"'level' is 'all', allowed: v80-100, v60"),
        ("v1.0-mini/instance.json", '"a"', '"z"', r"instance\.json: no row 'a', which .*'a-s0'"),
        ("results.json", '"results"', '"boxes"', r"results\.json: needs 'results', an object"),
        ("results.json", "0.5", '"x"', r"box 0: needs 'detection_name' and the number"),
        ("results.json", "[1.8, 4.5, 1.5]", "[1.8]", r"'s0', box 0: 'size' must be a list of 3"),
        ("results.json", "[1.8, 4.5, 1.5]", "[1, 2, 1e9]", r"'size' must be from -1e\+06 to 1e\+"),
        ("results.json", "[1.0, 0.0, 0.0, 0.0]", "[0, 0, 0, 0]", r"must be a quaternion"),
        ("results.json", "}", "", r"results\.json: .*"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(tmp_path, capsys, file, old, new, words) -> None:
    labels = [annotation(beside(0, 10.0))]
    paths = write_nuscenes(tmp_path, labels, {"s0": [detection(beside(0, 10.0))]})
    if old is None:
        (tmp_path / file).unlink()
    else:
        text = (tmp_path / file).read_text()
        (tmp_path / file).write_text(re.sub(r"(\d),\n", r"\1, ", text).replace(old, new))
    assert_refused(capsys, "nuscenes", paths, words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--iou-above", "0.5"], "iou_above: not with format nuscenes"),
        (["--rate-hz", "5"], "rate_hz: not with format nuscenes"),
        (["--centres-below-m", "0"], "centres_below_m is 0, allowed: above 0"),
        (["--types", "Van"], "'Van' is no class of nuScenes' here, allowed: Car, Truck"),
        (["--format", "kitti", "--centres-below-m", "1"], "only with nuscenes, rosbag, argoverse"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, capsys, options, words) -> None:
    paths = write_nuscenes(tmp_path, [], {"s0": []})
    assert collect_command("nuscenes", paths, *options) == 2
    assert words in capsys.readouterr().err


def test_the_command_tells_what_it_found_and_passes_over_what_is_malformed(
    tmp_path, capsys
) -> None:
    reported = [detection(beside(0, 10.0)), detection(beside(0, 10.0), size=[1.0])]
    labels = [annotation(beside(0, 10.0)), annotation(beside(0, 20), who="b", rotation=[0])]
    paths = write_nuscenes(tmp_path, labels, {"s0": reported})
    assert collect_command("nuscenes", paths, "--skip-bad") == 0
    told = capsys.readouterr()
    assert "own.csv: 1 samples, 1 tracks, 1 observations, 0 missed; left out: 0 of" in told.out
    assert "warning: 2 malformed lines skipped, the first: " in told.err


def test_rows_of_a_table_longer_than_what_is_read_at_a_time_are_those_of_the_whole(
    tmp_path,
) -> None:
    rng = np.random.default_rng(3)
    rows = [
        {"token": f"{n}", "text": "a]},[{" * int(rng.integers(0, 40)), "number": float(number)}
        for n, number in enumerate(rng.normal(size=2000))
    ]
    rows[7]["text"] = "x" * (2 * CHUNK)
    for indent in (None, 0, 3):
        (tmp_path / "rows.json").write_text(json.dumps(rows, indent=indent))
        assert list(json_rows(tmp_path / "rows.json", needs=("token",))) == rows
    (tmp_path / "rows.json").write_text(" [ ] ")
    assert list(json_rows(tmp_path / "rows.json", needs=())) == []
    for text in ("[1]", "[{}", "[{},]", "[{}] 1", "", "{}", "[{} {}]", "[{" + '"a":[' * 100_000):
        (tmp_path / "rows.json").write_text(text)
        with pytest.raises(PemError, match=r"rows\.json: [^\n]*$"):
            list(json_rows(tmp_path / "rows.json", needs=()))


def test_quaternions_are_written_scalar_first() -> None:
    assert quaternion(yaw(90)) == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
