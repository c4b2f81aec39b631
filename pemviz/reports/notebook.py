"""Results as a notebook shows them: how likely, how far that is open, what to measure next."""

from collections.abc import Sequence
from html import escape

import numpy as np

from pemviz.colors import BLUE, MISSED
from pemviz.reports.causes_text import burst_lines, causes_line
from pemviz.reports.data_plan_text import plan_heading, short_rows
from pemviz.reports.estimate_text import (
    interval_name,
    interval_text,
    memory_text,
    short_probability,
    violations_text,
)
from pemviz.reports.pictures.html import STYLE, quiet, warning
from pemviz.reports.pictures.memory import memory_curve
from pemviz.reports.pictures.starts import start_plane
from pemviz.reports.pictures.svg import Axis, Plot
from pemviz.reports.pictures.uncertainty import uncertainty_plot
from pemviz.reports.rates_text import rate_line
from pemviz.reports.starts_text import map_words, starts_line
from pemviz.runs.least_robust import Rollout
from pemviz.runs.result import RunResult
from pemviz.runs.trust import data_warnings, run_diagnostics, run_interval_caveats
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

WIDTH_PX = 560


def result_html(result: RunResult) -> str:
    """The headline of a run, and what to measure next, what causes violations, what to mind."""
    estimate = result.estimate
    if estimate is None:
        return _box([_large(f"No estimate: the run {result.status}"), *_failed(result)])
    caveats, rate = run_interval_caveats(result), rate_line(result)
    parts = [
        _large(f"Failure probability {short_probability(estimate)}"),
        _line(
            f"if error model {result.pem.name} is right; {_interval(estimate, caveats)}; "
            f"{result.config.method}: {violations_text(estimate)} violate {result.config.spec}"
        ),
        *([quiet(rate)] if rate else []),
        quiet(f"Misses are taken to be {memory_text(result.memory)}."),
        *(warning(diagnostic.text) for diagnostic in run_diagnostics(result)),
        uncertainty_plot(result),
        memory_curve(result.memory),
        *_next(result),
        *_causes(result),
        *_starts(result),
        *_minded(data_warnings(result)),
    ]
    return _box(parts)


def estimate_html(estimate: Estimate) -> str:
    """An estimate with its interval and what is wrong with it."""
    return _box(
        [
            _large(f"Failure probability {short_probability(estimate)}"),
            _line(f"{_interval(estimate, interval_caveats(estimate))}"),
            quiet(f"{estimate.method}: {violations_text(estimate)} violate"),
            *(warning(diagnostic.text) for diagnostic in estimate.diagnostics),
        ]
    )


def rollout_html(rollout: Rollout) -> str:
    """A rollout's signals against time, with the misses below each."""
    plots = [_signal_plot(rollout, name) for name in rollout.signals]
    return _box([_line(str(rollout)), *plots])


def _signal_plot(rollout: Rollout, name: str) -> str:
    values = rollout.signals[name]
    low, high = float(np.min(values)), float(np.max(values))
    room = 0.08 * (high - low) or 0.5
    plot = Plot(
        x=Axis(0.0, float(rollout.time_s[-1]) or 1.0, "time [s]; below the line: misses"),
        y=Axis(low - room, high + room, ""),
        width=WIDTH_PX,
        height=130,
        title=name.replace("_", " "),
    )
    plot.line(rollout.time_s, values, color=BLUE, width=2.0)
    missed_s = rollout.time_s[rollout.missed_steps]
    plot.ticks_at(missed_s, y_px=(plot.bottom - 7.0, plot.bottom - 1.0), color=MISSED)
    return plot.text()


def _interval(estimate: Estimate, caveats: Sequence[str]) -> str:
    named = interval_name(estimate, caveats=caveats)
    return f"{named} {interval_text(estimate, caveats=caveats)}, sampling alone"


def _next(result: RunResult) -> list[str]:
    rows = short_rows(result)
    if result.plan is None or not rows:
        return []
    lines = "".join(f"<li>{escape(f'{collect}: {then}')}</li>" for collect, then in rows)
    return [_line(plan_heading(result.plan)), f"<ul style='margin:2px 0 6px'>{lines}</ul>"]


def _causes(result: RunResult) -> list[str]:
    if result.explanation is None:
        return []
    return [
        _line(line) for line in (causes_line(result.explanation), *burst_lines(result.explanation))
    ]


def _starts(result: RunResult) -> list[str]:
    parts: list[str] = []
    for found in result.starts[:1]:
        parts += [_line(starts_line(found)), start_plane(found), quiet(map_words(found))]
    return parts


def _minded(warnings: Sequence[str]) -> list[str]:
    """Warnings about model and data, folded away."""
    if not warnings:
        return []
    lines = "".join(warning(text) for text in warnings)
    return [f"<details><summary>{len(warnings)} about the error model</summary>{lines}</details>"]


def _failed(result: RunResult) -> list[str]:
    return [warning(result.message)] if result.message else []


def _large(words: str) -> str:
    return f"<div style='font-size:17px;font-weight:600'>{escape(words)}</div>"


def _line(words: str) -> str:
    return f"<div>{escape(words)}</div>"


def _box(parts: Sequence[str]) -> str:
    """On white, as a notebook may be dark."""
    style = f"{STYLE};background:#ffffff;max-width:{WIDTH_PX}px;padding:8px 10px"
    return f"<div style='{style}'>{''.join(parts)}</div>"
