"""Averages of error models by distance, what they cannot say, and plain tables."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from safetensors.numpy import save_file
from scipy import stats
from scipy.special import expit

from pemviz.cli.main import main
from pemviz.files.shipped import asset_path
from pemviz.pem import (
    CLASS_NAMES,
    OCCLUSION_NAMES,
    Memory,
    NoiseMemory,
    PemError,
    constant_errors,
    load_pem,
    load_position_errors,
    load_table,
    save_pem,
    save_position_errors,
)
from pemviz.pem.exchange.autoware import SUBTYPES, TOPIC
from pemviz.pem.exchange.averages import (
    EDGES_M,
    Obstacles,
    averages,
    fixed_obstacles,
    one_memory_time,
    table_obstacles,
)
from pemviz.pem.exchange.unsaid import _over_visibilities, unsaid_of_misses, unsaid_of_positions
from pemviz.pem.model_files import read_tensors
from pemviz.pem.models.binned_position_errors import BinnedPositionErrors
from pemviz.pem.models.cards import PemCard
from pemviz.pem.models.tabulated import TabulatedPem
from tests.pem.helpers import rows_of

SYNTHETIC = asset_path("pem", "synthetic-obstacles.csv")


def test_bins_have_the_means_of_the_obstacles_in_them():
    """Mean P(missed), and the law of total variance, against single rows taken one by one."""
    pem, errors = load_pem("pointrcnn"), load_position_errors("pointrcnn")
    obstacles = table_obstacles(load_table(SYNTHETIC), name="synthetic", sensor_ahead_m=1.0)
    table = averages(pem, obstacles, edges_m=EDGES_M, errors=errors)
    assert table.rows.sum() == len(obstacles.salient)
    miss, sd = expit(-pem.logit(obstacles.salient)), errors.sd(obstacles.salient)
    mean = errors.mean(obstacles.salient)
    for place, (low_m, high_m) in enumerate(table.bins):
        rows = [k for k, d in enumerate(obstacles.distance_m) if low_m <= d < high_m]
        if not rows:
            continue
        assert table.miss[place] == pytest.approx(sum(miss[k] for k in rows) / len(rows))
        for column, axis in enumerate(table.axes):
            centre = sum(mean[k, column] for k in rows) / len(rows)
            square = sum(sd[k, column] ** 2 + mean[k, column] ** 2 for k in rows) / len(rows)
            assert axis.mean[place] == pytest.approx(centre)
            assert axis.deviation[place] == pytest.approx(np.sqrt(square - centre**2))


def test_a_bin_without_obstacles_has_those_of_the_next_nearer_one():
    obstacles = fixed_obstacles((10.0, 20.0), sensor_ahead_m=0.0)
    far = obstacles.only((obstacles.distance_m > 5.0) & (obstacles.distance_m < 15.0))
    table = averages(load_pem("ml-nn"), far, edges_m=(2.0, 4.0, 10.0, 20.0, 50.0))
    assert (table.rows > 0).tolist() == [False, False, True, True, False, False]
    assert table.miss[[0, 1, 4, 5]].tolist() == table.miss[[2, 2, 3, 3]].tolist()
    said = list(unsaid_of_misses(load_pem("ml-nn"), far, table))
    assert any("no obstacle at 0 to 2 m, 2 to 4 m, 20 to 50 m, 50 to 1000 m" in one for one in said)


@pytest.mark.parametrize(
    ("memory", "tau_s"),
    [
        (NoiseMemory(0.0, 0.0), 0.0),
        (NoiseMemory(0.0, 0.7), 0.7),
        (NoiseMemory(0.4, 0.0), -1.0 / np.log(0.4)),
        (NoiseMemory(0.3, 0.5), -1.0 / np.log(0.3 + 0.7 * np.exp(-2.0))),
        (NoiseMemory(1.0, 0.5), 60.0),
    ],
)
def test_one_memory_time_is_right_a_second_apart(memory, tau_s):
    assert one_memory_time(memory) == pytest.approx(tau_s, rel=1e-12)


@pytest.mark.parametrize(("miss", "frailty", "tau_s"), [(0.1, 0.0, 0.2), (0.2, 0.8, 0.25)])
def test_how_long_misses_last_against_courses_that_are_drawn(miss, frailty, tau_s):
    """Outcome by outcome as the formulas have them; 5 standard errors, false alarm 6e-7 each."""
    count, random = 200_000, np.random.default_rng(2)
    pem = TabulatedPem(PemCard("p", "table"), np.zeros(1), np.log([(1 - miss) / miss]))
    obstacles = fixed_obstacles((), sensor_ahead_m=0.0)
    rho = float(np.exp(-0.1 / tau_s))
    on_end, correlation = _over_visibilities(pem, obstacles, frailty=frailty, rho=rho)
    u = random.standard_normal(count)
    own = stats.norm.cdf(stats.norm.ppf(miss) * np.sqrt(1 + frailty**2) + frailty * u)
    missed = random.random(count) < own
    all_missed = missed.copy()
    for _ in range(9):
        missed = random.random(count) < own + (missed - own) * rho
        all_missed &= missed
    assert abs(on_end - all_missed.mean()) < 5.0 * np.sqrt(on_end / count)
    far = (random.random(count) < own) - miss, (random.random(count) < own) - miss
    products = far[0] * far[1] / (miss * (1 - miss))
    assert abs(correlation - products.mean()) < 5.0 * products.std() / np.sqrt(count)
    assert (frailty > 0.0) == (correlation > 1e-9)


def test_what_is_lost_of_position_errors_is_told():
    errors = load_position_errors("pointpillars")
    obstacles = fixed_obstacles(EDGES_M, sensor_ahead_m=0.0)
    table = averages(load_pem("rrc"), obstacles, edges_m=EDGES_M, errors=errors)
    said = "\n".join(unsaid_of_positions(errors, obstacles, table))
    nu = errors.axes[0].degrees_of_freedom
    factor = np.sqrt(nu / (nu - 2.0))
    assert f"lie within {stats.t.ppf(stats.norm.cdf(1.0), nu) / factor:.2f} of that" in said
    assert f"{2 * stats.t.sf(3 * factor, nu):.2%} beyond 3 of it, of those written 0.27%" in said
    assert f"a share of {errors.axes[0].memory.lasting_share:.2g} lasts" in said
    heavy = replace(errors, axes=tuple(replace(a, degrees_of_freedom=1.5) for a in errors.axes))
    table = averages(load_pem("rrc"), obstacles, edges_m=EDGES_M, errors=heavy)
    assert "it has no standard deviation" in "\n".join(unsaid_of_positions(heavy, obstacles, table))
    assert np.allclose(table.axes[0].deviation, table.axes[0].half_width, rtol=0.1)


def test_each_class_has_a_configuration_of_its_subtype(tmp_path, capsys):
    out = tmp_path / "noise.yaml"
    words = ["--table", str(SYNTHETIC), "--format", "autoware", "--out", str(out)]
    assert main(["pem", "export", "ml-nn", *words]) == 0
    noise = yaml.safe_load(out.read_text())["/**"]["ros__parameters"][TOPIC]["noise"]["v4"]
    table = load_table(SYNTHETIC)
    names = [CLASS_NAMES[int(code)] for code in table.salient[:, 0]]
    subtypes = sorted({SUBTYPES[name] for name in names if name in SUBTYPES})
    assert [one["noise_application_entities"]["subtypes"] for one in noise.values()] == [
        [subtype] for subtype in subtypes
    ]
    people = np.isin(names, ["Pedestrian", "Person_sitting"])
    miss = expit(-load_pem("ml-nn").logit(table.salient))
    distance_m = Obstacles(table.salient, "").distance_m
    near = people & (distance_m >= 10.0) & (distance_m < 15.0)
    rates = noise["pedestrian"]["true_positive"]["rate"]["values"]
    assert near.any()
    assert 1.0 - rates[2] == pytest.approx(miss[near].mean(), abs=1e-6)
    printed = capsys.readouterr().out
    assert "PEDESTRIAN: P(missed) depends on more than distance" in printed
    assert ("of no subtype there: Tram" in printed) == ("Tram" in names)


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_a_plain_table_has_the_data_beside_the_model(ending, tmp_path):
    out = tmp_path / f"plain.{ending}"
    words = ["--table", str(SYNTHETIC), "--format", ending, "--out", str(out)]
    assert main(["pem", "export", "pointrcnn", *words]) == 0
    if ending == "csv":
        rows = rows_of(out)
    else:
        document = json.loads(out.read_text())
        rows = document["rows"]
        assert document["licence"] == load_pem("pointrcnn").licence
        assert document["cannot_say"]
    table = load_table(SYNTHETIC)
    assert sum(int(row["rows"]) for row in rows) == len(table)
    assert sum(int(row["missed"]) for row in rows) == np.count_nonzero(~table.detected)
    miss, tau_s = expit(-load_pem("pointrcnn").logit(table.salient)), load_pem("pointrcnn").memory
    distance_m = Obstacles(table.salient, "").distance_m
    for row in rows[::7]:
        inside = (table.salient[:, 0] == CLASS_NAMES.index(row["class"])) & (
            table.salient[:, 2] == OCCLUSION_NAMES.index(row["occlusion"])
        )
        inside &= (distance_m >= float(row["from_m"])) & (distance_m < float(row["to_m"]))
        assert int(row["rows"]) == np.count_nonzero(inside)
        assert float(row["p_missed"]) == pytest.approx(miss[inside].mean(), rel=1e-5)
        assert float(row["memory_time_s"]) == pytest.approx(tau_s.tau_s, rel=1e-5)
        assert float(row["range_error_sd_m"]) > float(row["range_error_half_width_68_m"]) > 0.0


def test_without_a_table_the_obstacle_is_named(tmp_path, capsys):
    assert main(["pem", "export", "rrc", "--format", "csv", "--out", str(tmp_path / "a.csv")]) == 0
    assert "no table: a car straight ahead, 0 to 100 m, seen from behind" in capsys.readouterr().out
    rows = rows_of(tmp_path / "a.csv")
    assert [row["occlusion"] for row in rows[:: len(EDGES_M) + 1]] == list(OCCLUSION_NAMES)
    assert "rows" not in rows[0]


def test_position_errors_beside_a_model_go_with_it(tmp_path, capsys):
    noise, out = tmp_path / "noise.yaml", tmp_path / "own.safetensors"
    assert main(["pem", "export", "pointrcnn", "--format", "autoware", "--out", str(noise)]) == 0
    assert main(["pem", "import", str(noise), "--out", str(out)]) == 0
    beside = tmp_path / "own-position-errors.safetensors"
    assert f"pemviz record --pem {out} --position-errors {beside}" in capsys.readouterr().out
    errors = load_position_errors(str(beside))
    assert "PointRCNN" in errors.card.data
    words = ["--format", "autoware", "--out", str(tmp_path / "none.yaml")]
    assert main(["pem", "export", str(out), "--position-errors", "none", *words]) == 0
    kept = out.read_bytes(), beside.read_bytes()
    capsys.readouterr()
    assert main(["pem", "import", str(tmp_path / "none.yaml"), "--out", str(out)]) == 2
    assert f"{beside} lies beside it" in capsys.readouterr().err  # and is not this model's
    assert (out.read_bytes(), beside.read_bytes()) == kept


def test_an_imported_model_runs_with_its_memory(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["pem", "export", "pointrcnn", "--format", "autoware", "--out", "n.yaml"]) == 0
    assert main(["pem", "import", "n.yaml", "--out", "own.safetensors"]) == 0
    tau_s = load_pem("own.safetensors").memory.tau_s
    assert tau_s == pytest.approx(load_pem("pointrcnn").memory.tau_s, rel=1e-5)
    capsys.readouterr()
    run = ["record", "--pem", "own.safetensors", "--no-recording", "--method", "monte-carlo"]
    errors = ["--position-errors", "own-position-errors.safetensors"]
    assert main([*run, *errors, "--max-rollouts", "200", "--json"]) in (0, 4)
    answer = json.loads(capsys.readouterr().out)
    assert answer["memory"]["tau_s"] == pytest.approx(tau_s)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["rrc", "--out", "a.csv"], "out is 'a.csv', must end in .yaml"),
        (["rrc", "--out", "a.yaml", "--edges-m", "5,5"], "edges_m is 5,5, allowed: at most 100"),
        (["rrc", "--out", "a.yaml", "--edges-m", "5,far"], "must be numbers between commas"),
        (["rrc", "--out", "a.yaml", "--edges-m", "nan"], "edges_m is nan, allowed"),
        (["rrc", "--out", "a.yaml", "--sensor-ahead-m", "99"], "sensor_ahead_m is 99, allowed"),
        (
            ["rrc", "--out", "a.yaml", "--subtype", "BUS"],
            "subtype: only of a model that is a table",
        ),
        (
            ["rrc", "--out", "a.yaml", "--position-errors", "rrc"],
            "no model of position errors 'rrc'",
        ),
        (["rrc", "--out", "a.yaml", "--table", "none.csv"], "none.csv: no table"),
        (["own.safetensors", "--out", "a.yaml"], "sees features of its own"),
    ],
)
def test_bad_arguments_are_one_line(words, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if words[0] == "own.safetensors":
        (tmp_path / "t.csv").write_text(
            "lux,detected\n" + "".join(f"{k},{k % 2}\n" for k in range(40))
        )
        fit = ["--features", "lux", "--model", "lr", "--folds", "0", "--out", words[0]]
        assert main(["pem", "fit", "--table", "t.csv", *fit]) == 0
        capsys.readouterr()
    assert main(["pem", "export", *words, "--format", "autoware"]) == 2
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert line in said
    assert not (tmp_path / "a.yaml").exists()


def test_a_table_by_nearest_point_is_stored_as_it_is(tmp_path):
    pem = TabulatedPem(
        PemCard("near", "table"), np.array([0.0, 5.0]), np.array([1.0, 2.0]), between="step",
        measure="nearest-point", sensor_ahead_m=1.5, tau_s=0.3,
    )  # fmt: skip
    save_pem(pem, tmp_path / "near.safetensors")
    again = load_pem(str(tmp_path / "near.safetensors"))
    assert again.digest == pem.digest
    assert again.options() == pem.options()
    assert again.memory == Memory(tau_s=0.3)
    assert replace(pem, measure="ahead", sensor_ahead_m=0.0).digest != pem.digest


def test_fine_bins_of_cars_in_plain_view_give_the_models_own_answer(tmp_path, capsys):
    """The braking scenario, misses independent: both within their standard errors, and the bins."""
    edges = ",".join(map(str, [*range(1, 17), 18, 20, 25, 30, 40, 60]))
    noise, back = tmp_path / "noise.yaml", str(tmp_path / "back.safetensors")
    words = ["--format", "autoware", "--edges-m", edges, "--out", str(noise)]
    assert main(["pem", "export", "pointrcnn", *words]) == 0
    assert main(["pem", "import", str(noise), "--out", back]) == 0
    capsys.readouterr()
    assert main(["pem", "compare", "pointrcnn", back, "--json"]) == 0
    own, again = (one["probability"] for one in json.loads(capsys.readouterr().out)["models"])
    assert own < 1e-12
    assert again == pytest.approx(own, rel=0.05)


def test_errors_by_bin_are_mean_and_deviation_times_noise(tmp_path):
    errors = binned()
    rows = fixed_obstacles((3.0, 30.0), sensor_ahead_m=1.0)
    noise = np.random.default_rng(4).standard_normal((len(rows.salient), 2))
    found = errors.error(rows.salient, noise)
    for distance_m, z, error in zip(rows.distance_m, noise, found, strict=True):
        mean, sd = ((0.1, -0.2), (0.5, 0.0)) if distance_m < 10.0 else ((0.3, 0.4), (1.5, 2.0))
        assert error == pytest.approx(np.array(mean) + np.array(sd) * z)
    np.testing.assert_allclose(errors.range_error(rows.salient, noise[:, 0]), found[:, 0])
    np.testing.assert_array_equal(errors.sd(rows.salient), errors.scale(rows.salient))
    save_position_errors(errors, tmp_path / "errors.safetensors")
    again = load_position_errors(str(tmp_path / "errors.safetensors"))
    assert again.digest == errors.digest
    np.testing.assert_array_equal(again.error(rows.salient, noise), found)


def binned(**changes):
    model = constant_errors()
    given = {
        "from_m": np.array([0.0, 10.0]),
        "bin_mean": np.array([[0.1, -0.2], [0.3, 0.4]]),
        "bin_deviation": np.array([[0.5, 0.0], [1.5, 2.0]]),
        "sensor_ahead_m": np.array([1.0]),
    }
    return BinnedPositionErrors.of(model, *(given | changes).values())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"from_m": np.array([1.0, 10.0])}, "begin at 0 m"),
        ({"from_m": np.array([0.0, 0.0])}, "farther and farther away"),
        ({"from_m": np.array([0.0, np.nan])}, "farther and farther away"),
        ({"bin_mean": np.zeros((2, 3))}, r"must have shape \[2, 2\]"),
        ({"bin_mean": np.full((2, 2), np.inf)}, "must be finite"),
        ({"bin_deviation": np.full((2, 2), -1.0)}, "must be 0 or more"),
        ({"sensor_ahead_m": np.array([99.0])}, "sensor_ahead_m is 99"),
    ],
)
def test_errors_by_bin_that_cannot_be_are_refused(changes, words):
    with pytest.raises(PemError, match=words):
        binned(**changes)


def test_a_damaged_file_of_errors_by_bin_is_refused(tmp_path):
    path = tmp_path / "errors.safetensors"
    save_position_errors(binned(), path)
    tensors, metadata = read_tensors(path)
    for change in (
        {"bins.from_m": np.zeros(3)},
        {"bins.from_m": np.zeros((2, 2))},
        {"bins.from_m": np.array(0.0)},
        {"bins.mean": np.zeros(2)},
        {"bins.sensor_ahead_m": np.zeros(2)},
    ):
        save_file(tensors | change, path, metadata=metadata)
        with pytest.raises(PemError, match=r"need |bins"):
            load_position_errors(str(path))
