"""Pieces of HTML that the views are made of, and how a page of the analysis is laid out."""

import math

from pemviz.panel.run_data import ScanProgress
from pemviz.reports.html import ROOT, paragraph
from pemviz.reports.html import SHEET as DOCUMENTS

STYLE = "font-family:system-ui,sans-serif;font-size:12.5px;line-height:1.45;color:#1f2933"
MINUS = "\N{MINUS SIGN}"
TIMES = "\N{MULTIPLICATION SIGN}"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
COLUMN_PX = 420
MARGIN_PX = 8
ROLLOUT_PX, CONTROLS_PX = 312, 126
"""Height of the rollout's window, and of its controls alone."""
NARROWEST_PX = 420
NOTICE_PX = 56
"""Where notices begin: below the names of the analysis' tabs."""
PLOT_PX = 400
SHORT_PX = 760
NARROW_PX = 1240
"""Pages lower than SHORT_PX leave the rollout's plots out while the analysis is open; pages
narrower than NARROW_PX leave out the plot of the speeds."""

ANALYSIS, ROLLOUT, PLOTS, SPEEDS = "pemviz-analysis", "pemviz-rollout", "pemviz-plots", "pemviz-v"
WIDE, CELL = "pemviz-wide", "pemviz-cell"

# viser tells the scene's size in the screen's own pixels, of which there may be more than CSS's:
# windows are asked for as large as that, and the style sheet cuts them to the page.
_WINDOW = "[data-floating-window]"
_SCENE = f"calc(100vw - {COLUMN_PX + 2 * MARGIN_PX}px)"
SHEET = f"""<style>{DOCUMENTS}
{_WINDOW}{{max-width:max({NARROWEST_PX}px,{_SCENE})}}
{_WINDOW}:has(.{ANALYSIS}){{max-height:calc(100vh - {ROLLOUT_PX + 3 * MARGIN_PX}px)}}
div:has(>div>.{ANALYSIS}){{display:grid;gap:4px 14px;padding:6px 12px;align-items:start;
grid-template-columns:repeat(auto-fit,minmax(min(100%,{PLOT_PX}px),1fr))}}
div:has(>.{ANALYSIS}),.{ANALYSIS}{{display:contents}}
div:has(>div>.{ANALYSIS})>:not(:has(>.{ANALYSIS})):not(:has(.uplot)),.{WIDE}{{grid-column:1/-1}}
.{CELL},.{WIDE},div:has(>.uplot-container){{min-width:0;overflow-x:auto}}
.mantine-Notifications-root[data-position=top-left]{{top:{NOTICE_PX}px!important}}
.uplot-container .uplot{{min-width:100%}}
.uplot .u-legend{{margin:2px 0 0!important}}
.{PLOTS}{{display:flex;gap:6px}}
.{PLOTS} svg{{flex:1 1 0;min-width:0;max-height:190px}}
@media (max-width:{NARROW_PX - 1}px){{.{SPEEDS}{{display:none!important}}}}
@media (max-height:{SHORT_PX - 1}px){{
{_WINDOW}:has(.{ANALYSIS}){{max-height:calc(100vh - {CONTROLS_PX + 3 * MARGIN_PX}px)}}
body:has(.{ANALYSIS}) .{PLOTS}{{display:none}}
body:has(.{ANALYSIS}) {_WINDOW}:has(.{ROLLOUT}){{height:{CONTROLS_PX}px!important;
top:auto!important;bottom:{MARGIN_PX}px!important}}
}}
</style>"""


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


def block(body: str) -> str:
    """Text in the panel's own style, in line with viser's controls."""
    return f"<div class='{ROOT}' style='{STYLE};padding:0 0.75em 0.5em'>{body}</div>"


def quiet(words: str) -> str:
    """An explanation."""
    return paragraph(words, "quiet")


def page(*cells: str) -> str:
    """A page's cells, side by side where there is room."""
    return f"<div class='{ANALYSIS} {ROOT}' style='{STYLE}'>{''.join(cells)}</div>"


def progress_words(progress: ScanProgress) -> str:
    """How far a look at all rollouts is."""
    return f"{progress.done:,} of {progress.count:,} rollouts"


def cell(body: str) -> str:
    """One place of the grid; nothing if there is nothing to show."""
    return f"<div class='{CELL}'>{body}</div>" if body else ""


def wide(body: str) -> str:
    """A row of its own."""
    return f"<div class='{WIDE}'>{body}</div>" if body else ""
