"""Models of features of one's own: from any table to an answer with a simulator of one's own."""

import json
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.special import expit

import pemviz
from pemviz.cli.main import main
from pemviz.errors import ConfigError
from pemviz.pem import (
    PemError,
    fit_ensemble,
    fit_pem,
    load_pem,
    load_table,
    own_features_of,
    save_pem,
)
from pemviz.pem.data.table import coded_as, load_tracks
from pemviz.pem.fitting import linear_and_trees as boosting
from pemviz.pem.fitting import networks
from pemviz.pem.fitting.fit import MODEL_KINDS
from pemviz.pem.judging.cross_validation import cross_validate

NAMES = ("distance", "lux", "rain")
RAIN = ("heavy", "light", "none")  # as they are sorted
FEATURES = ",".join(NAMES)
SPEC = "always[0,8] (distance >= 1.02)"


def true_logit(distance, rain):
    return 3.0 - 0.8 * distance - np.array([1.5, 0.5, 0.0])[rain]


def drone_table(path, *, rows=4000, seed=1, followed=False):
    """What a drone's camera made of a wall: it sees it worse from afar and in rain."""
    random = np.random.default_rng(seed)
    distance, lux = random.uniform(0.5, 6.0, rows), random.uniform(10.0, 900.0, rows)
    rain = random.integers(0, 3, rows)
    detected = random.random(rows) < expit(true_logit(distance, rain))
    header = ["distance", "lux", "rain", "detected"]
    columns = [distance, lux, np.array(RAIN)[rain], detected.astype(int)]
    if followed:
        header += ["sequence", "track", "time_s"]
        place = np.arange(rows)
        columns += [place // 400, place // 40, place * 0.05]
    lines = [",".join(header), *(",".join(map(str, row)) for row in zip(*columns, strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    return drone_table(tmp_path_factory.mktemp("drone") / "drone.csv")


@dataclass(frozen=True)
class Drone:
    """It comes closer while it does not see the wall."""

    name: str = "drone"
    states: int = 9
    dt_s: float = 0.1
    lux: float = 300.0
    rain: float = 1.0
    salient_names: tuple[str, ...] = NAMES
    signals: tuple = field(default=(pemviz.Signal("distance", "distance_m", "m", 0.0, 10.0),))

    def initial(self, *, count):
        start = {"distance": np.full(count, 2.3)}
        return pemviz.StateBatch(step=np.zeros((), dtype=np.int64), signals=start)

    def step(self, states, detected):
        distance = np.maximum(states.signals["distance"] - np.where(detected, -0.1, 0.35), 0.6)
        return pemviz.StateBatch(step=states.step + 1, signals={"distance": distance})

    def salient(self, signals):
        distance = signals["distance"]
        return np.stack(
            [distance, np.full_like(distance, self.lux), np.full_like(distance, self.rain)], axis=-1
        )


def exact_probability(pem, drone):
    """That it comes nearer than 1.02 m, which no sum of steps is, by going through all outcomes."""
    chances = {2.3: 1.0}
    unsafe = 0.0
    for _ in range(drone.states - 1):
        later = {}
        for distance, chance in chances.items():
            logit = pem.logit(drone.salient({"distance": np.array([distance])}))[0]
            for detected, share in ((True, expit(logit)), (False, expit(-logit))):
                nearer = round(distance - (-0.1 if detected else 0.35), 9)
                if nearer < 1.02:
                    unsafe += chance * share
                else:
                    later[nearer] = later.get(nearer, 0.0) + chance * share
        chances = later
    return unsafe


def test_from_a_table_to_an_answer(table, tmp_path, capsys):
    out = tmp_path / "drone.safetensors"
    words = ["--table", str(table), "--features", FEATURES, "--model", "lr", "--folds", "3"]
    assert main(["pem", "fit", *words, "--out", str(out)]) == 0
    assert "bce, 3-fold" in capsys.readouterr().out
    card = out.with_suffix(".md").read_text()
    assert "rain (heavy, light, none)" in card
    assert "occlusion" not in card
    pem = load_pem(str(out))
    own = own_features_of(pem)
    assert own.names == NAMES
    drone = Drone(rain=own.code("rain", "light"))
    config = pemviz.ExperimentConfig(
        method="monte-carlo", spec=SPEC, final_rollouts=20_000, seed=1, memory_s=0.0
    )
    experiment = pemviz.build_experiment(config, simulator=drone, pem=pem)
    assert experiment.warnings == ()
    result = pemviz.run(experiment)
    exact = exact_probability(pem, drone)
    assert 0.005 < exact < 0.5
    error = np.sqrt(exact * (1.0 - exact) / 20_000)
    assert abs(result.estimate.probability - exact) < 4.5 * error  # 7 in a million
    config = replace(config, method="mixture", rollouts=200, final_rollouts=400)
    mixed = pemviz.run(pemviz.build_experiment(config, simulator=drone, pem=pem))
    assert mixed.estimate.probability == pytest.approx(exact, rel=0.2)


def test_logistic_regression_finds_what_the_table_was_drawn_from(table):
    pem = fit_pem(load_table(table, features=NAMES), model="lr")
    random = np.random.default_rng(0)
    rain = random.integers(0, 3, 200)
    distance = random.uniform(0.5, 6.0, 200)
    rows = np.stack([distance, random.uniform(10.0, 900.0, 200), rain], axis=1)
    np.testing.assert_allclose(pem.logit(rows), true_logit(distance, rain), atol=0.5)


@pytest.mark.parametrize("kind", [k for k in MODEL_KINDS if k not in ("b-nn", "gb-paper")])
def test_files_keep_every_bit(kind, table, tmp_path, monkeypatch):
    monkeypatch.setattr(boosting, "ROUNDS", 10)
    monkeypatch.setattr(networks, "EPOCHS", 2)
    loaded = load_table(table, features=NAMES)
    pem = fit_pem(loaded, model=kind, seed=3)
    save_pem(pem, tmp_path / "own.safetensors")
    again = load_pem(str(tmp_path / "own.safetensors"))
    assert (again.own, again.digest) == (pem.own, pem.digest)
    np.testing.assert_array_equal(again.logit(loaded.salient), pem.logit(loaded.salient))
    ensemble = fit_ensemble(loaded, model=kind, members=2)
    save_pem(ensemble, tmp_path / "own-ensemble.safetensors")
    members = load_pem(str(tmp_path / "own-ensemble.safetensors"))
    np.testing.assert_array_equal(members.logit(loaded.salient), ensemble.logit(loaded.salient))


def test_trees_of_own_features_agree_with_scikit_learn(table, monkeypatch):
    monkeypatch.setattr(boosting, "ROUNDS", 20)
    loaded = load_table(table, features=NAMES)
    pem = fit_pem(loaded, model="gb-raw", calibrate=False, seed=2)
    distance, lux, rain = loaded.salient.T
    inputs = np.stack([*(rain == code for code in range(3)), distance, lux], axis=1)
    booster = boosting._boost(inputs.astype(float), loaded.detected, seed=2)
    np.testing.assert_allclose(
        pem.logit(loaded.salient), booster.decision_function(inputs), atol=1e-9
    )


def test_memory_of_own_features(tmp_path):
    """Misses that are drawn independently have no memory; the card keeps both."""
    path = drone_table(tmp_path / "drone.csv", followed=True)
    tracks = load_tracks(path, features=NAMES)
    assert tracks.obstacles.features.names == NAMES
    out = tmp_path / "own.safetensors"
    words = ["--table", str(path), "--features", FEATURES, "--model", "lr", "--memory"]
    assert main(["pem", "fit", *words, "--out", str(out)]) == 0
    assert load_pem(str(out)).memory.tau_s < 0.05


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"salient_names": None}, "must say that its salient variables are these, by an attribute"),
        (
            {"salient_names": ("lux", "distance", "rain")},
            "in this order: simulator 'drone' gives",
        ),
        ({"rain": 3.0}, "rain is 3, allowed: 0 heavy, 1 light, 2 none"),
        ({"lux": np.nan}, "lux is nan, allowed: finite numbers"),
    ],
)
def test_a_simulator_that_gives_something_else_is_refused(table, changes, words):
    pem = fit_pem(load_table(table, features=NAMES), model="lr")
    config = pemviz.ExperimentConfig(method="monte-carlo", spec=SPEC)
    with pytest.raises((ConfigError, PemError), match=words):
        pemviz.build_experiment(config, simulator=Drone(**changes), pem=pem)


def test_a_shipped_scenario_is_refused(table, tmp_path):
    out = tmp_path / "drone.safetensors"
    save_pem(fit_pem(load_table(table, features=NAMES), model="lr"), out)
    with pytest.raises(ConfigError, match="must say that its salient variables are these"):
        pemviz.build_experiment(pemviz.ExperimentConfig(pem=str(out)))


def test_where_the_scenario_leaves_the_data_is_told(table):
    pem = fit_pem(load_table(table, features=NAMES), model="lr")
    config = pemviz.ExperimentConfig(method="monte-carlo", spec=SPEC)
    warnings = pemviz.build_experiment(config, simulator=Drone(lux=5000.0), pem=pem).warnings
    assert any("lux is 5000 to 5000 in the scenario, but 1" in line for line in warnings)


@pytest.mark.parametrize(
    ("features", "change", "words"),
    [
        ("distance,fog", ("", ""), "the header lacks fog"),
        ("distance,distance", ("", ""), "'distance' is there twice"),
        ("distance,detected", ("", ""), "'detected' is no state"),
        ("distance,,rain", ("", ""), "1 to 100 names between commas"),
        ("distance,lux", ("lux,rain,detected\n", "lux,rain,detected\n1,n/a,none,1\n"), "is 'n/a'"),
        ("distance,lux", ("lux,rain,detected\n", "lux,rain,detected\n1,nan,none,1\n"), "is 'nan'"),
        ("distance,rain", ("heavy", ""), "is empty, allowed: a category's name"),
        ("lux:category", ("", ""), "different words, allowed for a category: at most 50"),
    ],
)
def test_what_is_wrong_with_features_is_told_in_one_line(
    table, tmp_path, capsys, features, change, words
):
    path, out = tmp_path / "own.csv", tmp_path / "own.safetensors"
    path.write_text(table.read_text().replace(*change, 1))
    given = ["--table", str(path), "--features", features, "--model", "lr", "--out", str(out)]
    assert main(["pem", "fit", *given]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert words in line
    assert not out.exists()


def observed(check):
    """The quantities of the data themselves, by name."""
    return {one["name"]: one["observed"] for one in check["variants"][0]["quantities"]}


def test_memory_and_check_take_own_features(tmp_path, capsys):
    """The memory alone is the one that the fit has; the kind and the fitted model are checked."""
    path = drone_table(tmp_path / "drone.csv", followed=True)
    words = ["--table", str(path), "--model", "lr", "--features", FEATURES]
    assert main(["pem", "memory", *words, "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)["memory"]["fit"]
    out = tmp_path / "own.safetensors"
    assert main(["pem", "fit", *words, "--memory", "--out", str(out)]) == 0
    assert load_pem(str(out)).card.memory["fit"] == alone
    capsys.readouterr()
    assert main(["pem", "check", *words, "--draws", "799", "--json"]) == 0
    by_kind = json.loads(capsys.readouterr().out)["check"]
    seen = ["pem", "check", "--table", str(path), "--pem", str(out), "--draws", "799", "--json"]
    assert main(seen) == 0
    fitted = json.loads(capsys.readouterr().out)["check"]
    assert observed(fitted) == observed(by_kind) == observed(load_pem(str(out)).card.check)
    assert fitted["same_data"]


def test_a_model_is_checked_by_its_own_codes(tmp_path, capsys):
    """A table without rain's first category has other codes of its own for the rest."""
    path = drone_table(tmp_path / "drone.csv", followed=True)
    own = fit_pem(load_table(path, features=NAMES), model="lr")
    dry = tmp_path / "dry.csv"
    header, *lines = path.read_text().splitlines()
    dry.write_text("\n".join([header, *(one for one in lines if ",heavy," not in one)]) + "\n")
    found = load_table(dry, features=NAMES)
    rain = [line.split(",")[2] for line in lines if ",heavy," not in line]
    coded = coded_as(found, own.own)
    assert [RAIN[int(code)] for code in coded.salient[:, 2]] == rain
    assert found.salient[:, 2].tolist() != coded.salient[:, 2].tolist()
    np.testing.assert_array_equal(coded.salient[:, :2], found.salient[:, :2])
    save_pem(own, tmp_path / "own.safetensors")
    words = ["pem", "check", "--pem", str(tmp_path / "own.safetensors"), "--draws", "799"]
    assert main([*words, "--table", str(dry), "--json"]) == 0
    capsys.readouterr()
    snow = tmp_path / "snow.csv"
    snow.write_text(path.read_text().replace(",heavy,", ",snow,"))
    wordy = tmp_path / "wordy.csv"
    wordy.write_text("\n".join([header, *(f"far,{one.split(',', 1)[1]}" for one in lines)]) + "\n")
    for table, said in ((snow, "no category 'snow', allowed: heavy"), (wordy, "has words, the")):
        assert main([*words, "--table", str(table)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line
    assert main([*words, "--table", str(dry), "--features", FEATURES]) == 2
    assert "features: not with pem" in capsys.readouterr().err


def test_kinds_are_compared_on_own_features(table, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(boosting, "ROUNDS", 10)
    words = ["pem", "evaluate", "--table", str(table), "--features", FEATURES, "--folds", "2"]
    out = tmp_path / "report"
    given = [*words, "--models", "lr", "gb-raw", "--workers", "1", "--out", str(out), "--json"]
    assert main(given) == 0
    lr, trees = json.loads(capsys.readouterr().out)["models"]
    loaded = load_table(table, features=NAMES)
    held_out = cross_validate(loaded, model="lr", folds=2)
    assert lr["bce"] == pytest.approx(held_out.bce[0])
    assert lr["paper_bce"] is None  # which is of another table
    assert trees["roc_auc"] > 0.7
    page = (out / "evaluation.md").read_text()
    assert "## By class" not in page
    assert main([*words, "--models", "gb-paper", "--out", str(tmp_path / "none")]) == 2
    assert "gb-paper sees the paper's columns" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_bayesian_networks_take_own_features(table, tmp_path, pyro_installed, monkeypatch):
    """Each posterior sample answers as numpy's own layers do, and files keep it."""
    pyro_installed()
    monkeypatch.setattr(networks, "BAYES_STEPS", 20)
    loaded = load_table(table, features=NAMES)
    pem = fit_pem(loaded, model="b-nn", seed=3)
    assert pem.own.names == NAMES
    member = pem.members[0]
    distance, lux, rain = loaded.salient[:50].T
    numbers = (np.stack([distance, lux], axis=1) - member.pose_mean) / member.pose_std
    hidden = np.concatenate(
        [np.stack([rain == code for code in range(3)], axis=1), numbers], axis=1
    )
    for place, layer in enumerate(member.layers):
        hidden = hidden @ layer.weight.T + layer.bias
        hidden = np.maximum(hidden, 0.0) if place < len(member.layers) - 1 else hidden
    np.testing.assert_allclose(
        member.logit(loaded.salient[:50]), hidden[:, 0], rtol=1e-4, atol=1e-4
    )
    save_pem(pem, tmp_path / "own.safetensors")
    again = load_pem(str(tmp_path / "own.safetensors"))
    assert (again.own, again.digest) == (pem.own, pem.digest)
    np.testing.assert_array_equal(again.logit(loaded.salient), pem.logit(loaded.salient))
