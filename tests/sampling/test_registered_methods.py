"""Methods that other packages register run like shipped ones; what is wrong is one line."""

import importlib
import json
import sys

import pytest

from pemviz.cli.main import main
from pemviz.config import METHODS, ExperimentConfig
from pemviz.config.toml_files import config_text, load_config
from pemviz.errors import ConfigError
from pemviz.panel import learning_page, why_page
from pemviz.panel.loading import load_run
from pemviz.runs.back_ends import check_method_fits, own_back_end
from pemviz.runs.engine import run_experiment
from pemviz.sampling.registry import by_name
from tests.recording.read_back import read_stages
from tests.toy import MissCounter

MODULE = '''
"""A method of a third party: independent batches of rollouts drawn with a constant."""

from dataclasses import replace

import pemviz
from pemviz.proposals.fixed import ConstantProposal
from pemviz.sampling.description import final_budget, with_final_budget
from pemviz.sampling.direct.method import DirectSampling


def coin(config, back_end):
    return DirectSampling(
        name="coin",
        proposal=ConstantProposal(detection_probability=config.naive_detection_probability),
        rollouts=config.final_rollouts,
        seed=config.seed,
    )


def failing(config, back_end):
    raise ValueError(f"no licence\\nfor {back_end.simulator.name}")


COIN = pemviz.MethodDescription(
    name="coin",
    summary="the naive method under another name",
    build=coin,
    settings=frozenset({"final_rollouts", "naive_detection_probability"}),
    budget=final_budget,
    with_budget=with_final_budget,
    stages="parts",
    curve_name="the coin <b>",
    learning_words="A coin is thrown & <i>nothing</i> is learned.",
)
FAILING = replace(COIN, name="failing", build=failing)
HOLLOW = replace(COIN, name="hollow", build=lambda config, back_end: object())
GAPLESS = replace(COIN, name="gapless", needs=frozenset({"gap", "twin"}))
NUMBER = 3
SHADOW = replace(COIN, name="naive", build=failing)
'''
BROKEN = """
from dataclasses import replace

from third_party_methods import COIN

RESTLESS = replace(COIN, settings=frozenset({"momentum"}))
"""
NAMES = {
    "coin": "third_party_methods:COIN",
    "failing": "third_party_methods:FAILING",
    "hollow": "third_party_methods:HOLLOW",
    "gapless": "third_party_methods:GAPLESS",
    "number": "third_party_methods:NUMBER",
    "class": "third_party_methods:ConstantProposal",
    "absent": "third_party_methods:NO_SUCH_NAME",
    "token": "third_party_methods:COIN",
    "restless": "third_party_broken:RESTLESS",
    "naive": "third_party_methods:SHADOW",
}
SMALL = ["--no-plan", "--no-measured-memory", "--final-rollouts", "60", "--seed", "3"]


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """A package with methods, as pip would have installed it into another folder."""
    (tmp_path / "third_party_methods.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "third_party_broken.py").write_text(BROKEN, encoding="utf-8")
    register(tmp_path, "third_party_methods", NAMES)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield tmp_path
    for module in ("third_party_methods", "third_party_broken"):
        sys.modules.pop(module, None)


def register(folder, package, names):
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\n")
    points = "\n".join(f"{name} = {to}" for name, to in names.items())
    (info / "entry_points.txt").write_text(f"[pemviz.methods]\n{points}\n")


@pytest.mark.usefixtures("third_party")
def test_registered_methods_are_listed_after_the_shipped_ones():
    names = METHODS.names()
    assert names[: len(METHODS.shipped)] == METHODS.shipped
    assert set(NAMES) < set(names)
    assert len(names) == len(set(names))
    assert by_name("coin").summary == "the naive method under another name"
    assert by_name("naive").summary != by_name("coin").summary


@pytest.mark.usefixtures("third_party")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("coim", "method = 'coim': no such method; did you mean coin? There are: auto, adaptive, "),
        ("adaptiv", "did you mean adaptive?"),
        ("", "method = ''"),
        ("failing", "building it raises ValueError: no licence for vectorized"),
        ("hollow", "what is built has no name and no stages and no init"),
        ("number", "third_party_methods:NUMBER is a value of type int, which is no pemviz.Method"),
        ("class", "is the class ConstantProposal, which is no pemviz.MethodDescription"),
        ("absent", "AttributeError"),
        ("token", "what is registered describes method 'coin'"),
        ("restless", "raises ValueError: settings momentum: a configuration has no such field"),
    ],
)
def test_what_is_wrong_is_one_line(name, words, capsys, tmp_path):
    assert main(["record", "--method", name, "--out", str(tmp_path / "runs")]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("third_party")
def test_another_package_under_the_same_name_is_refused(tmp_path):
    register(tmp_path, "second_methods", {"coin": "second_methods:COIN"})
    importlib.invalidate_caches()
    with pytest.raises(ConfigError, match=r"registered more than once, as .*second_methods:COIN"):
        by_name("coin")


def test_a_file_that_names_a_method_that_is_not_here_is_refused(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(config_text(ExperimentConfig(method="coin")), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"config .*: method = 'coin': no such method; .*naive"):
        load_config(path)


@pytest.mark.usefixtures("third_party")
def test_what_a_registered_method_needs_must_be_there():
    config = ExperimentConfig(method="gapless")
    with pytest.raises(ConfigError, match="method = 'gapless': needs a fast twin, and simulator"):
        check_method_fits(config, own_back_end(MissCounter(states=7)))


@pytest.mark.usefixtures("third_party")
def test_record_carries_out_a_registered_method(tmp_path, capsys):
    """The naive method under another name gives its numbers, in every report and view."""
    page, tests = tmp_path / "page.md", tmp_path / "tests.xml"
    words = [*SMALL, "--out", str(tmp_path / "runs"), "--no-frames", "--json"]
    reports = ["--summary", str(page), "--junit", str(tests)]
    assert main(["record", "--method", "coin", *words, *reports]) == 0
    document = json.loads(capsys.readouterr().out)
    config = ExperimentConfig(
        method="naive", final_rollouts=60, seed=3, plan=False, measured_memory=False
    )
    known = run_experiment(config)
    assert document["estimate"]["method"] == document["config"]["method"] == "coin"
    assert document["estimate"]["probability"] == known.estimate.probability
    assert document["estimate"]["ci_high"] == known.estimate.ci_high
    assert "| budget | 60 rollouts, naive_detection_probability 0.5 |" in page.read_text()
    assert 'value="coin"' in tests.read_text(encoding="utf-8")
    (folder,) = (tmp_path / "runs").iterdir()
    assert list(read_stages(folder / "run.rrd")) == [0]
    loaded = load_run(folder)
    shown = learning_page.learning(loaded)
    assert "A coin is thrown &amp; &lt;i&gt;nothing&lt;/i&gt; is learned." in shown
    assert "the coin <b>" in {mark.label for mark in learning_page.proposal_chart(loaded).marks}
    assert "Pareto k-hat" in why_page.why(loaded)
