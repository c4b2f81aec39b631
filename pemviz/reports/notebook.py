"""Results as a notebook shows them: how likely, how far that is open, what to measure next."""

from collections.abc import Sequence

import numpy as np

from pemviz.charts.chart import Axis, Line, PlaneChart, Points
from pemviz.colors import BLUE, MISSED
from pemviz.reports.document import Caution, Figure, Folded, Headline, Paragraph
from pemviz.reports.estimate_words import (
    interval_name,
    interval_text,
    next_text,
    short_probability,
    violations_text,
)
from pemviz.reports.html import blocks_html, embedded, paragraph, sections_html
from pemviz.reports.run_document import WHY, run_document
from pemviz.runs.observers import Rollout
from pemviz.runs.result import RunResult
from pemviz.sampling.estimates.trust import interval_caveats, remedy
from pemviz.types import Estimate

WIDTH_PX = 560


def result_html(result: RunResult) -> str:
    """The headline of a run, and what to measure next, what causes violations, what to mind."""
    document = run_document(result)
    first = ("answer", "given", "rules", "rates")
    then = ("uncertainty", "memory", "plan", *WHY)
    parts = [
        sections_html(document.choose(first), brief=True),
        blocks_html(b for b in document.blocks("warnings") if isinstance(b, Caution)),
        sections_html(document.choose(then), brief=True),
    ]
    if minded := document.blocks("extrapolation"):
        parts.append(blocks_html([Folded(f"{len(minded)} about the error model", minded)]))
    return _box(parts)


def estimate_html(estimate: Estimate) -> str:
    """An estimate with its interval and what is wrong with it."""
    caveats = interval_caveats(estimate)
    called = interval_name(estimate, caveats=caveats)
    # an estimate knows nothing of its scenario: what serves any
    loses = any(diagnostic.kind.startswith("lost") for diagnostic in estimate.diagnostics)
    checks = () if loses else ("subset",)
    better = remedy(estimate.method, checks=checks, diagnostics=estimate.diagnostics)
    said = (
        Headline(f"Failure probability {short_probability(estimate)}"),
        Paragraph(f"{called} {interval_text(estimate, caveats=caveats)}, sampling alone"),
        Paragraph(f"{estimate.method}: {violations_text(estimate)} violate", tone="quiet"),
        *(Paragraph(line, tone="quiet") for line in next_text(better if caveats else None)),
        *(Caution(diagnostic.text) for diagnostic in estimate.diagnostics),
    )
    return _box([blocks_html(said)])


def rollout_html(rollout: Rollout) -> str:
    """A rollout's signals against time, with the misses below each."""
    plots = (Figure(_signal_chart(rollout, name)) for name in rollout.signals)
    return _box([paragraph(str(rollout)), blocks_html(plots)])


def _signal_chart(rollout: Rollout, name: str) -> PlaneChart:
    """A signal against time, and below it when perception missed."""
    values, missed_s = rollout.signals[name], rollout.time_s[rollout.missed_steps]
    low, high = float(np.min(values)), float(np.max(values))
    room = 0.12 * (high - low) or 0.5
    below = np.full(missed_s.size, low - 0.7 * room)
    return PlaneChart(
        title=name.replace("_", " "),
        x=Axis(0.0, float(rollout.time_s[-1]) or 1.0, "time [s]"),
        y=Axis(low - room, high + room, ""),
        marks=(
            Line(rollout.time_s, values, BLUE, width=2.0),
            Points(missed_s, below, MISSED, label="missed", radius=2.0),
        ),
        width=WIDTH_PX,
        height=130,
    )


def _box(parts: Sequence[str]) -> str:
    """On white, as a notebook may be dark."""
    style = f"background:#ffffff;max-width:{WIDTH_PX}px;padding:8px 10px"
    return embedded("".join(parts), font_px=12.5, style=style)
