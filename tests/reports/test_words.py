"""Digits, references, causes and plans in words, and the pictures beside them."""

from dataclasses import replace
from pathlib import Path

import pytest

from pemviz.charts.svg import svg
from pemviz.config import ExperimentConfig
from pemviz.recording.text import answer_text
from pemviz.reports.causes_words import burst_lines, burst_table, causes_line, elasticity_text
from pemviz.reports.charts import requirement_chart
from pemviz.reports.estimate_words import digits_of, end_text, reference_text
from pemviz.reports.gate import decide_run
from pemviz.reports.html import sections_html
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.plan_words import plan_sentences, plan_table, short_rows
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import print_summary, summary_text
from pemviz.runs.supplements import planned_target
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sampling.zero_variance.reference import Reference
from tests.reports.runs import BURSTS, EXPLANATION, PLAN, estimate, result


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (7.3e-15, 9.4e-15, ("7.3e-15", "9.4e-15")),
        (0.0132, 0.0134, ("0.0132", "0.0134")),
        (1.0, 1.04, ("1.00", "1.04")),
        (0.25, 0.250001, ("0.2500", "0.2500")),  # four are enough
        (0.5, 0.5, ("0.50", "0.50")),
        (0.0, 0.03, ("0", "0.030")),
    ],
)
def test_ends_are_told_apart(low, high, told):
    digits = digits_of(low, high)
    assert (end_text(low, digits=digits), end_text(high, digits=digits)) == told
    assert digits_of(None, high) == digits_of(low, None) == 2


AGREEING = Reference(probability=2.1e-15, std_error=1e-18, log10_probability=-14.678)
FAR = Reference(probability=8e-14, std_error=2e-17, log10_probability=-13.097)


def terminal(one, capsys):
    print_summary(one, Path("run"))
    return " ".join(capsys.readouterr().out.split())


def beside(known):
    """A finished run as the engine leaves it: the diagnostics' words among the warnings."""
    answer = estimate(method="mixture")
    one = result(answer, reference=known, warnings=())
    return result(
        answer,
        reference=known,
        warnings=tuple(diagnostic.text for diagnostic in run_diagnostics(one)),
    )


def test_the_reference_and_the_ratio_to_it():
    assert reference_text(FAR, estimate()) == "8e-14 +- 2e-17; the estimate is 0.025 times that"
    nothing = Reference(probability=0.0, std_error=0.0, log10_probability=None)
    assert reference_text(nothing, estimate()) == "0 +- 0"


@pytest.mark.parametrize("known", [AGREEING, FAR])
def test_every_report_shows_the_reference(known, capsys):
    one, words = beside(known), reference_text(known, estimate())
    assert f"reference {words}" in summary_text(one)
    assert words in summary_markdown(one).replace("\\", "")
    shown = terminal(one, capsys)
    assert f"{known.probability:.4g} +- {known.std_error:.1g}" in shown


def test_every_report_tells_of_a_disagreement_and_the_gate_cannot_be_decided(capsys):
    one = beside(FAR)
    words = "0.025 times the reference 8e-14"
    for text in (summary_text(one), terminal(one, capsys), summary_markdown(one)):
        assert words in text
        assert "trust the reference" in text
    decision = decide_run(one, limit=1e-10)
    assert (decision.outcome, decision.exit_code) == ("undecided", 4)
    assert words in decision.reason
    agreeing = beside(AGREEING)
    assert "trust the reference" not in summary_text(agreeing)
    assert decide_run(agreeing, limit=1e-10).outcome == "passed"


LENGTH = "0.75 s (15 frames; four of five violations: 10 to 23)"
BEGINS = "at 9.0 (7.1 to 11.4) m, 2.05 (1.60 to 2.55) s after the start"


def test_misses_are_counted_where_nothing_is_called_a_gap():
    found = replace(EXPLANATION, misses_by_distance=(), miss_probability_by_step=(0.5, 1.0, 0.75))
    assert causes_line(found) == "Misses that matter in a violation: 2.2"


def test_a_sentence_each_on_bursts_and_on_what_would_help():
    bursts, help_ = burst_lines(EXPLANATION)
    assert bursts == (
        "Bursts (misses in a row) in a violation: 1.1; the decisive one: 15 frames (0.75 s) from "
        "9.0 m on, which has the probability 1.2e-12 by itself"
    )
    assert help_ == (
        "A memory 1 % shorter would bring 1.9 +- 0.03 % fewer violations; 1 % fewer misses, the "
        "memory as it is, 1.1 +- 0.01 % fewer violations"
    )
    independent = replace(EXPLANATION, memory=None)
    assert burst_lines(independent) == [bursts]
    assert burst_lines(replace(independent, bursts=None)) == []
    hardly = replace(EXPLANATION, memory=replace(EXPLANATION.memory, elasticity=-3e-18))
    assert "shorter would bring hardly any fewer violations" in burst_lines(hardly)[1]
    assert elasticity_text(hardly.memory) == "0.00 +- 0.03"


def test_every_view_has_the_rows():
    rows = burst_table(EXPLANATION, target=1e-4).rows
    assert dict(rows)["memory time for 0.0001"] == "0.067 s instead of 0.2 s"
    assert dict(rows)["how likely that is"].endswith("the whole burst 1.2e-12")  # as in the line
    run = result(explanation=EXPLANATION, config=ExperimentConfig(memory_s=0.2, target=1e-4))
    page, recorded = summary_markdown(run), answer_text(run, running=False)
    panel = sections_html(run_document(run).choose(["causes"]))
    for name, words in rows:
        assert f"| {name} | {words} |" in page
        assert f"| {name} | {words} |" in recorded
        assert f">{name}</td>" in panel
        assert f">{words}</td>" in panel


def test_requirements_in_words():
    def told(**changes):
        changed = replace(EXPLANATION, memory=replace(EXPLANATION.memory, **changes))
        return burst_table(changed, target=1e-4).rows[-1][1]

    assert told(target_tau_s=None) == "not enough alone"
    assert told(target_tau_s=0.2) == "met already"
    assert told(warning="few") == "0.067 s instead of 0.2 s (extrapolated)"
    one = replace(EXPLANATION, bursts=replace(BURSTS, again=None, begins_gap_m=None))
    rows = dict(burst_table(one, target=None).rows)
    assert rows["how likely that is"] == "starting it has a probability of 0.0026"
    assert rows["it begins"] == "2.05 (1.60 to 2.55) s after the start"


def changed(*, band=None, **changes):
    """The plan with its first band, or itself, changed."""
    first, *others = PLAN.labels.bands
    bands = (replace(first, **(band or {})), *others)
    labels = changes.pop("labels", replace(PLAN.labels, bands=bands))
    return result(plan=replace(PLAN, labels=labels, **changes))


def test_a_line_each_for_target_refits_and_memory(tmp_path, capsys):
    one = changed(reason=None)
    labels, refits, sequences = short_rows(one)
    assert labels[0] == "label 1,249 more at 5 to 7 m, 717 more at 7 to 13 m"
    assert "under 2.5e-09, on a logarithmic scale halfway to the answer" in labels[1]
    assert refits[0] == "label 1,290 more at 7 to 13 m"
    assert sequences[0] == "85 tracked sequences"
    print_summary(one, tmp_path)
    told = capsys.readouterr().out
    assert "What to measure next (labels of Car, occlusion none, straight ahead, heading" in told
    assert "- label 1,249 more at 5 to 7 m" in told
    assert "required" not in told
    print_summary(one, tmp_path, verbose=True)
    assert "required" in capsys.readouterr().out


def test_a_detector_that_misses_too_often_is_told_to_become_better():
    one = changed(band={"labels": None, "most_missed": None, "required": 0.004})
    assert short_rows(one)[0][0] == "a better detector: one that misses at most 0.004 at 5 to 7 m"
    assert "the detector has to become better first" in " ".join(plan_sentences(one))
    assert plan_table(one.plan.labels).rows[0][5] == "out of reach"


def test_what_is_labelled_may_do():
    one = changed(band={"labels": 0, "most_missed": 0, "obstacles": 400})
    assert "5 to 7 m" not in short_rows(one)[0][0]
    assert "the labels at hand do (0 of 400 missed so far)" in " ".join(plan_sentences(one))


def test_every_figure_stands_in_the_page():
    page = summary_markdown(changed(reason=None))
    for words in (
        "### What to measure next (labels of Car",
        "| 5 to 7 | 0 of 0 | 0.012 | 1 | 0.058 | 1,249 | 6 | 78 |",
        "if at most 13 of them are missed", "with a probability of 90%", "Mind: a rough plan",
        "18 tracked sequences give a memory time of 0.25 s (0.17 to 0.38 s)",
    ):  # fmt: skip
        assert words in page


def test_the_picture_draws_each_band_with_its_three_figures():
    picture = svg(requirement_chart(PLAN.labels))
    for tip in (
        "5 to 7 m: labels so far allow 1", "5 to 7 m: required 0.058",
        "5 to 7 m: error model 0.012", "7 to 13 m: labels so far allow 0.034",
        "7 to 13 m: required 0.028",
    ):  # fmt: skip
        assert f"<title>{tip}</title>" in picture
    assert requirement_chart(replace(PLAN.labels, bands=())) is None


def test_what_strangers_wrote_is_text():
    crafted = "<script>alert(1)</script>"
    one = changed(labels=replace(PLAN.labels, obstacle=crafted, warning=crafted), reason=crafted)
    assert "<script" not in sections_html(run_document(one).sections)
    assert "<script" not in summary_markdown(one)


def test_no_plan_says_why_and_no_question_says_nothing():
    none = changed(labels=None, refits=(), sequences=None, reason="no violation was seen")
    assert plan_sentences(none) == ["No labels are planned: no violation was seen."]
    assert short_rows(none) == []
    assert "What to measure next" not in summary_markdown(result())


def test_without_a_target_the_plan_aims_halfway_to_what_the_data_allow():
    one = result(estimate(probability=1e-14))
    assert abs(planned_target(one) / (1e-14 * one.data_bound.probability) ** 0.5 - 1.0) < 1e-12
    assert planned_target(result(estimate(probability=0.5))) is None
    assert planned_target(replace(one, config=replace(one.config, target=1e-7))) == 1e-7
