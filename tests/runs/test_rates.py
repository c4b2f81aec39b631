"""Violations an hour of driving: the probability times the encounters an hour, in every place."""

from dataclasses import replace
from pathlib import Path

import pytest

from pemviz.cli.record_arguments import parse
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_text
from pemviz.errors import InputError
from pemviz.recording.text import answer_text
from pemviz.reports.answer_words import rate_line, rates_table
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.notebook import result_html
from pemviz.reports.safety_case import safety_case_page
from pemviz.reports.terminal import print_summary, summary_text
from pemviz.runs.engine import run_experiment
from pemviz.runs.rates import violation_rates
from pemviz.runs.result import RuleAnswer
from pemviz.runs.result_file import result_document, result_from_document
from tests.reports.runs import estimate
from tests.reports.runs import result as made_up

FREQUENT = {"probability": 0.02, "ci_low": 0.01, "ci_high": 0.04, "log10_probability": -1.69897}
HOURLY = ExperimentConfig(method="mixture", encounters_per_hour=5.0)


def hourly(**changes):
    one = estimate(**{"method": "mixture", "diagnostics": (), **FREQUENT, **changes})
    return replace(made_up(one), config=HOURLY, reference=None)


def test_rate_and_hours_are_each_others_inverse_ends_included():
    (rate,) = violation_rates(hourly())
    assert (rate.per_hour, rate.low, rate.high) == pytest.approx((0.1, 0.05, 0.2))
    assert (rate.hours_between, rate.hours_low, rate.hours_high) == pytest.approx((10.0, 5.0, 20.0))
    assert rate_line(hourly()) == (
        "With 5 encounters an hour, as the scenario draws them: 0.10 violations an hour (95 % "
        "interval 0.050 to 0.20), one in 10 hours of driving (5.0 to 20)"
    )


def test_each_rule_has_its_own():
    config = HOURLY.with_rules({"gap": "always[0,99] (gap >= 2.0)"})
    rule = RuleAnswer("gap", config.spec, estimate(method="mixture", probability=1e-7, ci_low=None))
    result = replace(hourly(), config=config, rules=(rule,))
    assert [rate.rule for rate in violation_rates(result)] == [None, "gap"]
    assert violation_rates(result)[1].per_hour == pytest.approx(5e-7)
    assert [row[0] for row in rates_table(result).rows] == ["any rule", "gap"]
    assert rates_table(result).rows[1][3] == "2.0e+06"


def test_without_a_violation_no_more_is_told_than_the_bound():
    unseen = {"probability": 0.0, "log10_probability": None, "failures": 0, "ci_low": 0.0}
    line = rate_line(hourly(**unseen))
    assert line.endswith("no violation was seen; an hour brings 0 to 0.20 of them")
    (row,) = rates_table(hourly(**unseen)).rows
    assert row[3:] == ("-", "at least 5.0")
    assert "nothing is known" in rate_line(hourly(**unseen, ci_high=None))


def test_every_place_tells_it_and_what_it_assumes(capsys):
    result = hourly()
    print_summary(result, Path("run"))
    run = CaseRun("run", result, card=None, digests={}, violations=None)
    pages = (
        capsys.readouterr().out, summary_markdown(result), answer_text(result, running=False),
        result_html(result), safety_case_page([run]), summary_text(result),
    )  # fmt: skip
    for page in pages:
        assert "0.050 to 0.20" in page
        assert "as the scenario draws them" in page
    assert "an hour" not in summary_markdown(replace(result, config=ExperimentConfig()))


def test_a_run_tells_it_and_nothing_else_of_it_changes():
    asked = ExperimentConfig(method="naive", final_rollouts=40)
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
