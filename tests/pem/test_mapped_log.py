"""A log by a mapping of its columns: units, constants, two files, and what is wrong with them."""

import json
import math

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet

from pemviz.cli.main import main
from pemviz.files.shipped import asset_path
from pemviz.pem.data.log_batches import log_batches
from pemviz.pem.data.log_mapping import read_mapping
from pemviz.pem.data.mapped_log import collect_log
from pemviz.pem.data.table import load_table, load_tracks
from pemviz.pem.models.protocol import COLUMN
from tests.pem.helpers import assert_refused

MAPPING = """
[labels]
separator = ";"
[detections]
separator = "whitespace"
header = ["seen", "err"]
[columns]
class_id = { column = "what", values = { car = 0, van = 1 } }
truncation = 0.25
occlusion = 1
height_m = 1.5
width_m = 1.8
length_m = 4.5
x_m = { column = "left cm", times = -0.01 }
y_m = 1.6
z_m = { column = "ahead", plus = -0.5 }
rotation_y_rad = "turned"
detected = { column = "seen", values = { yes = 1, no = 0 } }
z_error_m = "err"
x_error_m = 0.0
sequence = "drive"
frame = "frame"
track = "id"
rate_hz = 20
"""
LABELS = """drive;frame;id;what;left cm;ahead;turned
d1;0;7;car;-300;4.5;0.5

d1;1;7;van;200;10.5;-1.5
d2;0;7;car;0;20.5;3.1
"""
DETECTIONS = "# seen err\nyes 0.25\nno -\nyes -0.5\n"


@pytest.fixture
def log(tmp_path):
    files = {"labels": LABELS, "detections": DETECTIONS, "mapping": MAPPING}
    paths = {name: tmp_path / f"{name}.txt" for name in files}
    for name, path in paths.items():
        path.write_text(files[name], encoding="utf-8")
    return {**paths, "out": tmp_path / "own.csv"}


def test_units_constants_and_files_side_by_side(log) -> None:
    counts = collect_log(**log)
    assert (counts.obstacles, counts.missed) == (3, 1)
    table = load_table(log["out"])
    column = {name: table.salient[:, place] for name, place in COLUMN.items()}
    np.testing.assert_array_equal(table.detected, [True, False, True])
    np.testing.assert_array_equal(column["class_id"], [0, 1, 0])
    np.testing.assert_allclose(column["x_m"], [3.0, -2.0, 0.0])
    np.testing.assert_allclose(column["z_m"], [4.0, 10.0, 20.0])
    alpha = [0.5 - math.atan2(3.0, 4.0), -1.5 + math.atan2(2.0, 10.0), 3.1]
    np.testing.assert_allclose(column["alpha_rad"], alpha, rtol=0, atol=1e-9)
    errors = [line.split(",")[-2:] for line in log["out"].read_text().splitlines()[1:]]
    assert errors == [["0", "0.25"], ["", ""], ["0", "-0.5"]]
    tracks = load_tracks(log["out"])
    assert len(np.unique(tracks.track)) == 2


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("mapping", "occlusion = 1\n", "", r"columns: lacks occlusion$"),
        ("mapping", "truncation", "truncated", r"columns: lacks truncation$"),
        ("mapping", "x_m =", "xx = 1\nx_m =", r"columns\.xx: must be one of class_id, "),
        ("mapping", "times = -0.01", 'times = "x"', r"columns\.x_m\.times"),
        ("mapping", "rate_hz = 20", "", "all or none .* here sequence, track, frame$"),
        ("mapping", '";"', '"|"', r"labels\.separator"),
        ("mapping", "[columns]", "[colums]", r"colums: must be labels, detections or columns$"),
        ("mapping", "[columns]", "[columns", "mapping.txt: .*line"),
        ("mapping", '"left cm"', '"left"', r"labels\.txt:2: no column 'left', there are: drive"),
        ("labels", "van", "bus", r"labels\.txt:4: what, for class_id, is 'bus', allowed: one of c"),
        ("labels", "200", "inf", r"labels\.txt:4: left cm, for x_m, is 'inf', allowed: a number$"),
        ("labels", ";7;car;0", ";car;0", r"labels\.txt:5: 6 columns where 7 are needed: "),
        ("mapping", "occlusion = 1", "occlusion = 5", r"labels\.txt:2: occlusion is 5, allowed: 0"),
        ("detections", "no -\n", "", r"detections\.txt: 2 rows, but 3 in .*labels\.txt$"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(log, capsys, name, old, new, words) -> None:
    text = log[name].read_text()
    assert old in text
    log[name].write_text(text.replace(old, new))
    assert_refused(capsys, "log", log, words)


def test_malformed_rows_are_passed_over_if_asked(log) -> None:
    log["labels"].write_text(LABELS.replace("van", "bus"))
    counts = collect_log(**log, skip_bad=True)
    assert (counts.obstacles, counts.bad_lines) == (2, 1)


def test_a_mapping_goes_with_format_log_alone(log, capsys) -> None:
    given = [word for key, path in log.items() for word in (f"--{key}", str(path))]
    assert main(["pem", "collect", *given]) == 2
    assert "mapping: must be given with format log" in capsys.readouterr().err


def test_the_shipped_mapping_is_one() -> None:
    plan = read_mapping(asset_path("mappings", "nuscenes-cars.toml"))
    assert plan.labels.header[-1] == "visibility"


def test_stated_units_are_converted(log) -> None:
    text = MAPPING.replace(
        'z_m = { column = "ahead", plus = -0.5 }', 'z_m = { column = "ahead", unit = "ft" }'
    ).replace('x_m = { column = "left cm", times = -0.01 }',
              'x_m = { column = "left cm", unit = "cm", times = -1 }')  # fmt: skip
    log["mapping"].write_text(text)
    collect_log(**log)
    salient = load_table(log["out"]).salient
    np.testing.assert_allclose(salient[:, COLUMN["x_m"]], [3.0, -2.0, 0.0])
    np.testing.assert_allclose(salient[:, COLUMN["z_m"]], np.array([4.5, 10.5, 20.5]) * 0.3048)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("mapping", MAPPING.replace('"ahead", plus', '"ahead", unit = "kg", plus'), "z_m.unit"),
        ("mapping", MAPPING.replace('= "frame"', '= { column = "frame", unit = "s" }'), "left out"),
        ("labels", "", r"labels\.txt: no rows"),
        ("labels", LABELS.splitlines()[0], r"labels\.txt: no rows"),
        ("labels", LABELS.replace(";", ","), "labels.txt:1: columns are separated by commas, not"),
        ("labels", LABELS.replace("d1;1;7", "d1;0;7"), r"labels\.txt:4: track 7 of sequence d1 is"),
        ("labels", LABELS.replace("d1;1;7", "d1;1.5;7"), "labels.txt:4: frame is 1.5, allowed"),
    ],
)
def test_what_would_be_wrong_without_a_word_is_refused(log, capsys, name, content, words) -> None:
    log[name].write_text(content)
    assert_refused(capsys, "log", log, words)


def test_a_log_may_begin_with_a_byte_order_mark(log) -> None:
    log["labels"].write_bytes(LABELS.encode("utf-8-sig"))
    assert collect_log(**log).obstacles == 3


def in_other_form(log, form):
    """The log's two files as one of another form."""
    labels = [line.split(";") for line in LABELS.split("\n") if line]
    found = [line.split() for line in DETECTIONS.splitlines()[1:]]
    names, rows = [*labels[0], "seen", "err"], []
    for own, other in zip(labels[1:], found, strict=True):
        cells = dict(zip(names, [*own, *other], strict=True))
        for number in ("frame", "id", "left cm", "ahead", "turned"):
            cells[number] = float(cells[number])
        cells["err"] = None if cells["err"] == "-" else float(cells["err"])
        rows.append(cells)
    path = log["labels"].with_suffix(f".{form}")
    if form == "jsonl":
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    else:
        write = parquet.write_table if form == "parquet" else feather.write_feather
        write(pa.Table.from_pylist(rows), path)
    return {**log, "labels": path, "detections": path}


@pytest.mark.parametrize("form", ["jsonl", "parquet", "arrow"])
def test_other_forms_of_the_same_log_give_the_same_table(log, form) -> None:
    collect_log(**log)
    text = log["out"].read_text()
    collect_log(**in_other_form(log, form))
    assert log["out"].read_text() == text
    whole = {**log, "out": log["out"].with_suffix(".parquet")}
    collect_log(**whole)
    assert load_table(whole["out"]).digest == load_table(log["out"]).digest


def test_batches_do_not_show(log, monkeypatch) -> None:
    collect_log(**log)
    text = log["out"].read_text()
    monkeypatch.setattr("pemviz.pem.data.mapped_log.log_batches", _small_batches)
    collect_log(**log)
    assert log["out"].read_text() == text


def _small_batches(labels, detections, *, wanted):
    return log_batches(labels, detections, wanted=wanted, rows=2)
