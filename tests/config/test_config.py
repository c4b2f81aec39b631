import math
from dataclasses import fields, replace

import pytest
import tyro
from hypothesis import given
from hypothesis import strategies as st

from pemviz.config import LOGICAL_SCENARIOS, ExperimentConfig, ScenarioConfig
from pemviz.config.ranges import Range
from pemviz.config.toml_files import (
    config_from_table,
    config_table,
    config_text,
    load_config,
    load_preset,
    preset_names,
)
from pemviz.errors import ConfigError
from pemviz.runs.experiment import build_experiment


def test_presets_are_the_designs():
    paper, town = load_preset("paper"), load_preset("town01")
    assert preset_names(logical_scenarios=False) == ("paper", "paper-algorithm", "town01")
    for logical_scenario in LOGICAL_SCENARIOS:
        config = load_preset(logical_scenario)
        assert (config.encounter.logical_scenario, config.assumed_memory_s) == (
            logical_scenario,
            0.25,
        )
        assert f"always[0,{config.encounter.states - 1}]" in config.rules[0].formula
    assert load_preset("paper-algorithm") == ExperimentConfig(method="adaptive")
    assert paper == ExperimentConfig(plan=True)
    assert paper.method == "auto"
    assert paper.scenario.initial_speed_mps == pytest.approx(70 / 3.6)
    assert town.scenario == replace(
        paper.scenario,
        initial_speed_kmh=30.0, lead_deceleration_mps2=8.0, maximum_acceleration_mps2=2.0,
    )  # fmt: skip


@given(
    alpha=st.floats(0, 1),
    sigma=st.floats(0.95, 1, exclude_max=True),
    gap_m=st.floats(0.1, 25),
    dt_s=st.floats(0.001, 1),
    seed=st.integers(0, 2**63 - 1),
    spec=st.text(max_size=40),
)
def test_config_text_reads_back(tmp_path_factory, alpha, sigma, gap_m, dt_s, seed, spec):
    config = ExperimentConfig(
        alpha=alpha, sigma=sigma, seed=seed, spec=spec,
        scenario=ScenarioConfig(initial_gap_m=gap_m, dt_s=dt_s),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("config") / "config.toml"
    path.write_text(config_text(config), encoding="utf-8", newline="")
    assert load_config(path) == config
    assert config_from_table(config_table(config)) == config


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"sigma": 1.0}, "sigma = 1.0: must be a number, at least 0.95 and below 1"),
        ({"sigma": 0.5}, "sigma = 0.5: must be a number, at least 0.95 and below 1"),
        ({"alpha": math.nan}, "alpha = nan: must be a number, at least 0 and at most 1"),
        ({"stages": 2.5}, "stages = 2.5: must be a whole number, at least 1 and at most 1000"),
        ({"stages": True}, "stages = True: must be a whole number, at least 1 and at most 1000"),
        ({"metric": "agn"}, "metric = 'agn': must be one of classical, agm, smooth-cumulative"),
        ({"sigam": 0.95}, "sigam: no such field; did you mean sigma?"),
        ({"scenario": {"dt": 1}}, "scenario.dt: no such field; did you mean dt_s?"),
        ({"scenario": 3}, "scenario = 3: must be a table"),
        ({"spec": 3}, "spec = 3: must be a text"),
    ],
)  # fmt: skip
def test_wrong_values_are_named_with_what_is_allowed(table, message):
    with pytest.raises(ConfigError) as caught:
        config_from_table(table)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"spec": "always[0,100] (gap >= 2.0)"}, "looks 100 steps ahead"),
        ({"spec": "always[0,9] (gap >= "}, "line 1"),
        ({"spec": "always[0,9] (gapp >= 2)"}, "gap"),
        ({"pem": "no-such-model"}, "no-such-model"),
        ({"pem": "  "}, "pem = ''"),
        ({"metric": "agm", "scenario": ScenarioConfig(initial_gap_m=30.0)}, "gap reaches"),
        ({"target": 0.0}, "target = 0.0: must be a number, above 0 and at most 1"),
        ({"metric": "agm", "scenario": ScenarioConfig(states=150)}, "raise scenario.gap_bound_m"),
        (
            {"metric": "agm", "scenario": ScenarioConfig(speed_bound_mps=15.0)},
            "beyond its bounds 0 to 15",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused_before_anything_runs(changes, fragment):
    with pytest.raises(ConfigError.__mro__[1]) as caught:
        build_experiment(replace(ExperimentConfig(), **changes))
    assert fragment in str(caught.value)
    assert "\n" not in str(caught.value) or changes.get("spec")


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("alpha = = 1")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(tmp_path / "bad.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_config(tmp_path / "binary.toml")


@given(st.floats(allow_nan=True), st.booleans(), st.booleans())
def test_range_agrees_with_comparison(value, low_open, high_open):
    limits = Range(low=-1.0, high=2.0, low_open=low_open, high_open=high_open)
    above = value > -1.0 if low_open else value >= -1.0
    below = value < 2.0 if high_open else value <= 2.0
    assert limits.contains(value) == (above and below)


@pytest.mark.parametrize("kind", [ExperimentConfig, ScenarioConfig])
def test_every_field_is_an_option_that_explains_itself(kind, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--help"])
    helptext = capsys.readouterr().out
    for field in fields(kind):
        if field.name in (
            "scenario",
            "encounter",
            "rules",
            "start",
        ):  # rules are given one by one, with --rule
            continue
        option = f"--{field.name.replace('_', '-')}"
        assert option in helptext
        explained = " ".join(helptext.split(option, 1)[1].split("(default")[0].split())
        assert len(explained) > 20, option
