"""A result says which code of the user's own it rests on."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium
import pytest

import pemviz
from pemviz.config.toml_files import config_table, config_text
from pemviz.runs.events import StageDone
from pemviz.runs.own_code import innermost
from pemviz.runs.reading import read_whole_run
from pemviz.runs.run_folder import OTHER_CODE, record
from pemviz.simulators.latents import parts_of
from tests.lattice_walk import ToyPem, ToySimulator
from tests.simulators.test_episodic import Crossing, WalkEpisodes

CONFIG = pemviz.ExperimentConfig(method="monte-carlo", spec="always[0,5] (gap >= 0.5)")


def test_name_steps_class_and_digest_of_its_file(tmp_path):
    experiment = pemviz.build_experiment(CONFIG, simulator=ToySimulator(), pem=ToyPem())
    record(experiment, tmp_path)
    found = read_whole_run(tmp_path).simulator
    assert (found.name, found.states, found.dt_s) == ("toy", 15, 1.0)
    assert found.code == "tests.lattice_walk.ToySimulator"
    source = Path(__file__).parents[1] / "lattice_walk.py"
    assert found.source_digest == hashlib.sha256(source.read_bytes()).hexdigest()
    assert found.package is None


def test_a_run_goes_on_in_its_folder_and_says_that_its_simulator_was_changed(tmp_path, monkeypatch):
    config = replace(CONFIG, method="mixture", stages=2, rollouts=20, final_rollouts=20)
    experiment = pemviz.build_experiment(config, simulator=ToySimulator(), pem=ToyPem())
    stages = []

    class Counts:
        def notify(self, event):
            stages.extend([event] * isinstance(event, StageDone))

    def is_over():
        return len(stages) == 2

    stopped = pemviz.record(
        experiment, str(tmp_path / "a" / "run"), observers=[Counts()], should_stop=is_over
    )
    assert stopped.status == "stopped"
    for path in ("b", "c"):
        shutil.copytree(tmp_path / "a", tmp_path / path)
    same = pemviz.record(experiment, tmp_path / "b" / "run")
    assert same.status == "done"
    assert not [warning for warning in same.warnings if OTHER_CODE in warning]
    assert same.timings_s["total"] > stopped.timings_s["total"]
    monkeypatch.setattr("pemviz.runs.own_code.file_digest", lambda _: "another")
    changed = pemviz.record(experiment, tmp_path / "c" / "run")
    assert changed.estimate == same.estimate
    told = f"{OTHER_CODE}: 2 stages are from before"
    assert sorted(changed.warnings) == sorted((*same.warnings, told))
    again = pemviz.record(experiment, tmp_path / "c" / "run")  # it is not forgotten
    assert again.warnings == changed.warnings


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    experiment = pemviz.build_experiment(CONFIG, simulator=ToySimulator(), pem=ToyPem())
    with pytest.raises(pemviz.InputError, match=r"^run .*file.run: cannot be made"):
        pemviz.record(experiment, tmp_path / "file" / "run")


def test_what_is_wrapped_is_looked_into():
    episodes = pemviz.side_by_side(WalkEpisodes, 3)
    assert type(innermost(episodes)) is WalkEpisodes
    tracker = pemviz.Tracker(dt_s=1.0, coast_s=1.0)
    assert type(innermost(pemviz.tracked(ToySimulator(), tracker))) is ToySimulator
    adapter = pemviz.GymnasiumEpisodes(
        environment=Crossing(), signals=(), observe=dict, states=3, dt_s=1.0
    )
    assert type(innermost(adapter)) is Crossing


def test_the_braking_scenario_stands_in_settings_where_it_is_run():
    own = replace(CONFIG, simulator="toy")
    assert "scenario" in config_table(CONFIG)
    assert "scenario" not in config_text(own)
    changed = replace(own, scenario=pemviz.ScenarioConfig(dt_s=0.1))
    assert config_table(changed)["scenario"]["dt_s"] == 0.1
    assert pemviz.run(pemviz.build_experiment(CONFIG)).simulator is None


def test_a_users_own_wrapper_is_what_is_named():
    class Mine(gymnasium.Wrapper):
        """What a user puts about an environment."""

    class Holds:
        environment = Crossing()

    wrapped = gymnasium.wrappers.OrderEnforcing(Mine(Crossing()))
    adapter = pemviz.GymnasiumEpisodes(
        environment=wrapped, signals=(), observe=dict, states=3, dt_s=1.0
    )
    assert type(innermost(adapter)) is Mine
    assert type(innermost(Holds())) is Holds


def test_what_holds_itself_is_one_part():
    class Loop:
        """Its own scenario."""

    loop = Loop()
    loop.scenario = loop
    assert list(parts_of(loop)) == [loop]
