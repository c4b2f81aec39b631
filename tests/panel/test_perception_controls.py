"""What the controls of tracker and position errors say to a run, without a page."""

import pytest

from pemviz.config import ExperimentConfig
from pemviz.config.tracker_text import read_tracker, tracker_options
from pemviz.errors import ConfigError, InputError
from pemviz.panel.experiment_controls import check_back_end, same_tracker


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
