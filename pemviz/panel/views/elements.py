"""Pieces of HTML that the panel's views are made of: numbers, headings, remarks, tables."""

import math
from collections.abc import Sequence
from html import escape

from pemviz.reports.document import Verdict
from pemviz.reports.html import ROOT, blocks_html, clicks_to, paragraph

STYLE = "font-family:system-ui,sans-serif;font-size:12.5px;line-height:1.45;color:#1f2933"
MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
SUPERSCRIPT = str.maketrans(
    "-0123456789",
    "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ZERO}\N{SUPERSCRIPT ONE}\N{SUPERSCRIPT TWO}"
    "\N{SUPERSCRIPT THREE}\N{SUPERSCRIPT FOUR}\N{SUPERSCRIPT FIVE}\N{SUPERSCRIPT SIX}"
    "\N{SUPERSCRIPT SEVEN}\N{SUPERSCRIPT EIGHT}\N{SUPERSCRIPT NINE}",
)


def number(value: float | None, digits: int = 3) -> str:
    """A number in few digits, a dash if there is none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} {TIMES} 10{str(int(exponent)).translate(SUPERSCRIPT)}".replace(
            "-", MINUS
        )
    return f"{value:.{digits}g}".replace("-", MINUS)


def percent(value: float | None) -> str:
    """A share from 0 to 1 in per cent, a dash if there is none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    points = 100.0 * value
    return f"{points:.0f} %" if points >= 9.95 or points == 0.0 else f"{number(points, 2)} %"


def block(body: str) -> str:
    """Text in the panel's own style, in line with viser's controls."""
    return f"<div class='{ROOT}' style='{STYLE};padding:0 0.75em 0.5em'>{body}</div>"


def quiet(words: str) -> str:
    """An explanation."""
    return paragraph(words, "quiet")


def good(words: str) -> str:
    """A remark that all is well."""
    return blocks_html([Verdict("yes", words)])


def cells(values: Sequence[str], *, style: str) -> str:
    """A row's cells; the values are HTML already."""
    return "".join(f"<td style='{style}'>{value}</td>" for value in values)


def clickable(number: int, *, target: str) -> str:
    """Attributes of a table's row that writes its number into an input when it is clicked.

    Args:
        number: The row's.
        target: The input's element id.
    """
    return f"role='button' data-number='{number}' {clicks_to(target)}"


def grid(
    header: Sequence[str],
    body: Sequence[Sequence[str]],
    *,
    name: str,
    attributes: Sequence[str] = (),
) -> str:
    """A table; cells are HTML already.

    Args:
        header: Of the columns.
        body: Rows.
        name: For who does not see it.
        attributes: Of the first rows, a text each, for instance :func:`clickable`.
    """
    heads = "".join(f"<th>{h}</th>" for h in header)
    more = [*attributes, *[""] * (len(body) - len(attributes))]
    lines = "".join(
        f"<tr {extra}>{''.join(f'<td>{value}</td>' for value in line)}</tr>"
        for line, extra in zip(body, more, strict=True)
    )
    return (
        f"<table aria-label='{escape(name, quote=True)}'>"
        f"<thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table>"
    )
