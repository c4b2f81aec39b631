"""Pieces of HTML that the panel's views are made of: numbers, headings, remarks, tables."""

import math
from collections.abc import Sequence
from html import escape

from pemviz.colors import GREY, VERMILLION

STYLE = "font-family:system-ui,sans-serif;font-size:12.5px;line-height:1.45;color:#1f2933"
MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
SUPERSCRIPT = str.maketrans(
    "-0123456789",
    "\N{SUPERSCRIPT MINUS}\N{SUPERSCRIPT ZERO}\N{SUPERSCRIPT ONE}\N{SUPERSCRIPT TWO}"
    "\N{SUPERSCRIPT THREE}\N{SUPERSCRIPT FOUR}\N{SUPERSCRIPT FIVE}\N{SUPERSCRIPT SIX}"
    "\N{SUPERSCRIPT SEVEN}\N{SUPERSCRIPT EIGHT}\N{SUPERSCRIPT NINE}",
)


# A click writes the number of a row, or of a point, into viser's own input, as typing it would;
# placing the caret there would scroll the tab to it.
CLICK = (
    "(function(r,t){var i=document.getElementById(t);if(!i||!r)return;"
    "var s=r,y;while(s&&!s.scrollTop)s=s.parentElement;y=s?s.scrollTop:0;"
    "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(i,r.dataset.number);"
    "i.dispatchEvent(new Event('input',{bubbles:true}));"
    "function back(){i.blur();if(s)s.scrollTop=y;}setTimeout(back,0);setTimeout(back,60);})"
)
CLICK_ROW = f"{CLICK}(this,this.dataset.target)"
CLICK_POINT = f"{CLICK}(event.target.closest('[data-number]'),this.dataset.target)"


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
    return f"<div style='{STYLE};padding:0 0.75em 0.5em'>{body}</div>"


def heading(words: str) -> str:
    """A heading within a tab."""
    return f"<div style='font-weight:600;margin:6px 0 2px'>{escape(words)}</div>"


def quiet(words: str) -> str:
    """An explanation."""
    return f"<div style='color:#52606d;font-size:11.5px'>{escape(words)}</div>"


def warning(words: str) -> str:
    """Something that the reader must not miss; set apart by a sign, not by colour alone."""
    return (
        f"<div style='border-left:3px solid {VERMILLION};background:#fdf3ec;padding:3px 7px;"
        f"margin:3px 0;font-size:11.5px'>\N{WARNING SIGN} {escape(words)}</div>"
    )


def good(words: str) -> str:
    """A remark that all is well."""
    return f"<div style='color:{GREY};font-size:11.5px'>\N{CHECK MARK} {escape(words)}</div>"


def cells(values: Sequence[str], *, style: str) -> str:
    """A row's cells; the values are HTML already."""
    return "".join(f"<td style='{style}'>{value}</td>" for value in values)


def clickable(number: int, *, target: str) -> str:
    """Attributes of a table's row that writes its number into an input when it is clicked.

    Args:
        number: The row's.
        target: The input's element id.
    """
    return (
        f"role='button' data-number='{number}' data-target='{escape(target, quote=True)}'"
        f" onclick='{escape(CLICK_ROW, quote=True)}'"
    )


def clickable_points(*, target: str) -> str:
    """Attributes of what holds points with a ``data-number`` each, as :func:`clickable`."""
    onclick = escape(CLICK_POINT, quote=True)
    return f"data-target='{escape(target, quote=True)}' onclick='{onclick}'"


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
    head = "".join(f"<th style='{_CELL};color:#52606d;font-weight:500'>{h}</th>" for h in header)
    more = [*attributes, *[""] * (len(body) - len(attributes))]
    lines = "".join(
        f"<tr {extra} style='border-top:1px solid #e4e7eb{';cursor:pointer' if extra else ''}'>"
        f"{cells(line, style=_CELL)}</tr>"
        for line, extra in zip(body, more, strict=True)
    )
    return (
        f"<table aria-label='{escape(name, quote=True)}' style='border-collapse:collapse;"
        f"width:100%;margin-bottom:4px;font-size:11.5px;font-variant-numeric:tabular-nums'>"
        f"<thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>"
    )


_CELL = "padding:2px 5px;text-align:left;vertical-align:top"
