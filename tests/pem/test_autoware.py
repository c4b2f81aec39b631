"""Noise parameters of scenario_simulator_v2: its process, written from its guide, and back."""

import math
from itertools import pairwise

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit

from pemviz.cli.main import main
from pemviz.pem import load_pem, load_position_errors, load_table
from pemviz.pem.exchange.autoware import (
    TOPIC,
    NoiseFile,
    configuration_of,
    noise_yaml,
    read_noise,
)
from pemviz.pem.exchange.averages import EDGES_M, averages, fixed_obstacles, table_obstacles
from pemviz.pem.exchange.binned_models import miss_model, position_model
from pemviz.pem.models.memory import persistence, remembering_logit
from tests.conftest import shared
from tests.pem.helpers import random_rows
from tests.pem.scenario_simulator import DOCUMENTED, courses, phi

MODELS = pytest.mark.parametrize("name", ["rrc", "pointrcnn"])
OUTPUT_OF = {
    "rrc": ("rrc_car", "mot"),
    "own": ("rrc_car", "mot"),
    "pointrcnn": ("pointrcnn_car", "ab3dmot"),
}
Z = 4.9
"""Standard errors that a mean over independent entities may be off: false alarm 1e-6 each, below
5e-4 over all comparisons of a run of these tests."""


def exported(name, path, *options):
    assert main(["pem", "export", name, "--format", "autoware", "--out", str(path), *options]) == 0
    return yaml.safe_load(path.read_text())["/**"]["ros__parameters"][TOPIC]


def configuration(parameters, name="car"):
    return parameters["noise"]["v4"][name]


def flat(values, prefix=""):
    if not isinstance(values, dict):
        return {prefix[1:]: values}
    pairs = [flat(value, f"{prefix}.{key}") for key, value in values.items()]
    return {key: value for each in pairs for key, value in each.items()}


def test_every_documented_parameter_is_written_and_no_other(tmp_path):
    written = flat(exported("pointrcnn", tmp_path / "noise.yaml"))
    assert {name.replace(".v4.car.", ".v4.NAME.") for name in written} == set(DOCUMENTED)
    # ROS types: in a list of doubles a whole number is refused
    for name, value in written.items():
        if name.endswith((".values", "ellipse_y_radii")):
            assert all(type(one) is float for one in value), name
        if name.endswith(("radius", "amplitude", "decay", "offset", "rate", "delay", "range")):
            assert type(value) is float, name
    assert type(written["noise.model.version"]) is int
    assert "&" not in (tmp_path / "noise.yaml").read_text()


@MODELS
@pytest.mark.parametrize("dt_s", [0.05, 0.1, 0.7])
def test_its_chain_of_misses_is_that_of_pemviz(name, dt_s, tmp_path):
    """Transition probabilities, to the six digits that are written."""
    pem = load_pem(name)
    found = configuration(exported(name, tmp_path / "noise.yaml"))["true_positive"]
    stays, rho = phi(found, dt_s), persistence(dt_s, pem.memory.tau_s)
    assert stays == pytest.approx(float(rho), rel=1e-4)
    for rate in found["rate"]["values"]:
        for before in (False, True):
            theirs = stays * (not before) + (1.0 - stays) * rate
            own = remembering_logit(
                np.array([logit(rate)]), missed_before=np.array([before]), rho=rho
            )
            assert theirs == pytest.approx(float(expit(own)[0]), rel=1e-4)


def naive_distance_m(row, *, ahead_m=0.0):
    """To the nearest of many points of the box's outline, its corners turned as KITTI's devkit."""
    length, width, x, z, turn = row[6], row[5], row[7], row[9], row[10]
    side = np.linspace(-0.5, 0.5, 801)
    outline = [(s * length, e * width) for e in (-0.5, 0.5) for s in side]
    outline += [(e * length, s * width) for e in (-0.5, 0.5) for s in side]
    c, s = math.cos(turn), math.sin(turn)
    return min(math.hypot(c * u + s * v + x, -s * u + c * v + z + ahead_m) for u, v in outline)


def test_distances_are_to_the_nearest_point_of_the_box(tmp_path):
    rng = np.random.default_rng(8)
    rows = random_rows(rng, 40)
    rows[:, 9] = rng.uniform(12.0, 60.0, len(rows))  # none around the sensor itself
    exported("rrc", tmp_path / "a.yaml", "--sensor-ahead-m", "1.5")
    chosen = read_noise(tmp_path / "a.yaml").named(None)
    pem = miss_model(chosen, {}, name="a", sensor_ahead_m=1.5)
    for row, answer in zip(rows, pem.logit(rows), strict=True):
        distance_m = naive_distance_m(row, ahead_m=1.5)
        if np.abs(chosen.radii_m - distance_m).min() > 0.05:
            place = int(np.argmax(distance_m < chosen.radii_m))
            assert expit(answer) == pytest.approx(chosen.rate[place], rel=1e-12)


def means_and_bounds(values):
    """Mean over entities ``[n]``, and how far off it may be."""
    return values.mean(), Z * values.std(ddof=1) / math.sqrt(len(values))


def check_against_pemviz(noise, pem, errors, obstacles):
    """Rates, correlations and errors of the process in each bin, against the models' own."""
    tau_s, frames, dt_s, entities = pem.memory.tau_s, 300, 0.1, 400
    random = np.random.default_rng(11)
    miss = expit(-pem.logit(obstacles.salient))
    ends = [0.0, *noise["ellipse_y_radii"]]
    for place, (low_m, high_m) in enumerate(pairwise(ends)):
        inside = (obstacles.distance_m >= low_m) & (obstacles.distance_m < high_m)
        if not inside.any():
            continue
        reported, along, across = courses(
            noise, x_m=0.6 * low_m + 0.1, y_m=0.8 * low_m, dt_s=dt_s, frames=frames + 100,
            entities=entities, random=random,
        )  # fmt: skip
        p = miss[inside].mean()
        assert noise["true_positive"]["rate"]["values"][place] == pytest.approx(1 - p, abs=1e-6)
        missed = ~reported[100:] - p
        mean, bound = means_and_bounds(missed.mean(axis=0))
        assert abs(mean) < bound, (place, p)
        for lag in (1, 3, 10):
            products = (missed[lag:] * missed[:-lag]).mean(axis=0) / (p * (1.0 - p))
            mean, bound = means_and_bounds(products)
            assert abs(mean - math.exp(-lag * dt_s / tau_s)) < bound, (place, lag)
        if errors is None:
            assert not along.any()
            assert not across.any()
            continue
        salient = obstacles.salient[inside]
        for column, error in enumerate((along[100:], across[100:])):
            own, spread = errors.mean(salient)[:, column], errors.sd(salient)[:, column]
            centre = own.mean()
            variance = (spread**2).mean() + own.var()
            mean, bound = means_and_bounds(error.mean(axis=0))
            assert abs(mean - centre) < bound, (place, column)
            mean, bound = means_and_bounds(((error - centre) ** 2).mean(axis=0))
            assert abs(mean - variance) < bound, (place, column)
            products = ((error[10:] - centre) * (error[:-10] - centre)).mean(axis=0) / variance
            mean, bound = means_and_bounds(products)
            later = float(errors.axes[column].memory.correlation(1.0))
            assert abs(mean - later) < bound, (place, column)


@MODELS
def test_its_process_has_the_models_rates_correlations_and_errors(name, tmp_path):
    noise = configuration(exported(name, tmp_path / "noise.yaml"))
    errors = load_position_errors(name) if name == "pointrcnn" else None
    obstacles = fixed_obstacles(EDGES_M, sensor_ahead_m=0.0)
    check_against_pemviz(noise, load_pem(name), errors, obstacles)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rrc", "pointrcnn", "own"])
def test_averages_over_kittis_cars_go_through_its_process(name, tmp_path):
    """Of the shipped models, and of one that is fitted here."""
    folder = shared("kitti_tracking")
    path, model = tmp_path / "tracks.csv", name
    detections, written = OUTPUT_OF[name]
    collect = ["--labels", str(folder / "label_02"), "--detections", str(folder / detections)]
    only = ["--types", "Car", "--iou-above", "0.5", "--drop-unknown", "--out", str(path)]
    assert main(["pem", "collect", *collect, "--format", written, *only]) == 0
    if name == "own":
        model = str(tmp_path / "own.safetensors")
        fit = ["pem", "fit", "--table", str(path), "--model", "lr", "--memory", "--out", model]
        assert main(fit) == 0
    noise = configuration(exported(model, tmp_path / "noise.yaml", "--table", str(path)))
    errors = load_position_errors(name) if name == "pointrcnn" else None
    obstacles = table_obstacles(load_table(path), name="tracks.csv", sensor_ahead_m=0.0)
    check_against_pemviz(noise, load_pem(model), errors, obstacles)
    round_trip(model, tmp_path, "--table", str(path))


@MODELS
def test_round_trip(name, tmp_path):
    round_trip(name, tmp_path)


def test_what_the_topic_changes_beside_the_noise_is_said_when_it_is_read(tmp_path, capsys):
    """With a range of 30 m all beyond is missed, whatever rate stands there."""
    exported("rrc", tmp_path / "one.yaml")
    text = (tmp_path / "one.yaml").read_text(encoding="utf-8")
    changed = text.replace("range: 300.0", "range: 30.0").replace("delay: 0.0", "delay: 2.0")
    for content, said in ((text, False), (changed, True)):
        (tmp_path / "two.yaml").write_text(content, encoding="utf-8")
        capsys.readouterr()
        back = str(tmp_path / "back.safetensors")
        assert main(["pem", "import", str(tmp_path / "two.yaml"), "--out", back]) == 0
        out = capsys.readouterr().out
        assert ("not taken: range 30.0 of the topic" in out) is said
        assert ("not taken: delay 2.0 of the topic" in out) is said


def round_trip(model, folder, *options):
    """Written, read, written again: the same file, byte for byte."""
    first, back, again = (folder / name for name in ("one.yaml", "back.safetensors", "two.yaml"))
    exported(model, first, *options)
    assert main(["pem", "import", str(first), "--out", str(back)]) == 0
    exported(str(back), again)
    assert again.read_bytes() == first.read_bytes()
    assert load_pem(str(back)).licence == load_pem(model).licence


@settings(max_examples=30)
@given(
    data=st.data(),
    ends=st.lists(st.integers(1, 90_000), max_size=6, unique=True).map(
        lambda whole: [one / 100 for one in sorted(whole)]
    ),
    taus=st.tuples(*(st.floats(1e-3, 59.0) | st.just(0.0) for _ in range(3))),
)
def test_any_table_goes_through_unchanged(data, ends, taus, sample, tmp_path_factory):
    count = len(ends) + 1

    def lists(elements):
        return st.lists(elements, min_size=count, max_size=count).map(np.array)

    rates = data.draw(lists(st.floats(1e-12, 1.0 - 1e-12)))
    means, sds = (data.draw(lists(st.floats(low, 3.0))) for low in (-3.0, 0.0))
    document = nested(sample | {
        "noise.v4.car.ellipse_y_radii": [*ends, 1000.0],
        "noise.v4.car.true_positive.rate.values": rates.tolist(),
        "noise.v4.car.position.x.mean.values": means.tolist(),
        "noise.v4.car.position.x.standard_deviation.values": sds.tolist(),
        **{f"{key}.values": [0.0] * count for key in ZEROS},
        **{
            f"noise.v4.car.{part}.autocorrelation_coefficient.{key}": value
            for part, tau_s in zip(("true_positive", "position.x", "position.y"), taus, strict=True)
            for key, value in zip(
                ("amplitude", "decay", "offset"),
                (1.0, 1.0 / tau_s, 0.0) if tau_s else (0.0, 0.0, 0.0),
                strict=True,
            )
        },
    })  # fmt: skip
    path = tmp_path_factory.mktemp("any") / "noise.yaml"
    path.write_text(yaml.safe_dump(document))
    once = passed_through(read_noise(path))
    path.write_text(once)
    assert passed_through(read_noise(path)) == once
    found = configuration(yaml.safe_load(once)["/**"]["ros__parameters"][TOPIC])
    assert found["ellipse_y_radii"] == [*ends, 1000.0]
    assert found["true_positive"]["rate"]["values"] == pytest.approx(rates.tolist(), abs=1e-6)
    assert found["position"]["x"]["mean"]["values"] == pytest.approx(means.tolist(), abs=5e-6)


ZEROS = (
    *("noise.v4.car.yaw.mean", "noise.v4.car.yaw.standard_deviation"),
    *("noise.v4.car.position.y.mean", "noise.v4.car.position.y.standard_deviation"),
)


def passed_through(file):
    """The file's text after its only configuration was a model of pemviz."""
    chosen = file.named(None)
    pem = miss_model(chosen, file.notes, name="any", sensor_ahead_m=0.0)
    errors = position_model(chosen, file.notes, name="any", sensor_ahead_m=0.0)
    edges_m = pem.distance_m[1:].tolist()
    table = averages(
        pem, fixed_obstacles(edges_m, sensor_ahead_m=0.0), edges_m=edges_m, errors=errors
    )
    return noise_yaml(NoiseFile((configuration_of(table, subtype="CAR"),)))


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    return flat(exported("rrc", tmp_path_factory.mktemp("sample") / "noise.yaml"))


def nested(parameters):
    """A file of these dotted names."""
    whole = {}
    for name, value in parameters.items():
        *folders, last = name.split(".")
        inner = whole
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[last] = value
    return {"/**": {"ros__parameters": {TOPIC: whole}}}
