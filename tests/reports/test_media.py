"""Every medium shows what a run's document says: one walk for all figures and all media."""

from dataclasses import replace
from html import unescape
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from pemviz.analysis.robustness_tail import RobustnessTail
from pemviz.analysis.starts import DangerousStarts, QuantileRange, StartValue
from pemviz.config import ExperimentConfig
from pemviz.panel.why_page import section_cells
from pemviz.recording.text import answer_text, provenance_text, warnings_text
from pemviz.reports.case_runs import CaseRun
from pemviz.reports.document import (
    Bullets,
    Caution,
    Code,
    Document,
    Figure,
    Folded,
    Headline,
    Paragraph,
    Section,
    Strip,
    Table,
    Verbatim,
    Verdict,
    cell_text,
)
from pemviz.reports.html import blocks_html, sections_html
from pemviz.reports.markdown import sections_markdown, summary_markdown
from pemviz.reports.notebook import result_html
from pemviz.reports.pipeline import junit_xml
from pemviz.reports.run_document import ANSWER, RECORD, TRUST, WHY, run_document
from pemviz.reports.safety_case import safety_case_page
from pemviz.reports.terminal import plain_lines, print_summary, summary_text
from pemviz.runs.result import RuleAnswer, RunMemory
from pemviz.sampling.bursts.curve import CurvePoint
from tests.reports.runs import EXPLANATION, PLAN, estimate, result
from tests.runs.test_uncertainty import MODEL_CLASSES

CURVE = tuple(
    CurvePoint(tau_s=tau_s, probability=p, low=p / 3.0, high=3.0 * p, ess=50.0)
    for tau_s, p in ((0.0, 1e-15), (0.05, 1e-12), (0.2, 1e-6))
)
TAIL = RobustnessTail(
    rollouts=900, expected=4.125, expected_std_error=0.01, worst=-1.5, worst_std_error=0.2,
    quantile=-0.75,
)  # fmt: skip

START = DangerousStarts(
    rule=None, violations=40, effective=35.0, log10_probability=-6.0,
    values=(
        StartValue("lead_speed", "m/s", (10.0, 15.0, 20.0),
                   tuple(QuantileRange(v, v - 1.0, v + 1.0) for v in (8.0, 9.5, 11.0)), -2.0),
    ),
)  # fmt: skip


def whole(**changes):
    """A run that tells of everything."""
    config = ExperimentConfig(method="mixture", encounters_per_hour=2.0, target=1e-18)
    return replace(
        result(
            estimate(method="mixture"), plan=PLAN, model_classes=MODEL_CLASSES,
            explanation=EXPLANATION,
            memory=RunMemory(tau_s=0.0, curve=CURVE), config=config, robustness_tail=TAIL,
            starts=(START,),
            rules=(RuleAnswer("near", "always[0,9] (gap > 0)", estimate(method="mixture")),),
        ),
        **changes,
    )  # fmt: skip


def words(blocks, *, pictures):
    """All texts of blocks; in place of a chart its words where a medium has no pictures."""
    for block in blocks:
        match block:
            case Headline() | Paragraph() | Caution() | Verdict():
                yield block.text
            case Bullets():
                yield from block.items
            case Table():
                yield from (cell_text(cell) for row in block.rows for cell in row)
                yield from (*block.columns, block.note)
            case Figure():
                yield from [block.caption] if pictures else words(block.words, pictures=False)
            case Folded():
                yield from words(block.blocks, pictures=pictures)
            case Code():
                yield from block.text.splitlines()


def plain(text):
    """Without line breaks, escapes and capitals."""
    return " ".join(unescape(unescape(text)).split()).lower()


def shown_by_markdown(text):
    return MarkdownIt("commonmark", {"html": True}).enable("table").render(text)


@pytest.fixture
def printed(capsys, monkeypatch):
    def show(run, *, verbose=False):
        monkeypatch.setenv("COLUMNS", "1000")
        print_summary(run, Path("run"), verbose=verbose)
        return capsys.readouterr().out

    return show


def case(run):
    return safety_case_page([CaseRun("run", run, card=None, digests={}, violations=None)])


def test_every_section_is_there_in_the_order_of_reading():
    keys = {section.key for section in run_document(whole()).sections}
    assert keys == {*ANSWER, *WHY, *TRUST, *RECORD} - {"gate"}


@pytest.mark.parametrize("key", [*ANSWER[1:], *WHY, *TRUST, *RECORD])
def test_media_show_all_that_a_section_says(key, printed):
    run = whole()
    (section,) = run_document(run).choose((key,))
    page = shown_by_markdown(summary_markdown(run))
    texts = {"summary page": plain(page)}
    if key not in RECORD:
        texts["terminal"] = plain(printed(run, verbose=True))
    for medium, text in texts.items():
        for said in words(section.full, pictures=False):
            assert plain(said) in text, (medium, said)
    pages = (case(run), "".join(section_cells(section)), sections_html([section]))
    for html in pages[0 if key not in ("question", "given") else 1 :]:
        for said in words(section.full, pictures=True):
            assert plain(said) in plain(html), said


@pytest.mark.parametrize("key", [*ANSWER[1:], *WHY])
def test_what_is_said_in_brief_stands_in_the_short_media(key, printed):
    run = whole()
    terminal, notebook = plain(printed(run)), plain(result_html(run))
    for said in words(run_document(run).blocks(key, brief=True), pictures=False):
        assert plain(said) in terminal, said
    for said in words(run_document(run).blocks(key, brief=True), pictures=True):
        assert plain(said) in notebook, said


def test_a_figure_of_the_result_stands_in_every_medium(printed):
    run = whole()
    shown = (
        printed(run), printed(run, verbose=True), summary_text(run), summary_markdown(run),
        answer_text(run, running=False), junit_xml(run), case(run), result_html(run),
    )  # fmt: skip
    for text in shown:
        assert "4.125 m +- 0.01" in plain(text)
        assert "-1.5 m +- 0.2" in plain(text)


def test_the_recording_tells_of_warnings_and_provenance():
    run = whole()
    for text, keys in (
        (warnings_text(run), ("warnings", "extrapolation")),
        (provenance_text(run), ("provenance", "assumptions")),
    ):
        for said in words(run_document(run).blocks(*keys), pictures=False):
            assert plain(said) in plain(shown_by_markdown(text))


TEXT = st.text(max_size=12)
CELL = st.one_of(
    TEXT, TEXT.map(Verbatim), TEXT.map(lambda text: Strip(text, ((0.1, 0.2),))),
    st.builds(Verdict, st.sampled_from(["yes", "no", "open"]), TEXT),
)  # fmt: skip
BLOCK = st.one_of(
    st.builds(Headline, TEXT.filter(bool), TEXT),
    st.builds(Paragraph, TEXT, st.sampled_from(["plain", "strong", "quiet"])),
    st.builds(Caution, TEXT),
    st.builds(Verdict, st.sampled_from(["yes", "no", "open"]), TEXT),
    st.builds(Bullets, st.lists(TEXT, max_size=3).map(tuple), st.booleans()),
    st.builds(Code, TEXT),
    st.lists(st.tuples(CELL, CELL), max_size=3).map(lambda rows: Table(("a", "b"), tuple(rows))),
)


@given(st.lists(BLOCK, max_size=5))
def test_no_text_becomes_markup_in_any_medium(blocks):
    section = Section("key", "title", (), tuple(blocks))
    html = blocks_html(blocks)
    assert html.count("<script") == 0
    tree = MarkdownIt("commonmark", {"html": True}).enable("table")
    tokens = tree.parse("\n\n".join(sections_markdown([section], level=2)))
    inline = [c for t in tokens for c in t.children or () if c.type == "html_inline"]
    assert {c.content for c in inline} <= {"<code>", "</code>"}
    assert not [t for t in tokens if t.type == "html_block"]
    assert plain_lines(blocks) is not None


def test_sections_are_chosen_in_the_order_asked():
    a, b = (Section(key, key, (Paragraph(key),), (Code(key),)) for key in "ab")
    document = Document("pemviz", (a, b))
    assert list(document.choose("cba")) == [b, a]
    assert document.blocks("b", "a") == (Code("b"), Code("a"))
    assert document.blocks("b", brief=True) == (Paragraph("b"),)
