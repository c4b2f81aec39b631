"""Violations an hour or a kilometre: the probability times encounters or over a rollout's way."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.latents import LatentCounts
from pemviz.recording.text import answer_text
from pemviz.reports.answer_words import rate_line, rates_table
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.notebook import result_html
from pemviz.reports.safety_case import safety_case_page
from pemviz.reports.terminal import print_summary, summary_text
from pemviz.runs.engine import run, run_experiment
from pemviz.runs.experiment import build_experiment
from pemviz.runs.rates import distance_rates, violation_rates
from pemviz.runs.result import DrivenDistance, RuleAnswer
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.sampling.rollouts.simulate import NormalSource
from pemviz.types import Signal, StateBatch
from tests.reports.runs import estimate
from tests.reports.runs import result as made_up

KNOWN = {"probability": 0.02, "ci_low": 0.01, "ci_high": 0.04, "log10_probability": -1.69897}
UNSEEN = {"probability": 0.0, "log10_probability": None, "failures": 0, "ci_low": 0.0}
HOURLY = ExperimentConfig(method="mixture", encounters_per_hour=5.0)


def hourly(**changes):
    one = estimate(**{"method": "mixture", "diagnostics": (), **KNOWN, **changes})
    return replace(made_up(one), config=HOURLY, reference=None)


def driven(std_error_km=0.0, **changes):
    distance = DrivenDistance(mean_km=0.2, std_error_km=std_error_km, rollouts=200)
    return replace(hourly(**changes), config=ExperimentConfig(), driven=distance)


def test_rate_and_hours_are_each_others_inverse_ends_included():
    (rate,) = violation_rates(hourly())
    assert (rate.per_hour, rate.low, rate.high) == pytest.approx((0.1, 0.05, 0.2))
    assert (rate.hours_between, rate.hours_low, rate.hours_high) == pytest.approx((10.0, 5.0, 20.0))
    assert rate_line(hourly()) == (
        "With 5 encounters an hour, as the scenario samples them: 0.10 violations an hour (95 % "
        "interval 0.050 to 0.20), one in 10 hours of driving (5.0 to 20)"
    )


def test_a_known_distance_divides():
    (rate,) = distance_rates(driven())
    assert (rate.per_km, rate.low, rate.high) == pytest.approx((0.1, 0.05, 0.2))
    assert (rate.km_between, rate.km_low, rate.km_high) == pytest.approx((10.0, 5.0, 20.0))
    assert violation_rates(driven()) == ()
    assert rate_line(driven()) == (
        "With 0.2 km a rollout: 0.10 violations a kilometre (95 % interval 0.050 to 0.20), "
        "one in 10 kilometres of driving (5.0 to 20)"
    )


def test_what_is_not_known_of_the_distance_widens_the_interval():
    # log-normal factors: widths log 2 and 1.96 * 0.1 add up in squares
    (rate,) = distance_rates(driven(std_error_km=0.02))
    factor = np.exp(np.hypot(np.log(2.0), 0.196))
    assert (rate.per_km, rate.low, rate.high) == pytest.approx((0.1, 0.1 / factor, 0.1 * factor))


def test_each_rule_has_its_own():
    config = HOURLY.with_rules({"gap": "always[0,99] (gap >= 2.0)"})
    rule = RuleAnswer("gap", config.spec, estimate(method="mixture", probability=1e-7, ci_low=None))
    result = replace(hourly(), config=config, rules=(rule,))
    assert [rate.rule for rate in violation_rates(result)] == [None, "gap"]
    assert violation_rates(result)[1].per_hour == pytest.approx(5e-7)
    assert [row[0] for row in rates_table(result).rows] == ["any rule", "gap"]
    assert rates_table(result).rows[1][3] == "2.0e+06"


@pytest.mark.parametrize(
    ("of", "end"),
    [
        (hourly, "an hour brings 0 to 0.20 of them"),
        (driven, "a kilometre brings 0 to 0.20 of them"),
    ],
)
def test_without_a_violation_no_more_is_told_than_the_bound(of, end):
    assert rate_line(of(**UNSEEN)).endswith(f"no violation was seen; {end}")
    (row,) = rates_table(of(**UNSEEN)).rows
    assert row[3:] == ("-", "at least 5.0")
    assert "nothing is known" in rate_line(of(**UNSEEN, ci_high=None))


@pytest.mark.parametrize(
    ("of", "words"), [(hourly, "as the scenario samples them"), (driven, "kilometre")]
)
def test_every_place_tells_it_and_what_it_assumes(of, words, capsys):
    result = of()
    print_summary(result, Path("run"))
    case = CaseRun("run", result, card=None, digests={}, violations=None)
    pages = (
        capsys.readouterr().out, summary_markdown(result), answer_text(result, running=False),
        result_html(result), safety_case_page([case]), summary_text(result),
    )  # fmt: skip
    for page in pages:
        assert "0.050 to 0.20" in page
        assert words in page
    neither = replace(result, config=ExperimentConfig(), driven=None)
    assert "an hour" not in summary_markdown(neither)
    document = json.loads(json.dumps(result_document(result)))
    assert result_from_document(document).driven == result.driven
    if result.driven is not None:
        assert document["per_km"][0]["km_between"] == pytest.approx(10.0)


def test_a_run_tells_it_and_nothing_else_of_it_changes():
    asked = ExperimentConfig(method="naive", final_rollouts=40, measured_memory=False)
    plain, hourly_run = (
        run_experiment(asked),
        run_experiment(replace(asked, encounters_per_hour=2.0)),
    )
    one, other = result_document(plain), result_document(hourly_run)
    assert "encounters_per_hour" not in config_text(asked)
    assert other.pop("per_hour")[0]["per_hour"] == pytest.approx(2.0 * plain.estimate.probability)
    assert other["config"].pop("encounters_per_hour") == 2.0
    assert "2 encounters on average" in other["assumptions"].pop()
    for document in (one, other):
        del document["timings_s"]
    assert one == other
    read = result_from_document(result_document(hourly_run))
    assert violation_rates(read) == violation_rates(hourly_run)


@pytest.mark.parametrize("given", ["0", "-3", "nan", "many", "1e9", "1;rm"])
def test_what_is_no_rate_is_refused(given):
    with pytest.raises(InputError, match="encounters"):
        parse(["--encounters-per-hour", given])


class Drive:
    """Drives 100 m to 300 m, drawn by its own generator, and is violated where it is missed."""

    name, states, dt_s, distance_signal = "drive", 3, 1.0, "way"
    signals = (
        Signal(name="way", key="way_m", unit="m", low=0.0, high=400.0),
        Signal(name="seen", key="seen", unit="", low=-1.0, high=1.0),
    )
    latents = LatentCounts(seeds=1)

    def initial(self, *, count, start):
        own = [np.random.default_rng(abs(int(z * 1e6))).uniform(50.0, 150.0) for z in start[:, 0]]
        way = np.zeros(count)
        signals = {"way": way, "seen": np.ones(count)}
        return StateBatch(step=np.array(0), signals=signals, memory={"each": np.array(own)})

    def step(self, states, detected):
        way = states.signals["way"] + states.memory["each"]
        signals = {"way": way, "seen": np.where(detected, 1.0, -1.0)}
        return StateBatch(step=states.step + 1, signals=signals, memory=states.memory)

    def salient(self, signals):
        return signals["seen"][..., None]


class Coin:
    """Misses one time in four."""

    def logit(self, salient):
        return np.full(salient.shape[:-1], np.log(3.0))


def driving(**changes):
    asked = {"rollouts": 60, "final_rollouts": 300, "stages": 2, "spec": "always[0,2] (seen >= 0)"}
    config = ExperimentConfig(**{**asked, **changes})
    return run(build_experiment(config, simulator=Drive(), pem=Coin()))


@pytest.mark.parametrize("method", ["mixture", "monte-carlo"])
def test_a_run_tells_how_far_it_drove(method):
    """P = 1 - 0.75^2 = 0.4375 in 0.2 km; ten standard errors: a false alarm in 10^20."""
    result = driving(method=method)
    distance = result.driven
    assert distance.mean_km == pytest.approx(0.2, abs=10.0 * distance.std_error_km)
    # uniform: a spread of 200 m / sqrt(12) in 200 rollouts
    assert distance.std_error_km == pytest.approx(0.2 / np.sqrt(12.0 * 200.0), rel=0.2)
    (rate,) = distance_rates(result)
    error = 10.0 * result.estimate.std_error / 0.2 + 10.0 * 0.4375 * distance.std_error_km / 0.04
    assert rate.per_km == pytest.approx(0.4375 / 0.2, abs=error)
    assert result.latents == LatentCounts(seeds=1)


def test_seeds_come_after_what_is_moved_and_are_the_same_for_any_batch():
    counts = LatentCounts(start=2, seeds=1)
    assert str(counts) == "2 at the start and 1 for seeds"
    at_once = NormalSource(np.random.SeedSequence(1), counts=counts, steps=3).draw(6)
    source = NormalSource(np.random.SeedSequence(1), counts=counts, steps=3)
    parts = [source.draw(count).start for count in (1, 2, 3)]
    assert at_once.start.shape == (6, 3)
    np.testing.assert_array_equal(np.concatenate(parts), at_once.start)
