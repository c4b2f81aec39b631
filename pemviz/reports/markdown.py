"""Documents as markdown: summary pages of pipelines, and the texts of a recording."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby

from pemviz.charts.characters import characters
from pemviz.reports import document as doc
from pemviz.reports.document import Block, Cell, Mark, Section, cell_text
from pemviz.reports.escape import (
    markdown_block,
    markdown_code,
    markdown_table,
    markdown_text,
    printable_line,
)
from pemviz.reports.gate import GateDecision
from pemviz.reports.run_document import ANSWER, RECORD, TRUST, WHY, run_document
from pemviz.runs.result import RunResult

Marks = Mapping[Mark, str]
MARKS: Marks = {
    "yes": "\N{WHITE HEAVY CHECK MARK}",
    "no": "\N{CROSS MARK}",
    "open": "\N{WARNING SIGN}\N{VARIATION SELECTOR-16}",
}
PLAIN_MARKS: Marks = {"yes": "**ok:**", "no": "**no:**", "open": "**warning:**"}
"""For a viewer whose font has no pictures: rerun's ends itself at one without a display."""


def summary_markdown(result: RunResult, *, gate: GateDecision | None = None) -> str:
    """A run as one page, suited to the summary page of a pipeline's job."""
    document = run_document(result, gate=gate)
    first, *others = document.choose(("answer", "gate", *ANSWER[2:], *WHY, *TRUST, *RECORD))
    parts = [*sections_markdown([first], level=2, prefix=f"{document.title}: ")]
    parts += sections_markdown(others, level=3)
    return "\n\n".join(parts) + "\n"


def document_markdown(document: doc.Document) -> str:
    """A document as one page, under its title."""
    parts = [f"# {markdown_text(document.title)}", *sections_markdown(document.sections, level=2)]
    return "\n\n".join(parts) + "\n"


def sections_markdown(
    sections: Iterable[Section], *, level: int, prefix: str = "", marks: Marks = MARKS
) -> list[str]:
    """Paragraphs of sections in full, each under its title of a level.

    ``prefix`` stands before the words of a headline, ``marks`` before verdicts and warnings.
    """
    parts: list[str] = []
    for section in sections:
        if not section.full:
            continue
        if not isinstance(section.full[0], doc.Headline | doc.Verdict):
            parts.append(f"{'#' * level} {markdown_text(section.title)}")
        parts += blocks_markdown(section.full, level=level, prefix=prefix, marks=marks)
    return parts


def blocks_markdown(
    blocks: Iterable[Block], *, level: int, prefix: str = "", marks: Marks = MARKS
) -> Iterator[str]:
    """Paragraphs of blocks; warnings that follow each other are one list."""
    for kind, group in groupby(blocks, key=type):
        if kind is doc.Caution:
            yield "\n".join(f"- {marks['open']} {markdown_text(one.text)}" for one in group)  # pyright: ignore[reportAttributeAccessIssue]
            continue
        for block in group:
            yield from _block(block, level=level, prefix=prefix, marks=marks)


def _block(block: Block, *, level: int, prefix: str, marks: Marks) -> Iterator[str]:
    match block:
        case doc.Headline():
            text = f"{block.text[0].lower()}{block.text[1:]}" if prefix else block.text
            yield f"{'#' * level} {prefix}{markdown_text(text)}"
            if block.given:
                yield f"{markdown_text(f'{block.given[0].upper()}{block.given[1:]}')}."
        case doc.Paragraph():
            text = markdown_text(block.text)
            yield f"**{text}**" if block.tone in ("strong", "large") else text
        case doc.Caution():
            yield f"{marks['open']} {markdown_text(block.text)}"
        case doc.Verdict():
            yield f"{marks[block.mark]} **{markdown_text(block.text)}**"
        case doc.Bullets():
            sign = "1." if block.numbered else "-"
            yield "\n".join(f"{sign} {markdown_text(item)}" for item in block.items)
        case doc.Code():
            yield markdown_block(block.text, language=block.language)
        case doc.Table():
            yield from _table(block, marks)
        case doc.Figure():
            if block.words:
                yield from blocks_markdown(block.words, level=level, marks=marks)
            elif drawn := characters(block.chart):
                yield markdown_text(block.caption)
                yield markdown_block(drawn)
        case doc.Folded():
            body = "\n\n".join(blocks_markdown(block.blocks, level=level, marks=marks))
            yield (
                f"<details><summary>{markdown_text(block.title)}</summary>\n\n{body}\n\n</details>"
            )


def _table(block: doc.Table, marks: Marks) -> Iterator[str]:
    if block.name:
        yield f"{markdown_text(block.name)}:"
    header = tuple(markdown_text(column) for column in block.columns)
    yield markdown_table(header, [tuple(_cell(cell, marks) for cell in row) for row in block.rows])
    if block.note:
        yield markdown_text(block.note)


def _cell(cell: Cell, marks: Marks) -> str:
    if isinstance(cell, doc.Verdict):
        return f"{marks[cell.mark]} {markdown_text(cell.text)}"
    text = cell_text(cell)
    if not isinstance(cell, doc.Verbatim):
        return markdown_text(text)
    plain = printable_line(text)
    is_simple = bool(plain) and not set(plain) & set("`|\\")
    return f"`{plain}`" if is_simple else markdown_code(text)
