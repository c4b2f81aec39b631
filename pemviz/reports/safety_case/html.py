"""Pieces of a page's HTML, and how it looks on a screen and on paper."""

from collections.abc import Sequence
from html import escape

from pemviz.colors import BLUE, GREEN, GREY, VERMILLION
from pemviz.reports.escape import printable_line, printable_lines

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Of the page's content: nothing is fetched, no script runs."""

STYLE = f"""
:root {{ color-scheme: light; }}
* {{ box-sizing: border-box; }}
body {{ margin: 0; background: #fff; color: #1f2933;
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }}
main {{ max-width: 1060px; margin: 0 auto; padding: 28px 24px 60px; }}
h1 {{ font-size: 27px; line-height: 1.25; margin: 0 0 4px; }}
h2 {{ font-size: 20px; margin: 38px 0 8px; padding-bottom: 4px; border-bottom: 2px solid #d5dae0; }}
h3 {{ font-size: 16px; margin: 22px 0 6px; }}
p {{ margin: 6px 0 10px; max-width: 78ch; }}
ul, ol {{ margin: 6px 0 10px; padding-left: 22px; max-width: 82ch; }}
li {{ margin: 2px 0; }}
code, pre {{ font: 12.5px/1.45 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }}
code {{ overflow-wrap: anywhere; }}
pre {{ background: #f5f7f9; border: 1px solid #e1e6eb; border-radius: 4px; padding: 10px 12px;
  white-space: pre-wrap; overflow-wrap: anywhere; }}
table {{ border-collapse: collapse; width: 100%; margin: 6px 0 12px;
  font-variant-numeric: tabular-nums; }}
th, td {{ text-align: left; vertical-align: top; padding: 5px 10px 5px 0;
  border-bottom: 1px solid #e1e6eb; overflow-wrap: break-word; }}
th {{ font-weight: 600; color: #3e4c59; border-bottom: 2px solid #cbd2d9; }}
td.n, th.n {{ text-align: right; white-space: nowrap; padding-left: 10px; }}
figure {{ margin: 10px 0 14px; }}
figcaption, .quiet {{ color: #52606d; font-size: 13.5px; max-width: 82ch; }}
.two {{ display: grid; grid-template-columns: 1fr 1fr; gap: 8px 34px; align-items: start; }}
.head .two {{ grid-template-columns: 47fr 53fr; gap: 8px 24px; }}
.two > * {{ min-width: 0; }}
.half {{ max-width: 560px; }}
.wide {{ max-width: 780px; }}
table.facts td:first-child {{ width: 215px; color: #3e4c59; }}
.head {{ border: 1px solid #cbd2d9; border-radius: 6px; padding: 16px 20px 10px; margin: 16px 0; }}
.answer {{ font-size: 21px; white-space: nowrap; font-weight: 650; margin: 0 0 4px;
  max-width: none; }}
.tag {{ font-weight: 600; white-space: nowrap; }}
.yes {{ color: {GREEN}; }} .no {{ color: {VERMILLION}; }} .open {{ color: {GREY}; }}
.warn {{ border-left: 4px solid {VERMILLION}; background: #fdf3ec; padding: 6px 12px;
  margin: 8px 0; max-width: 88ch; }}
nav {{ margin: 10px 0 0; font-size: 14px; }}
nav a {{ color: {BLUE}; margin-right: 14px; text-decoration: none; }}
section.run {{ margin-top: 52px; border-top: 4px solid #1f2933; padding-top: 22px; }}
footer {{ margin-top: 46px; color: #52606d; font-size: 13px; border-top: 1px solid #e1e6eb;
  padding-top: 8px; }}
@page {{ size: A4; margin: 16mm 15mm 18mm;
  @bottom-right {{ content: counter(page) " / " counter(pages); font: 9pt sans-serif;
    color: #52606d; }} }}
@media print {{
  body {{ font-size: 9.6pt; }}
  main {{ max-width: none; padding: 0; }}
  nav {{ display: none; }}
  h1 {{ font-size: 17pt; }} h2 {{ font-size: 13pt; margin-top: 20pt; }} h3 {{ font-size: 10.8pt; }}
  code, pre {{ font-size: 8pt; }}
  figcaption, .quiet, footer {{ font-size: 8.6pt; }}
  .answer {{ font-size: 12pt; }}
  h2, h3 {{ break-after: avoid; }}
  figure, tr, .head, .warn, li {{ break-inside: avoid; }}
  section.run {{ break-before: page; margin: 0; border: 0; padding: 0; }}
  th, td {{ padding: 3px 8px 3px 0; }}
}}
"""


def document(*, title: str, body: str) -> str:
    """A whole page; ``body`` is HTML, ``title`` text. What cannot be printed is replaced."""
    page = (
        "<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        "<meta name='viewport' content='width=device-width, initial-scale=1'>\n"
        "<meta name='referrer' content='no-referrer'>\n"
        f"<title>{words(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )
    return f"{printable_lines(page)}\n"


def words(text: str) -> str:
    """Text of anyone's as HTML: one line, nothing in it acts."""
    return escape(printable_line(text), quote=True)


def paragraph(text: str, *, kind: str = "") -> str:
    """A paragraph of text."""
    return f"<p{_class(kind)}>{words(text)}</p>"


def bullets(items: Sequence[str]) -> str:
    """A list of texts; empty without any."""
    return f"<ul>{''.join(f'<li>{words(item)}</li>' for item in items)}</ul>" if items else ""


def warnings(items: Sequence[str]) -> str:
    """Texts that must not be missed, set apart by a sign and not by colour alone."""
    return "".join(f"<div class='warn'>\N{WARNING SIGN} {words(item)}</div>" for item in items)


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Sequence[int] = ()
) -> str:
    """A table of texts; columns ``numbers`` are set to the right; empty without rows."""
    safe = [[words(cell) for cell in row] for row in rows]
    return html_table(header, safe, numbers=numbers)


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """A table of names and what they are, without a header; empty without rows."""
    lines = "".join(f"<tr><td>{words(a)}</td><td>{words(b)}</td></tr>" for a, b in rows)
    return f"<table class='facts'><tbody>{lines}</tbody></table>" if rows else ""


def html_table(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Sequence[int] = ()
) -> str:
    """A table whose cells are HTML already, and whose header is text; empty without rows."""
    if not rows:
        return ""
    heads = "".join(f"<th{_number(i, numbers)}>{words(cell)}</th>" for i, cell in enumerate(header))
    lines = "".join(
        f"<tr>{''.join(f'<td{_number(i, numbers)}>{c}</td>' for i, c in enumerate(row))}</tr>"
        for row in rows
    )
    head = f"<thead><tr>{heads}</tr></thead>" if any(header) else ""
    return f"<table>{head}<tbody>{lines}</tbody></table>"


def figure(picture: str, caption: str) -> str:
    """A picture (HTML) with its caption (text); empty without a picture."""
    if not picture:
        return ""
    return f"<figure>{picture}<figcaption>{words(caption)}</figcaption></figure>"


def pair(left: str, right: str) -> str:
    """Two pieces of HTML beside each other; one alone stands by itself, as wide as half a page."""
    if not left or not right:
        alone = left or right
        return f"<div class='half'>{alone}</div>" if alone else ""
    return f"<div class='two'><div>{left}</div><div>{right}</div></div>"


def code_block(text: str) -> str:
    """Several lines in fixed width."""
    return f"<pre>{escape(text)}</pre>"


def _class(kind: str) -> str:
    return f" class='{kind}'" if kind else ""


def _number(index: int, numbers: Sequence[int]) -> str:
    return " class='n'" if index in numbers else ""
