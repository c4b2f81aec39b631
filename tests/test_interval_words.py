"""An interval that does not hold is called a 95 % interval nowhere; one that holds, everywhere.

Every method, with a reliable and an unreliable estimate, in every place that shows an interval.
"""

import json
import re
from dataclasses import replace
from functools import cache
from html import unescape

import pytest

from pemviz.charts.chart import DOTTED
from pemviz.config import METHODS, ExperimentConfig
from pemviz.config.toml_files import config_text
from pemviz.latents import LatentCounts
from pemviz.panel import compare_page, learning_page
from pemviz.panel.recordings_folder import RecordingsFolder
from pemviz.recording.sweep_overview import estimate_label
from pemviz.recording.text import answer_text
from pemviz.reports.answer_words import rule_warnings
from pemviz.reports.gate import decide_run
from pemviz.reports.headline_words import answers_table
from pemviz.reports.markdown import summary_markdown
from pemviz.reports.run_document import run_document
from pemviz.reports.terminal import plain_lines, summary_text
from pemviz.reproduce.experiments import RepetitionOutcome
from pemviz.reproduce.tables import table_2
from pemviz.runs.result import RuleAnswer
from pemviz.runs.result_file import result_document, write_result
from pemviz.runs.uncertainty import run_remedy
from pemviz.sampling.estimates.trust import remedy
from pemviz.sampling.registry import by_name
from pemviz.sampling.zero_variance.reference import Reference
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.overview import _estimate, _runs_page
from pemviz.sweep.plan import make_plan, parse_variation
from pemviz.sweep.tables import csv_text, rows
from pemviz.sweep.tables import summary_markdown as sweep_summary
from pemviz.types import Diagnostic
from tests.panel.conftest import ran
from tests.reports.runs import estimate
from tests.reports.runs import result as made_up

METHOD = pytest.mark.parametrize("method", METHODS.names())
DOUBT = re.compile(r"not\s+a\s+95\s+%\s+(interval|bound)")
CLAIM = re.compile(r"(?<!not a )95\s+%\s+(interval|upper\s+bound|bound)")
WRONG = Diagnostic(
    "not-absorbing", None, None, "nothing says during a rollout whether it has violated"
)
"""What makes an interval unreliable whatever it rests on."""


def judged(method, *, reliable, repetitions=1):
    """A run's result, and what is said against its interval."""
    one = estimate(method=method, diagnostics=() if reliable else (WRONG,))
    whole = replace(
        made_up(one, repetitions=repetitions),
        config=ExperimentConfig(method=method, repetitions=repetitions, encounters_per_hour=2.0),
        reference=None,
    )
    caveat = by_name(method).interval_caveat
    return whole, [*([] if reliable else [WRONG.text]), *([] if caveat is None else [caveat])]


def plain(text):
    """Without line breaks, tables' frames and escapes."""
    return " ".join(unescape(text).replace("\u2502", " ").split())


def document_text(result, gate=None):
    """All that the run's document says, briefly and in full."""
    sections = run_document(result, gate=gate).sections
    return plain(" ".join(plain_lines(b for one in sections for b in (*one.brief, *one.full))))


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_the_document_of_a_run(method, reliable):
    result, against = judged(method, reliable=reliable)
    gate = decide_run(result, limit=1e-20)
    for text in (document_text(result), plain(gate.sentence)):
        checked(text, against)


def checked(text, against):
    """Words that an interval is none where something speaks against it, and nowhere else."""
    assert bool(DOUBT.search(text)) == bool(against)
    assert bool(CLAIM.search(text)) == (not against)
    for words in against:
        assert words in text


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_result_json_says_so_beside_the_bounds(method, reliable):
    result, against = judged(method, reliable=reliable, repetitions=2)
    document = json.loads(json.dumps(result_document(result)))
    for table in (document["estimate"], *document["repetitions"]):
        assert table["interval_caveats"] == against


def ways_in(result):
    """A run's answer as a program, a notebook, a pipeline and the viewer show it."""
    summary = summary_markdown(result).replace("\\", "")
    return (
        summary_text(result), result._repr_html_(), summary, answer_text(result, running=False)
    )  # fmt: skip


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("latents", [None, LatentCounts(noise=1)])
def test_every_way_in_says_what_to_try_where_an_interval_is_none(method, reliable, latents):
    result, against = judged(method, reliable=reliable, repetitions=2)
    result = replace(result, latents=latents)
    words = run_remedy(replace(result, latents=latents)) or ""
    for text in ways_in(result):
        assert ("try next: " in plain(text)) == bool(against)
        assert not against or f"try next: {words}" in plain(text).replace("\\", "")
    alone = plain(result.estimate._repr_html_())
    assert (f"try next: {remedy(method, checks=['subset'])}" in alone) == bool(against)
    document = json.loads(json.dumps(result_document(result)))
    for table in (document["estimate"], *document["repetitions"]):
        assert table.get("try_next") == (words if against else None)


def test_a_single_rule_that_is_doubted_is_enough_to_say_what_to_try():
    rule = RuleAnswer("a", "always[0,9] (x > 0)", estimate(method="mixture", diagnostics=(WRONG,)))
    result = replace(made_up(estimate(method="mixture", diagnostics=())), reference=None)
    assert all("try next" not in plain(text) for text in ways_in(result))
    result = replace(result, rules=(rule,))
    assert all(
        "try next: more rollouts; --method zero-variance or" in plain(text)
        for text in ways_in(result)
    )
    unbroken = replace(rule.estimate, failures=0, probability=0.0, ci_low=None, ci_high=None)
    never = replace(result, rules=(replace(rule, estimate=unbroken),))
    assert all("try next" not in plain(text) for text in ways_in(never))


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_an_interval_that_does_not_hold_is_dotted(method, reliable):
    result, against = judged(method, reliable=reliable, repetitions=3)
    page = summary_markdown(replace(result, pem_interval=None))
    drawn = [line for line in page.splitlines() if re.match(r"(repetition \d|mean of 3) ", line)]
    assert len(drawn) == 4
    for line in drawn:
        assert (".." in line and ":" in line) == bool(against)
        assert ("--" in line and "|" in line) == (not against)
    assert ("dotted is not a 95 % interval" in page) == bool(against)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A run as the panel shows it; its answer is replaced by what a test needs."""
    config = ExperimentConfig(method="naive", final_rollouts=20)
    return ran(tmp_path_factory.mktemp("recordings"), config).run


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_every_page_of_the_panel(method, reliable, shown, tmp_path):
    result, against = judged(method, reliable=reliable)
    run = replace(shown, result=result)
    other = replace(shown, result=judged("mixture", reliable=True)[0])
    text = plain(re.sub("<[^>]*>", " ", learning_page.learning(run)))
    assert bool(DOUBT.search(text)) == bool(against)
    assert bool(CLAIM.search(text)) == (not against)
    both = plain(compare_page.runs_page([run, other]))
    assert bool(CLAIM.search(both)) == (not against)
    assert ("not a 95 % interval" in both) == bool(against)
    assert all(words in both for words in against)
    dotted = f"stroke-dasharray='{DOTTED}'"
    assert (dotted in compare_page.runs_page([run, other])) == bool(against)
    (tmp_path / "a-run").mkdir()
    write_result(tmp_path / "a-run", result)
    (tmp_path / "a-run" / "config.toml").write_text(config_text(result.config), encoding="utf-8")
    (entry,) = RecordingsFolder(tmp_path).entries()
    assert entry.summary["sampling_holds"] == (not against)


@cache
def plan_of_one():
    base = ExperimentConfig(method="naive", final_rollouts=20)
    return make_plan(base, [parse_variation("seed=3")])


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_every_table_of_a_sweep(method, reliable):
    result, against = judged(method, reliable=reliable)
    plan = plan_of_one()
    states = [RunState(plan.runs[0], "done", result.estimate)]
    checked_page = plain(_runs_page(plan, states))
    assert bool(DOUBT.search(checked_page)) == bool(against)
    assert ("8.0e-16 to 5.0e-15 (95 %)" in checked_page) == (not against)
    (row,) = rows(plan, states)
    assert row["interval_caveats"] == "; ".join(against)
    assert all(words in csv_text(plan, [row]) for words in against)
    drawn = _estimate(states[0])
    assert drawn.caveats == tuple(against)
    assert bool(DOUBT.search(estimate_label("all", drawn))) == bool(against)
    assert f"| {int(bool(against))} of 1 |" in sweep_summary(plan, states)


@METHOD
@pytest.mark.parametrize("reliable", [True, False])
def test_the_papers_tables(method, reliable):
    result, against = judged(method, reliable=reliable)
    page = table_2({method: [RepetitionOutcome(result.estimate, curves={})]}, None).markdown()
    assert "| is it a 95 % bound? |" in page
    assert ("| yes |" in page) == (not against)
    assert all(words in plain(page) for words in against)


@METHOD
def test_a_reference_that_disagrees_counts_too(method):
    far = Reference(probability=8e-14, std_error=2e-17, log10_probability=-13.097)
    result = replace(judged(method, reliable=True)[0], reference=far)
    in_file = json.dumps(result_document(result)["estimate"]["interval_caveats"])
    for text in (document_text(result), in_file):
        assert "0.025 times the reference" in text
        assert not CLAIM.search(text)


def test_the_range_over_refits_is_called_that_and_its_caveats_are_told():
    result, _ = judged("mixture", reliable=True)
    (caveat,) = result.pem_interval.warnings
    words = document_text(result)
    assert caveat in words
    assert "refits of ml-nn" in words
    assert "refits of one architecture on the same data, not other model classes" in words
    assert "error models" not in words


def test_a_rule_tells_only_what_speaks_against_it_and_not_against_the_whole_answer():
    own = replace(WRONG, kind="large-weight", text="one rollout carries 40% of the weight")
    holds, doubted, worse = (
        estimate(method="mixture", diagnostics=found) for found in ((), (WRONG,), (WRONG, own))
    )
    result = replace(
        made_up(doubted),
        reference=None,
        rules=tuple(
            RuleAnswer(name, "always[0,9] (x > 0)", one)
            for name, one in zip("abc", (holds, doubted, worse), strict=True)
        ),
    )
    intervals = [row[2] for row in answers_table(result).rows[:-1]]
    assert [bool(DOUBT.search(words)) for words in intervals] == [False, True, True]
    assert [WRONG.text in words for words in intervals] == [False] * 3
    assert own.text in intervals[2]
    assert rule_warnings(result) == [f"rule c: {own.text}"]
    alone = replace(result, estimate=holds)
    assert WRONG.text in answers_table(alone).rows[1][2]
    assert rule_warnings(alone)[0] == f"rules b, c: {WRONG.text}"
