"""What to measure next in words: what every figure is, and what is said where there is none."""

from dataclasses import replace

from pemviz.charts.svg import svg
from pemviz.reports.charts import requirement_chart
from pemviz.reports.html import sections_html
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.plan_words import plan_sentences, plan_table, short_rows
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import print_summary
from pemviz.runs.supplements import planned_target
from tests.reports.runs import PLAN, estimate, result


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
    assert "under 2.5e-09, halfway to the answer" in labels[1]
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
