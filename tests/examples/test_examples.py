"""The examples run as they stand, and their answers are right."""

import dataclasses
import os
import runpy
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import pemviz
from pemviz.sampling.rollouts.simulate import replay
from pemviz.sampling.zero_variance.method import ZeroVarianceSampling
from tests.examples.highway_twin import saving_twin

ROOT = Path(__file__).resolve().parents[2]
HIGHWAY = ROOT / "examples" / "highway_three_cars.py"
ONNX = ROOT / "examples" / "onnx_detector.py"
RANDOM_START = ROOT / "examples" / "random_start.py"
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LONG = {HIGHWAY, RANDOM_START, ROOT / "examples" / "dirty_lens.py"}
"""They take ten seconds and more as they stand."""
LONGEST = {HIGHWAY: 70, ROOT / "examples" / "tracker.py": 70, RANDOM_START: 70, ONNX: 115}
"""Lines, of those that have a reason; others stay below 60."""
SPEC = "always[0,60] (distance >= 0.3)"


@pytest.fixture(scope="module")
def drone():
    return runpy.run_path(str(ROOT / "examples" / "own_system.py"))


def answer(drone, *, method, logit_at_wall, **settings):
    config = pemviz.ExperimentConfig(method=method, spec=SPEC, **settings)
    experiment = pemviz.build_experiment(
        config, simulator=drone["DroneAtWall"](), pem=drone["WallCamera"](logit_at_wall)
    )
    return pemviz.run(experiment).estimate


def known(drone, *, logit_at_wall):
    """Importance sampling with values from the drone itself: unbiased, a fraction of a per cent."""
    config = pemviz.ExperimentConfig(method="mixture", spec=SPEC)
    simulator = drone["DroneAtWall"]()
    problem = pemviz.build_experiment(
        config, simulator=simulator, pem=drone["WallCamera"](logit_at_wall)
    ).problem
    method = ZeroVarianceSampling(twin=simulator, rollouts=20_000, seed=7, largest_layer=2_000)
    state, _ = method.step(problem, method.init(problem, repetition=0))
    return method.estimate(state)


def agree(one, other, *, errors):
    joint = np.hypot(one.std_error, other.std_error)
    assert abs(one.probability - other.probability) < errors * joint, (one, other)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_is_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < LONGEST.get(path, 60)


def marks_of(path):
    """Long ones are slow; ONNX's packages are not there for every Python."""
    absent = [name for name in ("onnx", "onnxruntime") if find_spec(name) is None]
    skip = pytest.mark.skipif(bool(absent), reason="needs the extra pemviz[onnx]")
    return [pytest.mark.slow] * (path in LONG) + [skip] * (path == ONNX)


@pytest.mark.parametrize("path", [pytest.param(p, marks=marks_of(p), id=p.stem) for p in EXAMPLES])
def test_runs(path, capsys):
    """One in a process of its own, as a user runs them; the others share what is imported here."""
    if path.stem == "episodic":
        done = subprocess.run(
            [sys.executable, "-W", "error", str(path)],
            capture_output=True, text=True, check=False, cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    else:
        runpy.run_path(str(path), run_name="__main__")
        printed = capsys.readouterr().out
    for words in ("95 % interval", "violate ", "least robust rollout: violates"):
        assert words in printed
    assert "do not quote" not in printed
    assert "too heavy" not in printed


@pytest.mark.parametrize("path", sorted(LONG - {HIGHWAY}), ids=lambda p: p.stem)
def test_runs_with_fewer_rollouts(path, monkeypatch, capsys):
    """All that it does; what its answers are worth is told of it as it stands."""
    build = pemviz.build_experiment

    def small(config, **parts):
        few = {"rollouts": 60, "stages": 4, "final_rollouts": 60, "plan": False}
        return build(dataclasses.replace(config, **few, measured_memory=False), **parts)

    monkeypatch.setattr(pemviz, "build_experiment", small)
    runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.count("Failure probability in one run: ") == 2
    assert printed.count("least robust rollout: violates") == 2


def test_mixture_agrees_with_plain_monte_carlo(drone):
    """Near 4e-4; 3.5 joint standard errors: a false alarm with probability 5e-4."""
    plain = answer(drone, method="monte-carlo", logit_at_wall=-1.2, final_rollouts=100_000, seed=3)
    assert 20 < plain.failures < 80
    mixture = answer(drone, method="mixture", logit_at_wall=-1.2, rollouts=200, seed=3)
    agree(mixture, plain, errors=3.5)


@pytest.mark.slow
def test_rare_setting_three_ways(drone):
    """Near 9e-8; each comparison within 3.5 joint standard errors (5e-4 each)."""
    mixture = answer(drone, method="mixture", logit_at_wall=-0.5, rollouts=300, seed=5)
    truth = known(drone, logit_at_wall=-0.5)
    assert truth.std_error < 0.02 * truth.probability
    agree(mixture, truth, errors=3.5)
    splitting = answer(drone, method="splitting", logit_at_wall=-0.5, rollouts=300, seed=5)
    agree(splitting, truth, errors=3.5)
    assert splitting.ci_low < truth.probability < splitting.ci_high


def test_the_page_on_own_simulators_shows_the_example_as_it_is():
    page = (ROOT / "docs" / "how-to" / "your-simulator.md").read_text(encoding="utf-8")
    mark = "<!-- tested: excerpt of examples/own_system.py -->\n```python\n"
    excerpt = page.split(mark)[1].split("```")[0]
    assert excerpt in (ROOT / "examples" / "own_system.py").read_text(encoding="utf-8")


def test_the_readmes_program_prints_what_the_readme_says(capsys):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    program = readme.split("```python\n")[1].split("```")[0]
    printed = readme.split("```python\n")[1].split("```\n")[2]
    exec(compile(program, "README.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out == printed


def parts_of(path, monkeypatch):
    """Configuration, simulator and error model that an example would run."""
    found = {}

    def keep(config, **parts):
        found.update(parts, config=config)
        raise SystemExit

    monkeypatch.setattr(pemviz, "build_experiment", keep)
    with pytest.raises(SystemExit):
        runpy.run_path(str(path), run_name="__main__")
    monkeypatch.undo()
    return found


def test_highway_env_tells_of_three_cars(monkeypatch):
    """A few of its rollouts; the whole run is a slow test."""
    parts = parts_of(HIGHWAY, monkeypatch)
    config = dataclasses.replace(
        parts.pop("config"), method="naive", final_rollouts=20, naive_detection_probability=0.1
    )
    experiment = pemviz.build_experiment(config, **parts)
    worst = pemviz.LeastRobust()
    found = pemviz.run(experiment, observers=[worst])
    assert found.estimate.failures > 0
    assert list(worst.rollout.right_by_slot) == ["car 1", "car 2", "car 3"]
    assert found.explanation.slots[1].errors > found.explanation.slots[2].errors


def test_highway_env_does_the_same_where_its_states_are_saved(monkeypatch):
    cars = parts_of(HIGHWAY, monkeypatch)["simulator"]
    twin = saving_twin(runpy.run_path(str(HIGHWAY)), cars)
    detected = np.random.default_rng(5).random((3, 30, 3)) < np.array([[[0.9]], [[0.5]], [[0.0]]])
    played, saved = (
        replay(simulator=one, detected=detected) for one in (pemviz.side_by_side(cars), twin)
    )
    assert np.ptp(saved["clearance"], axis=0).max() > 1.0
    for name, values in saved.items():
        np.testing.assert_allclose(played[name], values, rtol=0.0, atol=1e-9)


def test_the_detector_of_the_onnx_file_is_what_numpy_computes(tmp_path):
    """How much darker the darkest spot of 3 x 3 pixels is than the ring of 16 around it."""
    pytest.importorskip("onnx", reason="needs the extra pemviz[onnx]")
    pytest.importorskip("onnxruntime", reason="needs the extra pemviz[onnx]")
    example = runpy.run_path(str(ONNX))
    example["write_network"](tmp_path / "spot.onnx")
    detector = example["Detector"](str(tmp_path / "spot.onnx"))
    gaps_m = np.linspace(1.0, 40.0, 60)
    spray = np.random.default_rng(2).standard_normal(60)
    signals = {"gap": gaps_m, "fog": np.full(60, 0.03)}
    images = example["render"](pemviz.StateBatch(np.array(0), signals, {"spray": spray}))
    windows = np.lib.stride_tricks.sliding_window_view(images.astype(float), (5, 5), axis=(1, 2))
    inner = windows[..., 1:4, 1:4].sum(axis=(-1, -2))
    ring = windows.sum(axis=(-1, -2)) - inner
    wanted = (ring / 16.0 - inner / 9.0).max(axis=(1, 2))
    np.testing.assert_allclose(detector(images), wanted, atol=1e-4)
    assert wanted.min() < 12.0 < wanted.max()
