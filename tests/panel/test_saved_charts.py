"""Every chart of the panel's pages bears its numbers, and they are the run's."""

import csv
import io
import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pemviz.panel.arguments import Arguments
from pemviz.panel.ranking import rank, shares
from pemviz.panel.run_place import DOCUMENTS, DRAWN, RunPlace
from pemviz.reports.answer_words import uncertainty_title
from pemviz.reports.html import sections_html
from pemviz.reports.run_document import run_document
from pemviz.runs.uncertainty import uncertainty_budget
from tests.panel.test_places import Page


def asked(run, name, **values):
    place = RunPlace(lambda name: run)
    return place.requests[name](Page(), Arguments({"run": "x", **values}))


def figures(html):
    """The numbers of each chart by what the chart is called: columns by their heads."""
    page = ET.fromstring(f"<all>{html.replace('<br>', '<br/>')}</all>")  # noqa: S314  our own
    found = {}
    for figure in page.iter("figure"):
        heads, *rows = csv.reader(io.StringIO(figure.get("data-csv")))
        drawn = figure.find("{http://www.w3.org/2000/svg}svg")
        assert [button.get("data-save") for button in figure.iter("button")] == ["png", "csv"]
        assert rows
        columns = zip(heads, zip(*rows, strict=True), strict=True)
        found[drawn.get("aria-label")] = dict(columns)
    everywhere = list(page.iter("{http://www.w3.org/2000/svg}svg"))
    assert len(found) == len(everywhere)  # none without, and no two of one name
    return found


def of(columns, series, head):
    """A column's numbers where a series is meant."""
    pairs = zip(columns["series"], columns[head], strict=True)
    return np.array([float(value) for name, value in pairs if name == series])


def test_every_chart_of_every_page_can_be_saved(loaded_run, naive_run):
    count = 0
    for run in (loaded_run, naive_run):
        for page in (*DOCUMENTS, *DRAWN):
            count += len(figures(asked(run, "page", page=page)["html"]))
        count += len(figures(asked(run, "compare", runs=["a", "b"])))
        found = asked(run, "rollout", rank=1)
        count += sum(len(figures(chart["html"])) for chart in found["charts"])
    assert count > 25


def test_the_learning_page_saves_what_the_result_holds(loaded_run):
    found = figures(asked(loaded_run, "page", page="learning")["html"])
    estimate, stages = loaded_run.result.estimate, loaded_run.result.stages
    chart = found["Estimate of P(violation)"]
    assert of(chart, "answer", "probability") == [estimate.probability]
    (label,) = {name for name in chart["series"] if name.startswith("answer's")}
    assert of(chart, label, "probability: low") == [estimate.ci_low]
    assert of(chart, label, "probability: high") == [estimate.ci_high]
    alone = {s.stage: s.log10_probability for s in stages if s.log10_probability is not None}
    np.testing.assert_array_equal(of(chart, "a stage alone", "stage"), list(alone))
    np.testing.assert_allclose(
        np.log10(of(chart, "a stage alone", "probability")), list(alone.values()), rtol=1e-12
    )
    threshold = of(
        found["Threshold: rollouts at or below it are learned from"], "threshold", "robustness [m]"
    )
    assert threshold.tolist() == [s.threshold for s in stages if s.threshold is not None]
    ess = of(found["Effective sample size of the violations"], "effective sample size", "rollouts")
    assert ess.tolist() == [stage.ess for stage in stages if stage.ess is not None]
    violate = found["Rollouts that violate"]
    np.testing.assert_allclose(
        [float(value) for value in violate["share [%]"]],
        [100.0 * stage.failures / stage.rollouts for stage in stages],
    )
    assert violate["note"][0] == f"stage 0: {stages[0].failures} of {stages[0].rollouts}"
    curves = found["P(detected) over the gap"]
    error_model = of(curves, "error model (ml-nn)", "P(detected)")
    np.testing.assert_array_equal(error_model, loaded_run.pem_detection)
    np.testing.assert_array_equal(of(curves, "error model (ml-nn)", "gap [m]"), loaded_run.gap_m)


def test_the_weights_page_saves_every_rollouts_weight(naive_run):
    found = figures(asked(naive_run, "page", page="weights")["html"])
    chart, table = found["Weight over robustness"], naive_run.rollouts
    head = "violates; larger: more of the answer"
    for series, chosen in ((head, table["violated"]), ("does not violate", ~table["violated"])):
        np.testing.assert_array_equal(
            of(chart, series, "robustness, classical [m]"), table["robustness"][chosen]
        )
        np.testing.assert_allclose(
            of(chart, series, "log10 of the weight p / q") * math.log(10.0),
            naive_run.log_weight[chosen],
            rtol=1e-12,
        )
    near = found["How near the cars come"]
    gap_m = of(near, "under the error model", "least gap in a rollout [m]")
    below = np.searchsorted(gap_m, 2.0)
    reached = of(near, "under the error model", "probability of less")[below - 1]
    assert reached == pytest.approx(naive_run.result.estimate.probability, rel=1e-9)
    heaviest = int(np.argmax(shares(naive_run)))
    chart = found["Gap of the rollouts that contribute most"]
    first = chart["series"][[name.startswith("rollout") for name in chart["series"]].index(True)]
    np.testing.assert_array_equal(of(chart, first, "gap [m]"), table["gap_m"][heaviest])


def test_misses_in_violations_are_the_weighted_shares_of_the_rollouts(naive_run):
    """By hand: each violation counts as much as its weight, at every step."""
    found = figures(asked(naive_run, "page", page="why")["html"])
    table, violated = naive_run.rollouts, naive_run.rollouts["violated"]
    weight = np.exp(naive_run.log_weight[violated])
    missed = ~table["detected"][violated]
    expected = 100.0 * (weight[:, None] * missed).sum(axis=0) / weight.sum()
    chart = found["Missed in violations, by time"]
    np.testing.assert_allclose(of(chart, "in violations", "steps missed [%]"), expected)
    np.testing.assert_allclose(
        of(chart, "in violations", "time [s]"), 0.05 * (np.arange(99) + 0.5), atol=1e-12
    )


def test_the_uncertainty_page_saves_each_source(naive_run):
    found = figures(asked(naive_run, "page", page="uncertainty")["html"])
    sources = uncertainty_budget(naive_run.result)
    low = "probability of a violation: low"
    chart = found[uncertainty_title(naive_run.result)]
    values = [float(value) for value in chart[low] if value]
    assert values == [source.low for source in sources if source.low is not None]
    answer = naive_run.result.estimate.probability
    assert of(chart, "the answer", "probability of a violation") == [answer]


def test_runs_side_by_side_save_each_answer(naive_run):
    found = figures(asked(naive_run, "compare", runs=["a", "b"]))
    chart, estimate = found["Answers side by side"], naive_run.result.estimate
    answers = [float(value) for value in chart["probability of a violation"]]
    assert answers == [estimate.probability] * 2
    low, high = (chart[f"probability of a violation: {end}"] for end in ("low", "high"))
    assert (float(low[1]), float(high[1])) == (estimate.ci_low, estimate.ci_high)


def test_a_rollouts_charts_save_its_signals_and_outcomes(live_run):
    found = asked(live_run, "rollout", among="all", first="least robust", rank=2)
    index = int(rank(live_run, live_run.config.metric, among="all").order[1])
    table = {name: values[index] for name, values in live_run.rollouts.items()}
    gap, speeds, perception = (
        next(iter(figures(chart["html"]).values())) for chart in found["charts"]
    )
    np.testing.assert_array_equal(of(gap, "gap", "gap [m]"), table["gap_m"])
    np.testing.assert_allclose(of(gap, "gap", "time [s]"), 0.05 * np.arange(100), atol=1e-12)
    assert of(gap, "2 m: limit", "gap [m]") == [2.0]
    np.testing.assert_array_equal(of(speeds, "ego", "speed [m/s]"), table["ego_speed_mps"])
    np.testing.assert_array_equal(of(speeds, "lead", "speed [m/s]"), table["lead_speed_mps"])
    for series, outcome in (("detected", True), ("missed", False)):
        at_s = 0.05 * np.flatnonzero(table["detected"] == outcome)
        np.testing.assert_allclose(of(perception, series, "time [s]"), at_s, atol=1e-12)
    proposal = of(perception, "proposal", "P(detected)")
    likelihood = np.where(table["detected"], proposal, 1.0 - proposal)
    np.testing.assert_allclose(np.log(likelihood), table["log_q"], rtol=1e-6, atol=1e-9)


def test_documents_that_hear_of_no_click_have_no_buttons(naive_run):
    sections = run_document(naive_run.result).sections
    assert "<figure" in sections_html(sections)
    assert "data-save" not in sections_html(sections)
    assert "data-save" in sections_html(sections, live=True)
