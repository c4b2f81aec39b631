"""Pieces of HTML that the pages of a run are made of."""

import math

from pemviz.charts.chart import Chart, with_unit
from pemviz.panel.run_data import ScanProgress
from pemviz.reports.document import Figure
from pemviz.reports.html import blocks_html, paragraph
from pemviz.types import Signal

MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
RUN_DASHES = ("", "6 3", "2 3", "9 3 2 3", "12 4", "4 4")
"""Of lines side by side, beside their colours: as many as can be told apart."""
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number in few digits, a dash if there is none."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    if value != 0.0 and not 1e-3 <= abs(value) < 1e6:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = str(int(exponent)).translate(SUPERSCRIPT)
        return f"{mantissa} {TIMES} 10{power}".replace("-", MINUS)
    return f"{value:.{digits}g}".replace("-", MINUS)


def percent(value: float) -> str:
    """A share from 0 to 1 in per cent."""
    points = 100.0 * value
    return f"{points:.0f} %" if points >= 9.95 or points == 0.0 else f"{number(points, 2)} %"


def quiet(words: str) -> str:
    """An explanation."""
    return paragraph(words, "quiet")


def drawn(chart: Chart | None, *, caption: str = "", target: str = "") -> str:
    """A chart that can be saved; nothing without one. ``target``: what clicks on points are for."""
    return "" if chart is None else blocks_html([Figure(chart, caption, target=target)], live=True)


def signal_name(signal: Signal) -> str:
    """A signal in words."""
    return signal.name.replace("_", " ")


def signal_label(signal: Signal) -> str:
    """A signal in words with its unit."""
    return with_unit(signal_name(signal), signal.unit)


def cells(*bodies: str) -> str:
    """Pieces that stand beside each other where there is room, without those that are empty."""
    return "".join(f"<section>{body}</section>" for body in bodies if body)


def progress_words(progress: ScanProgress) -> str:
    """How far a look at all rollouts is."""
    return f"{progress.done:,} of {progress.count:,} rollouts"
