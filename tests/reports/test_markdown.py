import re

import pytest
from markdown_it import MarkdownIt

from pemviz.config import ExperimentConfig, ScenarioConfig
from pemviz.reports.escape import (
    markdown_block,
    markdown_code,
    markdown_table,
    markdown_text,
    printable_line,
)
from pemviz.reports.gate import decide_gate, decide_run
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import run_document
from pemviz.runs.uncertainty import run_diagnostics
from tests.reports.runs import NASTY, estimate, nasty_result, result, warned


def github() -> MarkdownIt:
    """CommonMark with tables, HTML let through: what a summary page is made with."""
    return MarkdownIt("commonmark", {"html": True}).enable("table")


def shown_text(source: str) -> str:
    """What a reader sees of one line of markdown."""
    tokens = github().parseInline(source)[0].children
    assert {token.type for token in tokens} <= {"text", "html_inline", "text_special"}
    return "".join(t.content for t in tokens if t.type != "html_inline")


def test_escaped_text_shows_as_it_was():
    assert shown_text(markdown_text(NASTY)) == printable_line(NASTY)
    assert shown_text(markdown_code(NASTY)) == printable_line(NASTY)


def test_only_code_tags_reach_the_page():
    tokens = github().parseInline(markdown_code(NASTY))[0].children
    assert [t.content for t in tokens if t.type == "html_inline"] == ["<code>", "</code>"]


def test_unprintable_characters_are_replaced():
    assert printable_line("a\x00b\u202ec\ud800d") == "a�b�c�d"
    printable_line(NASTY).encode("utf-8")


def test_a_table_keeps_its_shape_whatever_its_cells_hold():
    table = markdown_table(("a", "b"), [(markdown_text(NASTY), markdown_code(NASTY))])
    html = github().render(table)
    assert html.count("<tr>") == 2
    assert html.count("<td>") == 2


def test_a_fence_outlasts_the_backticks_in_it():
    tokens = github().parse(markdown_block("a\n````\n<b>\n```"))
    assert [t.type for t in tokens] == ["fence"]
    assert tokens[0].content == "a\n````\n<b>\n```\n"


def test_a_nasty_run_leaves_no_markup_of_its_own():
    page = summary_markdown(nasty_result(), gate=decide_run(nasty_result(), limit=1e-9))
    page.encode("utf-8")
    tokens = github().parse(page)
    children = [child for token in tokens for child in token.children or ()]
    kinds = {child.type for child in children}
    assert kinds <= {"text", "html_inline", "strong_open", "strong_close", "softbreak"}
    inline = {child.content for child in children if child.type == "html_inline"}
    assert inline == {"<code>", "</code>"}
    assert [t.content.strip() for t in tokens if t.type == "html_block"] == [
        "<details><summary>Complete configuration</summary>",
        "</details>",
    ]
    # the answer, and each section of the run's document that has something to say in full
    sections = run_document(nasty_result()).sections
    told = sum(bool(section.full) for section in sections)
    assert len([t for t in tokens if t.type == "heading_open"]) == told


def test_a_reference_that_disagrees_is_no_extrapolation():
    """6.69e-15 against 2e-15 +- 1e-15."""
    *_, disagreement = run_diagnostics(result())
    page = summary_markdown(result(warnings=("thin data", disagreement.text)))
    warnings, extrapolated = page.split("### Warnings")[1].split("### Extrapolated")
    assert "trust the reference" in warnings
    assert "trust the reference" not in extrapolated
    assert "thin data" in extrapolated


def test_the_page_tells_the_whole_story():
    one = estimate(method="mixture", diagnostics=(warned("only 9 failures were seen"),))
    page = summary_markdown(result(one), gate=decide_gate(one, limit=1e-9))
    html = github().render(page)
    for part in (
        "failure probability in one run: 2.0e-15",
        "2e-15 +- 1e-15",
        "✅ <strong>Gate passed",
        "always[0,99] (gap &gt;= 2.0)",
        "8.0e-16 to 5.0e-15",
        "52 of 100 rollouts (1200 simulated in all)",
        "only 9 failures were seen",
        "-3.25 (classical)",
        "9 of 99 steps",
        "ab" * 32,
        "37498 obstacles",
        "misses are independent",
        "1.0e-17 to 1.0e-13 (95% of 20 refits of one architecture on the same data, "
        "not other model classes)",
        "no obstacle closer than 7 m",
        "few effective failures",
        "6.69e-15 +- 6e-18",
        "below 0.0042 (confidence 95%)",
        "numpy 2.3.0",
        "11 stages of 100 and 100 final rollouts",
        "70 km/h, 15 m behind",
        "initial_gap_m = 15.0",
        "+--",
    ):
        assert part in html, part


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("adaptive", "11 stages of 90 and 70 final rollouts, alpha 0.1, sigma 0.95, epochs 500"),
        (
            "mixture",
            "11 stages of 90 and 70 final rollouts, alpha chosen at each stage, sigma 0.95",
        ),
        ("splitting", "10 runs of 90 particles"),
        ("subset", "10 runs of 90 particles"),
        ("zero-variance", "70 rollouts"),
        ("monte-carlo", "70 rollouts"),
        ("naive", "70 rollouts, naive_detection_probability 0.5"),
    ],
)
def test_the_budget_is_the_methods_own(method, words):
    config = ExperimentConfig(method=method, rollouts=90, final_rollouts=70, repetitions=3)
    page = summary_markdown(result(config=config))
    (row,) = re.findall(r"^\| budget \| (.*) \|$", page, flags=re.MULTILINE)
    assert row.startswith(words)
    assert row.endswith(", 3 repetitions")


def test_repetitions_each_have_a_row_and_long_runs_are_cut():
    page = summary_markdown(result(repetitions=30))
    assert len(re.findall(r"^repetition \d+ ", page, flags=re.MULTILINE)) == 20
    assert "mean of 30" in page


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"probability": 0.0, "failures": 0, "ci_low": None, "ci_high": None}, "unknown"),
        ({"ess": None, "pareto_k": None, "max_weight_share": None, "nll_mean": None}, "| - |"),
    ],
)
def test_undefined_figures_are_dashes_not_nan(changes, words):
    page = summary_markdown(result(estimate(**changes)))
    assert words in page
    assert "nan" not in page.lower().replace("provenance", "")


def test_a_run_without_an_estimate_says_so():
    page = summary_markdown(result(estimate=None, status="stopped", repetitions=1))
    assert "no estimate: the run stopped" in page


def test_what_differs_from_the_scenarios_defaults_is_named():
    config = ExperimentConfig(scenario=ScenarioConfig(emergency_gap_m=12.0))
    assert "emergency_gap_m 12" in markdown_to_text(summary_markdown(result(config=config)))


def markdown_to_text(page: str) -> str:
    return github().render(page)
