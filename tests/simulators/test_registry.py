"""Simulators that other packages register are found by name; what is wrong is one line."""

import importlib
import json
import sys

import numpy as np
import pytest

from pemviz.cli.main import main
from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.errors import ConfigError
from pemviz.panel.run_data import own_scenario
from pemviz.processes import can_be_sent
from pemviz.proposals.fixed import PemProposal
from pemviz.runs.experiment import build_experiment
from pemviz.sampling.rollouts.simulate import simulate
from pemviz.simulators.registry import SHIPPED, build_named_simulator, simulator_names
from pemviz.types import Simulator
from tests.lattice_walk import ToyPem

MODULE = '''
"""Simulators of a third party."""

from dataclasses import dataclass, replace

from tests.lattice_walk import ToySimulator
from pemviz.simulators.braking.vectorized import VectorizedSimulator


def lattice():
    return ToySimulator(states=11)


@dataclass(frozen=True)
class Faster(VectorizedSimulator):
    @property
    def name(self):
        return "faster"


def by_scenario(scenario):
    return Faster(scenario)


@dataclass(frozen=True)
class Settled(ToySimulator):
    name: str = "settled"
    states: int = 13


def annotated(given: "ScenarioConfig | None" = None):
    return ToySimulator(states=5 if given is None else given.states)


class Stepped:
    name, states, dt_s = "stepped", 6, 0.5
    signals = ToySimulator().signals

    def reset(self):
        self.gap = 3.0
        return {"gap": self.gap}

    def step(self, detected):
        self.gap += 1.0 if detected else -1.0
        return {"gap": self.gap}, False

    def salient(self, signals):
        return signals["gap"][..., None]


def failing(scenario):
    raise ValueError(f"no licence\\nfor {scenario.states} states")


def nothing():
    return None


NOT_CALLABLE = 3
'''
NAMES = {
    "lattice": "lattice",
    "faster": "by_scenario",
    "settled": "Settled",
    "annotated": "annotated",
    "stepped": "Stepped",
    "failing": "failing",
    "nothing": "nothing",
    "class": "Faster",
    "type": "type",
    "absent": "no_such_name",
    "number": "NOT_CALLABLE",
    "vectorized": "failing",
}


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """A package with simulators, as pip would have installed it into another folder."""
    (tmp_path / "third_party_simulators.py").write_text(MODULE, encoding="utf-8")
    info = tmp_path / "third_party_simulators-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: third-party-simulators\n")
    points = "\n".join(f"{name} = third_party_simulators:{to}" for name, to in NAMES.items())
    (info / "entry_points.txt").write_text(f"[pemviz.simulators]\n{points}\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield tmp_path
    sys.modules.pop("third_party_simulators", None)


def test_without_packages_there_are_the_shipped_ones():
    assert simulator_names()[: len(SHIPPED)] == SHIPPED == ("vectorized", "highway-env", "sumo")
    for name in SHIPPED:
        assert build_named_simulator(name, ScenarioConfig()).name == name


@pytest.mark.usefixtures("third_party")
def test_registered_simulators_are_listed_and_built():
    assert set(NAMES) < set(simulator_names())
    assert build_named_simulator("lattice", ScenarioConfig()).states == 11
    faster = build_named_simulator("faster", ScenarioConfig(states=7))
    assert (faster.name, faster.states) == ("faster", 7)
    assert build_named_simulator("vectorized", ScenarioConfig()).name == "vectorized"


@pytest.mark.usefixtures("third_party")
def test_what_has_defaults_of_its_own_is_handed_no_scenario_that_it_did_not_ask_for():
    settled = build_named_simulator("settled", ScenarioConfig(states=7))
    assert (settled.name, settled.states) == ("settled", 13)
    assert build_named_simulator("annotated", ScenarioConfig(states=7)).states == 7


@pytest.mark.usefixtures("third_party")
def test_a_registered_environment_that_is_reset_and_stepped_is_a_simulator_that_can_be_sent():
    built = build_named_simulator("stepped", ScenarioConfig())
    assert (built.name, built.states) == ("stepped", 6)
    assert isinstance(built, Simulator)
    assert can_be_sent(built)
    uniforms = np.random.default_rng(1).random((20, 5))
    rollouts = simulate(simulator=built, pem=ToyPem(), proposal=PemProposal(), uniforms=uniforms)
    steps = np.where(rollouts.detected, 1.0, -1.0)
    np.testing.assert_array_equal(np.diff(rollouts.signals["gap"]), steps)


@pytest.mark.usefixtures("third_party")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("latice", "no such simulator; did you mean lattice? There are: vectorized, highway-env, "),
        ("vectorised", "did you mean vectorized?"),
        ("", "simulator = ''"),
        ("failing", "third_party_simulators:failing raises ValueError: no licence for 100 states"),
        ("nothing", "returns nothing, which is no pemviz.Simulator"),
        ("absent", "AttributeError"),
        ("number", "TypeError"),
    ],
)
def test_what_is_wrong_is_one_line(name, words, capsys):
    assert main(["record", "--simulator", name]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1


@pytest.mark.usefixtures("third_party")
def test_another_package_under_the_same_name_is_refused(tmp_path):
    info = tmp_path / "second-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: second\n")
    (info / "entry_points.txt").write_text("[pemviz.simulators]\nlattice = second:build\n")
    importlib.invalidate_caches()
    with pytest.raises(ConfigError, match=r"registered more than once, as .*second:build"):
        build_named_simulator("lattice", ScenarioConfig())


@pytest.mark.usefixtures("third_party")
def test_record_carries_out_a_registered_simulator(tmp_path, capsys):
    """The same car following under another name: the shipped error model fits, a twin is none."""
    words = ["--simulator", "faster", "--method", "mixture", "--stages", "2", "--rollouts", "60"]
    out = ["--final-rollouts", "60", "--seed", "3", "--out", str(tmp_path / "runs")]
    page = tmp_path / "page.md"
    assert main(["record", *words, *out, "--json", "--summary", str(page), "--no-frames"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["config"]["simulator"] == "faster"
    assert document["estimate"]["failures"] > 0
    assert document["data_bound"] is None
    assert "that of the simulator faster" in page.read_text(encoding="utf-8")
    (folder,) = (tmp_path / "runs").iterdir()
    assert (folder / "run.rrd").stat().st_size > 0


@pytest.mark.usefixtures("third_party")
@pytest.mark.parametrize("more", [["--method", "zero-variance"], ["--reference"]])
def test_what_needs_a_twin_is_refused(more, capsys):
    assert main(["record", "--simulator", "faster", *more]) == 2
    assert "needs a fast twin, and simulator 'faster' has none" in capsys.readouterr().err


@pytest.mark.usefixtures("third_party")
def test_the_panel_takes_for_the_braking_scenario_what_has_its_signals_alone():
    config = ExperimentConfig(simulator="faster")
    assert own_scenario(build_experiment(config).problem.simulator, config) is None
    lattice = build_named_simulator("lattice", config.scenario)
    assert own_scenario(lattice, ExperimentConfig(simulator="lattice")) is lattice
