"""Documents as HTML: safety cases, the panel's pages, notebooks. Nothing in them is fetched."""

from collections.abc import Iterable, Mapping
from html import escape

from pemviz.charts.svg import svg
from pemviz.charts.table import chart_csv
from pemviz.colors import GREEN, GREY, MISSED, VERMILLION
from pemviz.reports import document as doc
from pemviz.reports.document import Block, Cell, Mark, Section
from pemviz.reports.escape import printable_line, printable_lines

ROOT = "pemviz"
"""Class of what holds a document; the style sheet reaches nothing else of a page."""
SIGNS: Mapping[Mark, str] = {
    "yes": "\N{CHECK MARK}",
    "no": "\N{BALLOT X}",
    "open": "?",
}
SHEET = f"""
.{ROOT} {{ color: #1f2933; line-height: 1.45; }}
.{ROOT} p, .{ROOT} ul, .{ROOT} ol {{ margin: 0.25em 0; }}
.{ROOT} ul, .{ROOT} ol {{ padding-left: 1.6em; }}
.{ROOT} h3, .{ROOT} h4 {{ font-size: 1em; font-weight: 600; margin: 0.6em 0 0.2em; }}
.{ROOT} .answer {{ font-size: 1.3em; font-weight: 650; margin: 0.1em 0; }}
.{ROOT} .large {{ font-size: 1.15em; font-weight: 650; margin: 0.1em 0 0.3em; }}
.{ROOT} .strong {{ font-weight: 600; }}
.{ROOT} .quiet, .{ROOT} figcaption {{ color: #52606d; font-size: 0.93em; }}
.{ROOT} .warn {{ border-left: 3px solid {VERMILLION}; background: #fdf3ec; padding: 0.2em 0.6em;
  margin: 0.25em 0; }}
.{ROOT} .tag {{ font-weight: 600; }}
.{ROOT} .yes {{ color: {GREEN}; }} .{ROOT} .no {{ color: {VERMILLION}; }}
.{ROOT} .open {{ color: {GREY}; }}
.{ROOT} table {{ border-collapse: collapse; width: 100%; margin: 0.3em 0;
  font-variant-numeric: tabular-nums; }}
.{ROOT} th, .{ROOT} td {{ text-align: left; vertical-align: top; padding: 0.15em 0.7em 0.15em 0;
  border-top: 1px solid #e4e7eb; overflow-wrap: break-word; }}
.{ROOT} th {{ color: #52606d; font-weight: 500; border-top: 0; }}
.{ROOT} td.n, .{ROOT} th.n {{ text-align: right; }}
.{ROOT} tr[data-number] {{ cursor: pointer; }}
.{ROOT} code, .{ROOT} pre {{ font-family: ui-monospace, "DejaVu Sans Mono", Menlo, monospace;
  font-size: 0.92em; overflow-wrap: anywhere; }}
.{ROOT} pre {{ white-space: pre-wrap; background: #f5f7f9; padding: 0.6em; }}
.{ROOT} figure {{ margin: 0.4em 0; }} .{ROOT} svg {{ max-width: 100%; height: auto; }}
.{ROOT} .strip {{ position: relative; height: 1.1em; min-width: 12em;
  background: linear-gradient(#e4e7eb, #e4e7eb) center / 100% 1px no-repeat; }}
.{ROOT} .strip i {{ position: absolute; top: 0.12em; bottom: 0.12em; min-width: 1px;
  background: {MISSED}; }}
"""


SAVES = (
    "<p class='saves'><button type='button' data-save='png' title='This chart as a picture'>PNG"
    "</button> <button type='button' data-save='csv' title='The numbers of this chart'>CSV"
    "</button></p>"
)
"""Of a chart on a live page, which hears of clicks on these."""


def sections_html(sections: Iterable[Section], *, brief: bool = False, live: bool = False) -> str:
    """Sections under their titles; a headline is its own. ``live`` as of :func:`blocks_html`."""
    parts: list[str] = []
    for section in sections:
        blocks = section.brief if brief else section.full
        first = blocks[0] if blocks else None
        drawn = isinstance(first, doc.Figure) and first.chart.title == section.title
        if blocks and not drawn and not isinstance(first, doc.Headline | doc.Verdict):
            parts.append(heading(section.title))
        parts.append(blocks_html(blocks, live=live))
    return "".join(parts)


def blocks_html(blocks: Iterable[Block], *, live: bool = False) -> str:
    """Blocks below each other.

    ``live``: The page hears of clicks, on rows and points that it knows and where a chart is
    saved; each chart then carries its numbers.
    """
    return "".join(_block(block, live=live) for block in blocks)


def _block(block: Block, *, live: bool) -> str:  # noqa: PLR0911  one a kind
    match block:
        case doc.Headline():
            given = paragraph(f"{block.given}.", "quiet") if block.given else ""
            return f"{paragraph(block.text, 'answer')}{given}"
        case doc.Paragraph():
            return paragraph(block.text, "" if block.tone == "plain" else block.tone)
        case doc.Caution():
            return warning(block.text)
        case doc.Verdict():
            return f"<p>{_cell(block)}</p>"
        case doc.Bullets():
            items = "".join(f"<li>{words(item)}</li>" for item in block.items)
            return f"<ol>{items}</ol>" if block.numbered else f"<ul>{items}</ul>"
        case doc.Code():
            return f"<pre>{escape(printable_lines(block.text))}</pre>"
        case doc.Table():
            return table(block, live=live)
        case doc.Figure():
            chart = svg(block.chart, act=clicks_to(block.target) if live else "")
            caption = f"<figcaption>{words(block.caption)}</figcaption>" if block.caption else ""
            if not live:
                return f"<figure>{chart}{caption}</figure>"
            numbers = escape(chart_csv(block.chart), quote=True).replace("\n", "&#10;")
            return f"<figure data-csv='{numbers}'>{chart}{caption}{SAVES}</figure>"
        case doc.Folded():
            title = f"<summary>{words(block.title)}</summary>"
            return f"<details>{title}{blocks_html(block.blocks, live=live)}</details>"


def words(text: str) -> str:
    """Text of anyone's as HTML: one line, nothing in it acts."""
    shown = escape(printable_line(text), quote=True)
    return f"<code>{shown}</code>" if isinstance(text, doc.Verbatim) else shown


def heading(text: str) -> str:
    """A heading within a page."""
    return f"<h3>{words(text)}</h3>"


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of text, of a class that the style sheet knows."""
    return f"<p class='{kind}'>{words(text)}</p>" if kind else f"<p>{words(text)}</p>"


def warning(text: str) -> str:
    """What a reader must not miss; set apart by a sign, not by colour alone."""
    return f"<div class='warn'>\N{WARNING SIGN} {words(text)}</div>"


def table(block: doc.Table, *, live: bool = False) -> str:
    """A table; rows that can be clicked bear their place."""
    click = f" {clicks_to(block.target)}" if live and block.target else ""
    heads = "".join(
        f"<th{_number(block, place)}>{words(cell)}</th>" for place, cell in enumerate(block.columns)
    )
    head = f"<thead><tr>{heads}</tr></thead>" if any(block.columns) else ""
    places = [*block.places, *[0] * (len(block.rows) - len(block.places))]
    rows = "".join(
        (f"<tr role='button' data-number='{place}'>" if click and place else "<tr>")
        + "".join(f"<td{_number(block, column)}>{_cell(c)}</td>" for column, c in enumerate(row))
        + "</tr>"
        for row, place in zip(block.rows, places, strict=True)
    )
    name = f" aria-label='{escape(block.name, quote=True)}'" if block.name else ""
    title = f"<h4>{words(block.name)}</h4>" if block.name else ""
    note = paragraph(block.note, "quiet") if block.note else ""
    return f"{title}<table{name}{click}>{head}<tbody>{rows}</tbody></table>{note}"


def clicks_to(target: str) -> str:
    """The attribute of what holds rows or points with a ``data-number`` each; empty of none."""
    return f"data-target='{escape(target, quote=True)}'" if target else ""


def _number(block: doc.Table, place: int) -> str:
    return " class='n'" if place in block.numbers else ""


def _cell(cell: Cell) -> str:
    if isinstance(cell, doc.Verdict):
        return f"<span class='tag {cell.mark}'>{SIGNS[cell.mark]} {words(cell.text)}</span>"
    if isinstance(cell, str):
        return words(cell)
    marks = "".join(
        f"<i style='left:{100 * low:.2f}%;width:{100 * (high - low):.2f}%'></i>"
        for low, high in cell.spans
    )
    return f"<div class='strip' title='{escape(cell.text, quote=True)}'>{marks}</div>"


def embedded(body: str, *, font_px: float, style: str = "") -> str:
    """A document within a page of others, with its style sheet."""
    outer = f"font-family:system-ui,sans-serif;font-size:{font_px:g}px;{style}"
    return f"<div class='{ROOT}' style='{outer}'><style>{SHEET}</style>{body}</div>"
