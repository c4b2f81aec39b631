"""What is typed into the Experiment tab, and what it says of it, without a page."""

from dataclasses import replace

import pytest

from pemviz.config import ExperimentConfig, StartChoice
from pemviz.config.ranges import field_docs
from pemviz.config.toml_files import load_preset
from pemviz.config.tracker_text import read_tracker, tracker_options
from pemviz.errors import ConfigError, InputError
from pemviz.panel import experiment_tab
from pemviz.panel.experiment_controls import (
    check_back_end,
    hint,
    limits,
    plain_simulator,
    same_tracker,
)
from pemviz.panel.experiment_tab import read_number, scenario_text


@pytest.mark.parametrize("typed", ["x", "0", "-1", "1.5", "nan", "inf", "1e-400", "1,5", "0x1"])
def test_what_is_no_probability_is_refused(typed):
    with pytest.raises(InputError, match=r"^target = .*: must be above 0 and at most 1, or empty$"):
        read_number(typed, name="target")


def test_probabilities_are_read_as_typed():
    assert read_number(" 1e-9 ", name="target") == 1e-9
    assert read_number("1", name="target") == 1.0
    assert read_number("  ", name="target") is None
    assert read_number("12.5 %", name="precision") == 0.125


def test_everything_that_is_wrong_with_what_was_typed_is_told():
    text = experiment_tab.verdict(["column 21: a number is missing", "target = 'x': must be"])
    assert text.index("column 21") < text.index("target = ")
    assert "understood" not in text
    assert "understood" in experiment_tab.verdict([])


def test_every_control_has_a_hint_with_what_the_field_says():
    docs = field_docs(ExperimentConfig)
    for name in (
        "method", "metric", "alpha", "sigma", "stages", "rollouts", "final_rollouts", "seed",
        "pem", "simulator", "reference", "spec",
    ):  # fmt: skip
        assert len(hint(name)) > 20
        assert hint(name) == docs[name]
    assert limits("alpha", step=0.01) == (0.0, 1.0)
    low, high = limits("sigma", step=0.005)
    assert low == 0.95
    assert high == pytest.approx(0.995)
    with pytest.raises(ValueError, match="declares no bounds"):
        limits("spec", step=1)


def test_the_experiment_tab_says_of_a_logical_scenario_what_it_draws_and_what_it_refuses():
    config = load_preset("cut-in")
    page = scenario_text(replace(config, start=(StartChoice("gap", "uniform(9, 10)"),)))
    assert "a car cuts in ahead of the ego" in page
    assert "uniform(9, 10)" in page
    assert {s.name for s in plain_simulator(config).signals} >= {"clearance", "gap_lead"}
    check_back_end(config)
    with pytest.raises(InputError, match=r"zero-variance.*has latents"):
        check_back_end(replace(config, method="zero-variance"))
    with pytest.raises(InputError, match="start"):
        check_back_end(replace(config, start=(StartChoice("gap", "normal(1"),)))


@pytest.mark.parametrize(
    "text",
    ["2/3", "1/1,filter=kalman", "2/3,coast=0.5,filter=kalman,position-sd=0.1,speed-sd=3.0",
     "3/4,filter=alpha-beta,alpha=0.3333333333333333,beta=0.2"],
)  # fmt: skip
def test_a_filters_options_are_told_as_they_are_read(text):
    settings = read_tracker(text)
    assert settings is not None
    told = ",".join([f"1/1,filter={settings.filter}", *tracker_options(settings)])
    again = read_tracker(told)
    assert again is not None
    assert tracker_options(again) == tracker_options(settings)
    assert len(tracker_options(settings)) == sum("-sd=" in w or "a=" in w for w in text.split(","))


def test_a_tracker_that_means_the_same_keeps_its_words():
    assert same_tracker("2/3,coast=0.5", " 2/3 , coast=0.50") == " 2/3 , coast=0.50"
    assert same_tracker("2/3,coast=0.4", "2/3,coast=0.5") == "2/3,coast=0.4"
    assert same_tracker("4/3", "2/3") == "4/3"
    with pytest.raises(ConfigError, match="4 hits of 3 outcomes"):
        read_tracker("4/3")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position_errors": ""}, "no model of position errors ''; give one of pointpillars"),
        ({"position_errors": "pointrcnn", "method": "zero-variance"}, "runs through all states"),
        ({"position_errors": "pointrcnn", "reference": True}, "reference = true"),
    ],
)
def test_what_does_not_go_with_position_errors_is_told_before_the_run(changes, words):
    with pytest.raises(InputError, match=words) as caught:
        check_back_end(ExperimentConfig(**changes))
    assert "\n" not in str(caught.value)
    check_back_end(ExperimentConfig(position_errors="pointrcnn"))
