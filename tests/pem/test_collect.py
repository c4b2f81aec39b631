"""Collecting a table: the sample's known outcomes, the three detection formats, bad lines."""

import json
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pemviz.matching import assign_boxes, iou
from pemviz.pem import PemError, load_table
from pemviz.pem.data.collect import CollectOptions, collect
from pemviz.pem.data.kitti_labels import TYPES
from pemviz.pem.data.position_errors import load_error_csv
from tests.pem.helpers import rows_of, seeds

EXPECTED_COLUMNS = {
    "frame": "frame",
    "type": "type",
    "truncated": "truncation",
    "occluded": "occlusion",
    "alpha_rad": "alpha_rad",
    "dim_h_m": "height_m",
    "dim_w_m": "width_m",
    "dim_l_m": "length_m",
    "loc_x_m": "x_m",
    "loc_y_m": "y_m",
    "loc_z_m": "z_m",
    "rotation_y_rad": "rotation_y_rad",
    "detected": "detected",
}

LABEL = "Car 0.00 0 1.55 100 100 200 200 1.57 1.73 4.15 1.00 1.75 13.22 1.62"
RESULT = "Car -1 -1 -10 100 100 200 190 -1 -1 -1 -1000 -1000 -1000 -10 0.9"


def test_the_kitti_sample_gives_the_known_outcomes(kitti_sample, tmp_path):
    out = tmp_path / "table.csv"
    counts = collect(
        labels=kitti_sample / "label_2", detections=kitti_sample / "detections", out=out
    )
    expected = rows_of(kitti_sample / "expected_outcomes.csv")
    ours = [{old: row[new] for old, new in EXPECTED_COLUMNS.items()} for row in rows_of(out)]

    def in_one_order(rows):
        return sorted(tuple(row.items()) for row in rows)

    # Ours stand in the order of the label files, the expected ones in that of the detections.
    assert in_one_order(ours) == in_one_order(expected)
    assert (counts.frames, counts.obstacles, counts.dropped) == (8, len(expected), 0)


def test_misc_and_unknown_occlusion_are_dropped_and_counted(kitti_sample, tmp_path):
    out = tmp_path / "table.csv"
    counts = collect(
        labels=kitti_sample / "label_2",
        detections=kitti_sample / "detections",
        out=out,
        options=CollectOptions(drop_unknown=True),
    )
    assert counts.dropped == 2
    assert len(load_table(out)) == counts.obstacles == 16


def test_the_same_detections_in_yolo_and_coco_give_the_same_table(kitti_sample, tmp_path):
    sizes = {row["frame"]: row for row in rows_of(kitti_sample / "image_sizes.csv")}
    (tmp_path / "yolo").mkdir()
    results, images = [], []
    for index, file in enumerate(sorted((kitti_sample / "detections").glob("*.txt"))):
        width = float(sizes[file.stem]["width_px"])
        height = float(sizes[file.stem]["height_px"])
        images.append({"id": 70 + index, "file_name": f"training/{file.stem}.png"})
        lines = []
        for line in file.read_text().splitlines():
            cells = line.split()
            left, top, right, bottom = (float(cell) for cell in cells[4:8])
            number = TYPES.index(cells[0])
            centre = ((left + right) / 2 / width, (top + bottom) / 2 / height)
            side = ((right - left) / width, (bottom - top) / height)
            lines.append(" ".join(map(repr, (number, *centre, *side, float(cells[15])))))
            results.append(
                {
                    "image_id": 70 + index,
                    "category_id": number,
                    "bbox": [left, top, right - left, bottom - top],
                    "score": float(cells[15]),
                }
            )
        (tmp_path / "yolo" / file.name).write_text("\n".join(lines))
    categories = [{"id": index, "name": name} for index, name in enumerate(TYPES)]
    coco = {"images": images, "categories": categories, "annotations": results}
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    sources = {"kitti": kitti_sample / "detections", "yolo": tmp_path / "yolo"}
    sources["coco"] = tmp_path / "coco.json"
    tables = {}
    for name, source in sources.items():
        collect(
            labels=kitti_sample / "label_2",
            detections=source,
            out=tmp_path / f"{name}.csv",
            detection_format=name,
            options=CollectOptions(class_aware=True),
            image_sizes=kitti_sample / "image_sizes.csv",
        )
        tables[name] = (tmp_path / f"{name}.csv").read_text()
    assert tables["kitti"] == tables["yolo"] == tables["coco"]


@pytest.fixture
def folders(tmp_path):
    for name in ("labels", "detections"):
        (tmp_path / name).mkdir()
    (tmp_path / "labels" / "000000.txt").write_text(f"{LABEL}\n")
    (tmp_path / "detections" / "000000.txt").write_text(f"{RESULT}\n")
    return tmp_path


def collected(folder, **options):
    return collect(
        labels=folder / "labels",
        detections=folder / "detections",
        out=folder / "out.csv",
        options=CollectOptions(**options),
    )


@pytest.mark.parametrize(
    ("options", "missed"),
    [
        ({}, 0),
        ({"iou_above": 0.89}, 0),
        ({"iou_above": 0.91}, 1),
        ({"class_aware": True}, 0),
        ({"score_from": 0.95}, 1),
    ],
)
def test_threshold_class_and_score(folders, options, missed):
    assert collected(folders, **options).missed == missed


def test_places_of_detections_give_errors_that_position_errors_are_read_from(folders):
    """A second car is seen 2 m too far right and 1.5 m too near, a third is missed."""
    second = LABEL.replace("100 100 200 200", "300 100 400 200").replace("13.22", "20.0")
    third = LABEL.replace("100 100 200 200", "500 100 600 200")
    (folders / "labels" / "000000.txt").write_text(f"{LABEL}\n{second}\n{third}\n")
    seen = [LABEL.replace("1.00 1.75 13.22", "1.25 1.75 13.72") + " 0.9",
            second.replace("1.00 1.75 20.0", "3.00 1.75 18.5") + " 0.8"]  # fmt: skip
    (folders / "detections" / "000000.txt").write_text("\n".join(seen))
    collected(folders)
    rows = rows_of(folders / "out.csv")
    assert [(row["detected"], row["x_error_m"], row["z_error_m"]) for row in rows] == [
        ("1", "0.25", "0.5"), ("1", "2", "-1.5"), ("0", "", ""),
    ]  # fmt: skip
    table = load_error_csv(folders / "out.csv")
    assert table.axes == ("range", "cross_range")
    for row, (x_m, z_m, x_error_m, z_error_m) in enumerate(
        ((1, 13.22, 0.25, 0.5), (1, 20, 2, -1.5))
    ):
        angle = np.arctan2(x_m, z_m)  # the line of sight, turned from straight ahead to the right
        along = x_error_m * np.sin(angle) + z_error_m * np.cos(angle)
        across = x_error_m * np.cos(angle) - z_error_m * np.sin(angle)
        np.testing.assert_allclose(table.errors[row], (along, across), rtol=1e-12)


@pytest.mark.parametrize("place", ["-1 -1 -1 -1000 -1000 -1000", "-1 -1 -1 0 0 0"])
def test_boxes_without_a_place_give_no_columns_of_errors(folders, place):
    result = RESULT.replace("-1 -1 -1 -1000 -1000 -1000", place)
    (folders / "detections" / "000000.txt").write_text(result)
    assert collected(folders).missed == 0
    assert "x_error_m" not in rows_of(folders / "out.csv")[0]


def test_class_awareness_tells_a_van_from_a_car(folders):
    (folders / "detections" / "000000.txt").write_text(RESULT.replace("Car", "Van"))
    assert collected(folders).missed == 0
    assert collected(folders, class_aware=True).missed == 1


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (LABEL.replace("1.57", "tall"), r"000000.txt:2: column 9 \(height\) is 'tall'"),
        (LABEL.replace("Car", "Boat"), r"000000.txt:2: column 1 \(type\) is 'Boat', allowed: Car"),
        (LABEL.replace("13.22", "nan"), r"000000.txt:2: column 14 \(z\) is 'nan'"),
        (LABEL.replace("0.00", "1.50", 1), r"column 2 \(truncated\) is 1.50, allowed: 0 to 1"),
        (LABEL.replace(" 0 ", " 4 ", 1), r"column 3 \(occluded\) is 4"),
        (LABEL.rsplit(" ", 1)[0], "14 columns where 15"),
        (LABEL.replace("200 200", "90 200"), "column 5 begins a box with a negative side"),
    ],
)
def test_a_bad_label_line_is_named_or_skipped_and_counted(folders, bad, words):
    (folders / "labels" / "000000.txt").write_text(f"{LABEL}\n{bad}\n")
    with pytest.raises(PemError, match=words):
        collected(folders)
    assert not (folders / "out.csv").exists()
    counts = collected(folders, skip_bad=True)
    assert (counts.obstacles, counts.bad_lines) == (1, 1)


def test_a_bad_detection_line_is_named(folders):
    (folders / "detections" / "000000.txt").write_text(RESULT.replace("0.9", "high"))
    with pytest.raises(PemError, match=r"000000.txt:1: column 16 \(score\) is 'high'"):
        collected(folders)


def test_a_frame_without_detections_file_is_refused_unless_allowed(folders):
    (folders / "detections" / "000000.txt").unlink()
    with pytest.raises(PemError, match="no detections of this frame"):
        collected(folders)
    out = folders / "out.csv"
    counts = collect(
        labels=folders / "labels", detections=folders / "detections", out=out, missing_is_empty=True
    )
    assert counts.missed == 1


def random_boxes(rng, count):
    corner = rng.uniform(0, 50, (count, 2))
    return np.concatenate([corner, corner + rng.uniform(1, 50, (count, 2))], axis=1)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(seed=seeds, true=st.integers(0, 4), found=st.integers(0, 5))
def test_matching_finds_the_largest_total_overlap(seed, true, found):
    rng = np.random.default_rng(seed)
    first, second = random_boxes(rng, true), random_boxes(rng, found)
    ours = assign_boxes([tuple(row) for row in first], [tuple(row) for row in second])[0]
    overlap = iou(first, second)
    if true <= found:
        orders = permutations(range(found), true)
        best = max(sum(overlap[row, col] for row, col in enumerate(order)) for order in orders)
    else:
        orders = permutations(range(true), found)
        best = max(sum(overlap[row, col] for col, row in enumerate(order)) for order in orders)
    assert ours.sum() == pytest.approx(best, abs=1e-12)


def test_overlap_of_boxes_by_hand():
    first = np.array([[0.0, 0, 2, 2], [5, 5, 5, 5]])
    second = np.array([[1.0, 1, 3, 3], [5, 5, 5, 5], [0, 0, 2, 2]])
    np.testing.assert_allclose(iou(first, second), [[1 / 7, 0, 1], [0, 0, 0]])
