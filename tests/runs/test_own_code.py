"""A result says which code of the user's own it rests on."""

import hashlib
from dataclasses import replace
from pathlib import Path

import gymnasium

import pemviz
from pemviz.config.toml_files import config_table, config_text
from pemviz.runs.own_code import innermost
from pemviz.runs.reading import read_whole_run
from pemviz.runs.run_folder import record
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
