"""The analysis over the scene: weights, least gaps, other models' answers, runs side by side."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from pemviz.analysis.model_uncertainty import ModelClassAnswer
from pemviz.errors import InputError
from pemviz.panel import compare_tab, headline, learning_tab, page, weights_tab, why_tab
from pemviz.panel.curve_chart import over_common
from pemviz.panel.experiment_tab import read_number
from pemviz.panel.ranking import shares
from pemviz.reports.charts import models_chart
from tests.panel.test_views import well_formed, with_result


def test_the_least_gap_is_below_two_metres_with_the_probability_of_the_answer(naive_run):
    """Where the specification is gap >= 2.0, a least gap below 2 m is a violation."""
    gaps = weights_tab.least_gaps(naive_run)
    below = np.searchsorted(gaps.gap_m, 2.0)
    estimate = naive_run.result.estimate
    assert 10.0 ** gaps.log10_probability[below - 1] == pytest.approx(
        estimate.probability, rel=1e-9
    )
    assert gaps.sampled[below - 1] == pytest.approx(estimate.failures / 60)
    assert gaps.sampled[-1] == pytest.approx(1.0)


def test_least_gaps_against_a_sum_over_rollouts(naive_run):
    gaps = weights_tab.least_gaps(naive_run)
    least = naive_run.rollouts["gap_m"].min(axis=1)
    for place in (0, 10, 59):
        inside = least <= gaps.gap_m[place]
        total = math.fsum(np.exp(naive_run.log_weight[inside])) / 60
        assert gaps.log10_probability[place] == pytest.approx(math.log10(total), abs=1e-9)


def test_only_final_stages_tell_of_the_least_gap(loaded_run):
    gaps = weights_tab.least_gaps(loaded_run)
    assert gaps.gap_m.size == loaded_run.config.final_rollouts
    assert loaded_run.kept > gaps.gap_m.size


def test_the_points_drawn_hold_those_that_carry_the_answer(loaded_run):
    share = shares(loaded_run)
    few = weights_tab.drawn_points(loaded_run, most=20)
    assert few.size == 20
    heaviest = np.argsort(-share, kind="stable")[:10]
    assert set(heaviest.tolist()) <= set(few.tolist())
    robustness = loaded_run.rollouts["robustness"]
    assert robustness[few].max() == robustness.max()
    np.testing.assert_array_equal(weights_tab.drawn_points(loaded_run), np.arange(loaded_run.kept))


def test_every_point_bears_the_number_that_a_click_writes(loaded_run):
    drawn = weights_tab.weights_page(loaded_run, target="box", selected=7)
    numbers = re.findall(r"data-number='(\d+)'", drawn)
    assert sorted(map(int, numbers)) == list(range(loaded_run.kept))
    assert drawn.count("data-target='box'") == 1
    assert "data-shown='7'" in drawn
    assert "data-shown" not in weights_tab.weights_page(loaded_run, target="box", selected=10**6)


def test_the_gaps_drawn_are_those_of_the_heaviest(loaded_run):
    curves = weights_tab.heaviest_curves(loaded_run)
    heaviest = int(np.argmax(shares(loaded_run)))
    np.testing.assert_array_equal(curves.lines[0].values, loaded_run.rollouts["gap_m"][heaviest])
    assert weights_tab.heaviest_curves(replace(loaded_run, running=True)) is None


def test_every_refit_and_model_class_has_a_mark(naive_run):
    interval = replace(naive_run.result.pem_interval, log10_answers=(-9.0, -8.5, None, -3.0))
    model_class = ModelClassAnswer("lr", 1e-6, -6.0, 0.1, effective_failures=2.0)
    result = replace(naive_run.result, pem_interval=interval, model_classes=(model_class,))
    _, refits, other, *_ = models_chart(result).rows
    assert [math.log10(value) for value in refits.values] == pytest.approx([-9.0, -8.5, -3.0])
    assert (other.name, other.values) == ("lr (rough)", (1e-6,))
    assert "lr (rough)" in why_tab.why(with_result(naive_run, model_classes=(model_class,)))
    assert models_chart(replace(result, model_classes=(), pem_interval=None)) is None


def test_a_run_keeps_the_answers_of_its_refits(naive_run):
    interval = naive_run.result.pem_interval
    answers = interval.log10_answers
    assert len(answers) == interval.members
    assert list(answers) == sorted(answers)
    # the interval that is told interpolates between them
    assert answers[0] <= math.log10(interval.low) <= answers[1]
    assert answers[-2] <= math.log10(interval.high) <= answers[-1]


def test_runs_side_by_side_show_every_setting_that_differs(live_run, naive_run):
    rules = {"near": "gap > 2"}
    other = replace(live_run.config.with_rules(rules), position_errors="pointrcnn")
    third = replace(naive_run, result=replace(naive_run.result, config=other))
    runs = [naive_run, live_run, third]
    settings, estimates = well_formed(compare_tab.runs_page(runs)).iter("table")
    cells = {row[0].text: [cell.text for cell in row[1:]] for row in settings.iter("tr")}
    assert cells["method"] == ["naive", "adaptive", "adaptive"]
    assert cells["final_rollouts"] == ["60", "40", "40"]
    assert cells["rules.near"] == ["–", "–", "gap > 2"]
    assert cells["position_errors"] == ["–", "–", "pointrcnn"]
    assert not {"seed", "alpha"} & cells.keys()
    assert len(list(estimates.iter("tr"))) == 4
    names = [line.name for line in compare_tab.run_curves(runs).lines]
    assert names.count("error model ml-nn") == 1
    assert compare_tab.run_curves(runs[:1]) is None
    assert "up to six" in compare_tab.runs_page(runs[:1])


def test_proposals_drawn_are_the_first_the_newest_and_some_between(loaded_run):
    names = [line.name for line in learning_tab.proposal_curves(loaded_run).lines]
    assert names[0] == f"proposal after stage {loaded_run.final_curves[-1].stage}"
    assert names[-1] == "error model (ml-nn)"
    many = replace(
        loaded_run, curves=tuple(replace(loaded_run.curves[0], stage=s) for s in range(40))
    )
    stages = [
        line.name.rsplit(" ", 1)[-1] for line in learning_tab.proposal_curves(many).lines[:-1]
    ]
    assert len(stages) == 6
    assert (stages[0], stages[-1]) == ("39", "0")


def test_lines_end_where_they_are_known():
    x = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    own, y = np.array([0.5, 1.5, 2.5, 3.5]), np.array([np.nan, 1.0, 3.0, np.nan])
    line = over_common(x, own, y)
    np.testing.assert_array_equal(line, [np.nan, np.nan, 2.0, np.nan, np.nan])
    assert np.isnan(over_common(x, own, np.full(4, np.nan))).all()


@pytest.mark.parametrize("typed", ["x", "0", "-1", "1.5", "nan", "inf", "1e-400", "1,5", "0x1"])
def test_what_is_no_probability_is_refused(typed):
    with pytest.raises(InputError, match=r"^target = .*: must be above 0 and at most 1, or empty$"):
        read_number(typed, name="target")


def test_probabilities_are_read_as_typed():
    assert read_number(" 1e-9 ", name="target") == 1e-9
    assert read_number("1", name="target") == 1.0
    assert read_number("  ", name="target") is None


def test_counts_are_whole_numbers_however_large(naive_run):
    large = {"rollouts_in_estimate": 1_000_000, "rollouts_simulated": 12_000_000, "failures": 3}
    run = with_result(naive_run, estimate=replace(naive_run.result.estimate, **large))
    shown = headline.headline(run)
    assert "3 of 1000000 rollouts" in shown
    assert "12000000 simulated" in shown


def test_the_answer_is_judged_by_a_limit(naive_run):
    assert "Gate" not in headline.headline(naive_run)
    assert "passed" not in headline.headline(naive_run, limit=1e-300)
    estimate = replace(naive_run.result.estimate, diagnostics=(), ci_high=1e-6)
    run = with_result(naive_run, estimate=estimate, reference=None)
    assert "Gate passed: " in headline.headline(run, limit=1e-5)
    assert "Gate tripped: " in headline.headline(run, limit=1e-7)


def test_the_sheet_names_every_class_that_pages_use():
    for name in (page.ANALYSIS, page.ROLLOUT, page.PLOTS, page.SPEEDS, page.WIDE, page.CELL):
        assert f".{name}" in page.SHEET
    assert page.SHEET.count("{") == page.SHEET.count("}")
    assert page.cell("") == page.wide("") == ""
