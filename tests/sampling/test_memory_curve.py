"""The failure probability over memory times, against all chains of outcomes."""

import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pemviz.charts.svg import svg
from pemviz.config import ExperimentConfig
from pemviz.proposals.offset_logistic import SignalFeatures
from pemviz.recording.text import answer_text
from pemviz.reports.charts import memory_chart
from pemviz.reports.memory_words import (
    BY_MEMORY_TIME,
    assumption_line,
    curve_table,
    measured_names,
)
from pemviz.runs.engine import run_experiment
from pemviz.runs.result import MeasuredTau, RunMemory
from pemviz.runs.result_file import result_document, result_from_document
from pemviz.sampling.bursts.curve import (
    ALIKE_S,
    SHOWN_S,
    CurvePoint,
    frailty_curve,
    memory_curve,
)
from pemviz.sampling.mixture.balance_heuristic import Pool
from pemviz.types import Diagnostic
from tests.lattice_walk import toy_problem_of, toy_robustness
from tests.sampling.test_memory import PEM, SIMULATOR, by_enumeration

PROBLEM = toy_problem_of(SIMULATOR, PEM)


def curve_of(problem=PROBLEM, **options):
    features = SignalFeatures(SIMULATOR.signals)
    return memory_curve(problem, pem=PEM, features=features, seed=5, **options)


def test_one_set_of_rollouts_serves_every_memory_time():
    """Twice the 95 % interval's half width: seeds are fixed, a false alarm in 1e4 a point."""
    points = curve_of(also_s=(2.0, 5.0))
    assert [point.tau_s for point in points] == [*SHOWN_S, 2.0, 5.0]
    for point in points:
        truth = by_enumeration(SIMULATOR, PEM, tau_s=point.tau_s)
        assert point.low < point.probability < point.high
        half = math.log(point.high / point.low) / 2
        assert abs(math.log(point.probability / truth)) < 2 * half, point
        assert half < 0.5


def test_its_error_has_what_corrections_for_fitted_rollouts_leave_open(monkeypatch):
    """As that of the answer; variances add up."""

    def variances(correction_error):
        if correction_error is not None:
            monkeypatch.setattr(Pool, "correction_error", correction_error)
        halves = [math.log(point.probability / point.low) / 1.959964 for point in curve_of()]
        return np.expm1(np.square(halves))

    own = variances(None)
    of_sampling, both = variances(0.0), variances(0.3)
    np.testing.assert_allclose(both - of_sampling, 0.3**2, rtol=1e-4)
    assert (own > of_sampling).all()


def test_the_curve_does_not_depend_on_the_batch_size():
    assert curve_of() == curve_of(replace(PROBLEM, batch_rollouts=17))


def test_a_specification_that_nothing_violates_has_a_curve_of_zeros():
    problem = replace(
        PROBLEM, violated=lambda signals: toy_robustness(signals) < -99.0, unsafe=None
    )
    for point in curve_of(problem):
        assert (point.probability, point.low, point.high, point.ess) == (0.0, None, None, None)


SHORT = ExperimentConfig(
    method="naive", final_rollouts=40, spec="always[0,29] (gap >= 9.0)", memory_curve=True,
    measured_memory=False,
    scenario=replace(ExperimentConfig().scenario, states=30, initial_gap_m=10.5),
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _few_rollouts():
    """In runs the curve is told from a tenth of its rollouts: how well, is tested above."""
    with pytest.MonkeyPatch.context() as patch:
        few = partial(memory_curve, rollouts=240)
        patch.setattr("pemviz.sampling.bursts.curve.memory_curve", few)
        few = partial(frailty_curve, rollouts=240)
        patch.setattr("pemviz.sampling.bursts.curve.frailty_curve", few)
        yield


@pytest.fixture(scope="module")
def result():
    return run_experiment(SHORT)


def beside(result, *own_s):
    """The points of the curve but those at the memory times of runs' own answers."""
    return [point for point in result.memory.curve if point.tau_s not in own_s]


def test_a_run_tells_the_curve_whatever_its_own_memory(result):
    other = run_experiment(replace(SHORT, memory_s=0.15))
    assert beside(other, 0.0, 0.15) == beside(result, 0.0, 0.15)
    assert other.memory.tau_s == 0.15
    assert {*SHOWN_S, *ALIKE_S.values()} == {point.tau_s for point in result.memory.curve}
    assert result_from_document(result_document(other)) == other


def test_a_run_with_frailty_tells_both_curves_through_its_own_place():
    memory = run_experiment(replace(SHORT, memory_s=0.15, frailty=0.5)).memory
    assert {point.frailty for point in memory.curve} == {0.5}
    assert {point.tau_s for point in memory.frailty_curve} == {0.15}
    of_curve, of_frailties = (
        [point for point in curve if (point.tau_s, point.frailty) == (0.15, 0.5)]
        for curve in (memory.curve, memory.frailty_curve)
    )
    assert len(of_curve) == len(of_frailties) == 1


def test_the_black_box_is_told_from_its_twin(result):
    found = run_experiment(replace(SHORT, simulator="highway-env", final_rollouts=4))
    assert beside(found, 0.0) == beside(result, 0.0)


@pytest.mark.parametrize(("method", "holds"), [("monte-carlo", True), ("adaptive", False)])
def test_where_the_answer_is_to_be_trusted_the_curve_goes_through_it(method, holds):
    answered = run_experiment(replace(SHORT, method=method, final_rollouts=400, stages=1, epochs=2))
    (own,) = [point for point in answered.memory.curve if point.tau_s == 0.0]
    estimate = answered.estimate
    goes_through = (own.probability, own.low, own.high) == (
        estimate.probability, estimate.ci_low, estimate.ci_high
    )  # fmt: skip
    assert goes_through == holds


def test_the_result_says_what_the_assumption_is_worth(result):
    line = assumption_line(result.memory)
    assert line.startswith("That misses are independent given the state is an assumption: this")
    assert "RRC" in line
    assert "PointRCNN" in line
    assert assumption_line(replace(result.memory, curve=())) is None
    measured = {row[0]: row[3] for row in curve_table(result.memory, BY_MEMORY_TIME).rows}
    assert measured["0.3 s"].startswith("RRC")
    assert measured["independent"] == ""


def test_orders_of_magnitude_and_thin_intervals_are_said():
    def point(tau_s, probability, *diagnostics):
        ends = probability / 2, probability * 2
        return CurvePoint(tau_s, probability, *ends, 50.0, diagnostics)

    tail = Diagnostic("heavy-tail", 0.81, 0.7, "the weights' tail is too heavy")
    curve = (point(0.0, 1e-15, tail), point(0.17, 1e-4), point(0.3, 1e-3), point(0.5, 2e-3))
    own = MeasuredTau(tau_s=0.5, low_s=0.4, high_s=0.6, confidence=0.95)
    memory = RunMemory(tau_s=0.0, curve=curve)
    assert assumption_line(memory).endswith("changes the answer by 12 orders of magnitude.")
    table = curve_table(memory, BY_MEMORY_TIME)
    assert table.rows[0][2].endswith("not a 95 % interval, Pareto k-hat is 0.81")
    assert table.columns[2] == "interval"
    others = curve_table(replace(memory, curve=curve[1:]), BY_MEMORY_TIME)
    assert others.columns[2] == "95 % interval"
    measured = assumption_line(replace(memory, fitted=own))
    assert "single frames" not in measured
    assert "0.002 with that of this error model (0.5 s)" in measured
    assumed = assumption_line(replace(memory, tau_s=0.17))
    assert assumed.startswith("A memory time of 0.17 s is an assumption")
    assert "1e-15 if misses were independent" in assumed


def test_panel_and_recording_show_the_curve_beside_the_answer(result):
    drawn = svg(memory_chart(result.memory, BY_MEMORY_TIME))
    ET.fromstring(drawn)  # noqa: S314  our own
    assert "0.3 s: RRC, on video" in drawn
    assert memory_chart(replace(result.memory, curve=()), BY_MEMORY_TIME) is None
    text = answer_text(result, running=False)
    assert "| 0.3 s |" in text
    assert assumption_line(result.memory) in text
    without = answer_text(replace(result, memory=RunMemory(tau_s=0.0)), running=False)
    assert "independent of each other given the state: an assumption" in without


def test_marks_are_the_times_that_belong_to_the_frailty_of_the_curve():
    alike = RunMemory(tau_s=0.0, curve=(CurvePoint(0.0, 1e-9, None, None, None),))
    assert measured_names(alike, BY_MEMORY_TIME) == {
        0.3: "RRC, a camera detector",
        0.17: "PointRCNN, a lidar detector",
    }
    assert set(measured_names(replace(alike, frailty=0.7), BY_MEMORY_TIME)) == {0.25, 0.11}
    note = "all objects taken as equal; 0.3 in place of 0.25 s, 0.17 in place of 0.11 s"
    there = replace(alike, curve=(*alike.curve, CurvePoint(0.3, 1e-3, None, None, None)))
    assert note in assumption_line(there)
    assert note not in assumption_line(replace(there, frailty=0.7))
