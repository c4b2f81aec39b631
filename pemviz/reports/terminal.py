"""Documents on a terminal, by rich, and as plain lines."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from pemviz.reports import document as doc
from pemviz.reports.document import Block, Mark, cell_text, headline_text
from pemviz.reports.run_document import ANSWER, TRUST, WHY, run_document
from pemviz.runs.result import RunResult

SIGNS: dict[Mark, str] = {
    "yes": "\N{CHECK MARK}",
    "no": "\N{BALLOT X}",
    "open": "?",
}
WIDE = 6
"""Tables of so many columns have to break their numbers' heads."""
STYLES = {"plain": None, "strong": "bold", "large": "bold", "quiet": None}


def print_summary(result: RunResult, folder: Path, *, verbose: bool = False) -> None:
    """Print the answer, how far it is open, what causes violations, and where the run lies.

    If ``verbose``, with every figure and every warning, not only the gravest.
    """
    console = Console(highlight=False)
    keys = (*ANSWER, *WHY, *TRUST, *(("worst",) if verbose else ()))
    sections = run_document(result).choose(keys) if result.estimate is not None else ()
    for section in sections:
        blocks = section.full if verbose else section.brief
        if _needs_title(blocks):
            console.print(section.title, style="italic", markup=False, soft_wrap=True)
        _print(console, blocks)
    console.print(f"run folder: {folder}", markup=False, soft_wrap=True)


def print_document(document: doc.Document, *, verbose: bool = False) -> None:
    """Print a document under its title, in brief or, if ``verbose``, in full."""
    console = Console(highlight=False)
    _line(console, document.title, style="bold")
    for section in document.sections:
        if verbose:
            _line(console, section.title, style="italic")
        _print(console, section.full if verbose else section.brief)


def summary_text(result: RunResult) -> str:
    """Probability, interval, violations and every warning, for a terminal or a notebook."""
    document = run_document(result)
    said = document.blocks("answer", "given", "rules", "memory", *WHY, brief=True)
    warnings = document.blocks("warnings", "extrapolation")
    first, *others = plain_lines(
        [*said, *(one for one in warnings if isinstance(one, doc.Caution))]
    )
    return "\n".join([first, *(f"  {line}" for line in others)])


def _needs_title(blocks: Sequence[Block]) -> bool:
    """Whether there is more than sentences, and nothing with a name of its own comes first."""
    first = next((b for b in blocks if isinstance(b, doc.Table | doc.Bullets | doc.Figure)), None)
    named = isinstance(first, doc.Table) and bool(first.name)
    return first is not None and not named and not isinstance(blocks[0], doc.Headline)


def _print(console: Console, blocks: Iterable[Block]) -> None:
    for block in blocks:
        match block:
            case doc.Headline():
                _line(console, headline_text(block))
            case doc.Paragraph():
                indent = "  " if block.tone == "quiet" else ""
                _line(console, f"{indent}{block.text}", style=STYLES[block.tone])
            case doc.Caution():
                _line(console, f"warning: {block.text}", style="yellow")
            case doc.Verdict():
                _line(console, f"{SIGNS[block.mark]} {block.text}")
            case doc.Bullets():
                for item in block.items:
                    _line(console, f"- {item}")
            case doc.Code():
                _line(console, block.text)
            case doc.Table():
                console.print(_table(block))
            case doc.Figure():
                _print(console, block.words)
            case doc.Folded():
                _print(console, block.blocks)


def _line(console: Console, text: str, *, style: str | None = None) -> None:
    console.print(text, style=style, markup=False, soft_wrap=True)


def _table(block: doc.Table) -> RichTable:
    """A table without lines: what is copied from a terminal reads as it stands."""
    table = RichTable(
        title=escape(block.name) or None, title_justify="left", box=None, pad_edge=False,
        caption=escape(block.note) or None, caption_justify="left",
        show_header=any(block.columns),
    )  # fmt: skip
    for place, column in enumerate(block.columns):
        number = place in block.numbers
        table.add_column(
            escape(column),
            justify="right" if number else "left",
            no_wrap=number and len(block.columns) < WIDE,
        )
    for row in block.rows:
        table.add_row(*(escape(cell_text(cell)) for cell in row))
    return table


def plain_lines(blocks: Iterable[Block]) -> list[str]:
    """Blocks as lines of text without any style, for a log or a test report."""
    lines: list[str] = []
    for block in blocks:
        match block:
            case doc.Headline():
                lines.append(headline_text(block))
            case doc.Paragraph() | doc.Code():
                lines += block.text.splitlines()
            case doc.Caution():
                lines.append(f"warning: {block.text}")
            case doc.Verdict():
                lines.append(block.text)
            case doc.Bullets():
                lines += block.items
            case doc.Table():
                joint = ": " if len(block.columns) == 2 else "; "
                lines += [joint.join(map(cell_text, row)) for row in block.rows]
            case doc.Figure():
                lines += plain_lines(block.words)
            case doc.Folded():
                lines += plain_lines(block.blocks)
    return lines
