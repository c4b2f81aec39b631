"""Tables and files of position errors, what is shipped, and the commands that make and show it."""

import json

import numpy as np
import pytest
from safetensors.numpy import save_file

from pemviz.cli.pem import fit, show
from pemviz.files.shipped import asset_path
from pemviz.pem import (
    PemError,
    load_pem,
    load_position_errors,
    save_position_errors,
    shipped_position_errors,
)
from pemviz.pem.data.collect import collect_tracks
from pemviz.pem.data.position_errors import load_error_csv, load_error_table, load_nuscenes_errors
from pemviz.pem.judging.position_error_report import straight_ahead
from pemviz.pem.model_files import POSITION_METADATA_KEY, read_tensors
from pemviz.pem.models.cards import position_card_markdown
from studies.shipped_models.position_errors import NAMES, shipped_table
from tests.conftest import shared
from tests.pem.test_position_errors import MODEL, drawn_table

HEADER = "sequence,frame,track,rate_hz,x_m,z_m,alpha_rad,detected,range_error_m,cross_range_error_m"
ROW = "a,0,1,10,0,20,-1.57,1,0.5,-0.25"


def own_table(folder, *lines, header=HEADER):
    path = folder / "own.csv"
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def test_a_table_of_ones_own_is_read(tmp_path):
    missed = "a,1,1,10,0,19,-1.57,0,,"
    path = own_table(tmp_path, ROW, missed, "b,7,1,10,3,4,0.1,1,0.1,0.2")
    table = load_error_csv(path)
    assert table.errors.tolist() == [[0.5, -0.25], [0.1, 0.2]]
    assert table.distance_m.tolist() == [20.0, 5.0]
    assert table.sequence.tolist() == [0, 1] == table.track.tolist()
    np.testing.assert_allclose(table.time_s, [0.0, 0.7])
    header = "x_m,z_m,rotation_y_rad,x_error_m,z_error_m,speed_error_mps"
    path = own_table(tmp_path, "3,4,1.0,0.5,0.0,2.5", header=header)
    table = load_error_csv(path)
    assert table.axes == ("range", "cross_range", "speed")
    np.testing.assert_allclose(table.errors, [[0.3, 0.4, 2.5]])
    np.testing.assert_allclose(table.alpha_rad, [1.0 - np.arctan2(3.0, 4.0)])
    assert table.sequence is table.track is table.time_s is None


@pytest.mark.parametrize(
    ("line", "header", "words"),
    [
        ("1,2,3", "z_m,range_error_m,cross_range_error_m", "1: the header lacks x_m"),
        ("1,2,3", "x_m,z_m,range_error_m", "lacks range_error_m and cross_range_error_m"),
        (ROW.replace("0.5", "far"), HEADER, r"own.csv:2: column 9 \(range_error_m\) is 'far'"),
        (ROW.replace("0.5", "nan"), HEADER, "'nan', allowed: a number from -10000 to 10000"),
        (ROW.replace("0.5", "1e9"), HEADER, "'1e9', allowed"),
        (ROW.replace(",1,0.5", ",2,0.5"), HEADER, r"\(detected\) is '2', allowed: 0, 1"),
        (ROW.replace(",1,0.5", ",0,0.5"), HEADER, "no rows of detected obstacles"),
        (ROW.replace("0,20", "0,0"), HEADER, "at the sensor's own place"),
        (ROW.replace("1,10", "1,0"), HEADER, "'rate_hz' must be above 0"),
        (f"{ROW}\n{ROW}", HEADER, "twice in one frame"),
    ],
)
def test_a_malformed_table_is_told_in_one_line(tmp_path, line, header, words):
    with pytest.raises(PemError, match=words) as caught:
        load_error_csv(own_table(tmp_path, line, header=header))
    assert "\n" not in str(caught.value)


def test_nuscenes_cars_are_read_with_the_sign_turned(tmp_path):
    """A car 45 degrees off the axes is taken, one along an axis is not, nor is a missed one."""
    (tmp_path / "salient_inputs.txt").write_text(
        "# format\n0 20 0.785398 4.5 1.9 1.5 4\n0 20 1.571 4.5 1.9 1.5 4\n9 9 0.8 4 1.9 1.5 1\n"
    )
    (tmp_path / "salient_labels.txt").write_text(
        "1 -0.25 -0.5 0.01\n1 0.1 0.1 0\n0 -1000 -1000 -1000\n"
    )
    table = load_error_table(tmp_path)
    np.testing.assert_allclose(table.errors, [[0.5, 0.25]])
    np.testing.assert_allclose(table.alpha_rad, [-0.785398])
    (tmp_path / "salient_inputs.txt").write_text("0 0 0 0 0 0 0 0 0 0 0\n")
    with pytest.raises(PemError, match="no folder of nuScenes cars"):
        load_error_table(tmp_path)


def test_nuscenes_cars_are_followed(tmp_path):
    """Two cars of different size seen in turn, then one of the first's size far away: another."""
    rows = ["0 20 0.8 4.5 1.9 1.5 4", "9 9 0.8 4.2 1.8 1.5 4", "0 21 0.8 4.5 1.9 1.5 4",
            "0 90 0.8 4.5 1.9 1.5 4"]  # fmt: skip
    (tmp_path / "salient_inputs.txt").write_text("\n".join(rows) + "\n")
    (tmp_path / "salient_labels.txt").write_text("1 0 0 0\n" * 4)
    table = load_nuscenes_errors(tmp_path)
    assert table.track[0] == table.track[2]
    assert len(set(table.track.tolist())) == 3
    np.testing.assert_allclose(table.time_s, [0.0, 0.0, 0.5, 0.0])
    assert table.sequence.tolist() == [0, 0, 0, 1]


def test_detections_with_a_place_give_columns_of_errors(tmp_path):
    for folder in ("labels", "boxes"):
        (tmp_path / folder).mkdir()
    line = "{} 1 Car 0 0 -1.6 100 100 200 200 1.5 1.6 4 {} 1.7 20 -1.5\n"
    (tmp_path / "labels" / "0000.txt").write_text(line.format(0, 2) + line.format(1, 2))
    (tmp_path / "boxes" / "0000.txt").write_text(
        "0,2,100,100,200,200,9,1.5,1.6,4,2.5,1.7,19,-1.5,-1.6\n"
    )
    out = tmp_path / "tracks.csv"
    collect_tracks(
        labels=tmp_path / "labels",
        detections=tmp_path / "boxes",
        out=out,
        sequence_format="ab3dmot",
    )
    header, found, missed = (line.split(",") for line in out.read_text().splitlines())
    assert header[-2:] == ["x_error_m", "z_error_m"]
    assert (found[-2:], missed[-2:]) == (["0.5", "-1"], ["", ""])
    assert load_error_csv(out).errors.shape == (1, 2)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_shipped_says_what_it_rests_on(name, tmp_path):
    model = load_position_errors(name)
    file = asset_path("position_errors", f"{name}.safetensors")
    page = file.with_suffix(".md").read_text()
    assert page == position_card_markdown(model.card, digest=model.digest)
    assert "CC BY-NC-SA" in model.card.licence
    assert "count as misses" in page or "trained on images of the same drives" in page
    for axis in model.card.report["axes"]:
        assert axis["nats"]["student-t"] < axis["nats"]["gaussian"] < axis["nats"]["constant"]
    near, far = (model.half_width(straight_ahead(at))[0] for at in (10.0, 60.0))
    assert (far > near).all()
    again = tmp_path / "again.safetensors"
    save_position_errors(model, again)
    assert again.read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", NAMES)
def test_its_data_are_those_of_the_table(name):
    table = shipped_table(shared("nuscenes_pointpillars").parent, name)
    card = load_position_errors(name).card
    assert (card.data_digest, card.report["rows"]) == (table.digest, len(table))
    shares = [np.count_nonzero(np.abs(table.errors[:, place])
              > 4 * axis["distances"][-1]["sd"]) / len(table)
              for place, axis in enumerate(card.report["axes"])]  # fmt: skip
    assert max(shares) < 0.01


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "does not say 'version' 1"),
        ({"axes": ["range", "sideways"]}, "'sideways.mean' is missing"),
        ({"axes": ["cross_range", "range"]}, "kinds of error are"),
        ({"card": {}}, "metadata has unknown"),
        ({"card": {**dict.fromkeys(("name", "data", "data_digest", "licence", "recipe"), ""),
                   "report": {"axes": 3}}}, "its report is not as pemviz writes it"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_line(tmp_path, change, words):
    tensors, metadata = read_tensors(asset_path("position_errors", "pointpillars.safetensors"))
    header = json.loads(metadata[POSITION_METADATA_KEY]) | change
    path = tmp_path / "damaged.safetensors"
    save_file(tensors, path, metadata={POSITION_METADATA_KEY: json.dumps(header)})
    with pytest.raises(PemError, match=words) as caught:
        load_position_errors(str(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_models_of_misses_and_of_positions_are_told_apart(tmp_path):
    with pytest.raises(PemError, match="no model of position errors"):
        load_position_errors(str(asset_path("pem", "rrc.safetensors")))
    with pytest.raises(PemError, match="give one of pointpillars, pointrcnn"):
        load_position_errors("yolo")
    own = tmp_path / "own.safetensors"
    save_position_errors(MODEL, own)
    with pytest.raises(PemError, match=r"own\.safetensors: no 'pemviz-pem' metadata"):
        load_pem(str(own))
    assert shipped_position_errors() == ("pointpillars", "pointrcnn")


def drawn_csv(folder):
    table = drawn_table(tracks=60)
    columns = zip(table.sequence, table.time_s * 5, table.track, table.x_m, table.z_m,
                  table.alpha_rad, *table.errors.T, strict=True)  # fmt: skip
    header = "sequence,frame,track,x_m,z_m,alpha_rad,range_error_m,cross_range_error_m"
    return own_table(folder, *(",".join(f"{v:.9g}" for v in row) for row in columns), header=header)


def test_fit_and_show(tmp_path, capsys):
    out, picture = tmp_path / "own.safetensors", tmp_path / "own.png"
    arguments = fit.FitArguments(drawn_csv(tmp_path), out, position_errors=True, rate_hz=5.0)
    assert fit.run(arguments) == 0
    assert "held out, an error costs" in capsys.readouterr().out
    assert load_position_errors(str(out)).digest == json.loads(
        out.with_suffix(".json").read_text()
    )["digest"]  # fmt: skip
    assert "nearer in time" in out.with_suffix(".md").read_text().lower()
    assert show.run(show.ShowArguments(pem=str(out), out=picture)) == 0
    assert "along the line of sight" in " ".join(capsys.readouterr().out.split())
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"memory": True}, "position_errors: not with memory"),
        ({"members": 3}, "position_errors: not with memory or members"),
        ({"position_errors": False, "tails": "gaussian"}, "tails: only with position errors"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(tmp_path, changes, words):
    given = {"position_errors": True, **changes}
    with pytest.raises(PemError, match=words):
        fit.run(fit.FitArguments(tmp_path / "t.csv", tmp_path / "o.safetensors", **given))
