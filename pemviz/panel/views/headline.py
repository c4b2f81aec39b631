"""The answer and how far to trust it, in a few lines above all tabs; and the progress."""

from collections.abc import Sequence
from html import escape

from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.run_observer import Progress
from pemviz.reports.data_plan_text import short_rows
from pemviz.reports.digits import digits_of
from pemviz.reports.estimate_text import (
    aimed_text,
    beyond_default_text,
    interval_name,
    level_text,
    no_interval_text,
    occasion_text,
)
from pemviz.reports.gate import decide_run
from pemviz.reports.memory_curve import assumption_worth
from pemviz.reports.pictures.html import block, good, grid, number, quiet, warning
from pemviz.reports.pictures.uncertainty import uncertainty_plot
from pemviz.reports.rates_text import rate_line
from pemviz.reports.rules_text import RULE_COLUMNS, RULES_TITLE, rule_rows
from pemviz.runs.result import RunResult
from pemviz.runs.trust import run_diagnostics, run_interval_caveats
from pemviz.types import Estimate


def headline(run: RunData | None, *, limit: float | None = None) -> str:
    """The run's name and its answer.

    Args:
        run: The run shown.
        limit: What its upper bound is to be compared with.
    """
    if run is None:
        return block(quiet("Nothing has run yet. Press Run in the Experiment tab."))
    config = run.config
    title = (
        f"<div style='display:flex;justify-content:space-between;gap:8px'>"
        f"<b>{escape(run.name)}</b>"
        f"<span style='color:#52606d'>{escape(config.method)}, {escape(config.metric)}</span></div>"
    )
    return block(title + _answer(run) + _gate(run, limit))


def _answer(run: RunData) -> str:
    estimate = run.result.estimate
    if estimate is None:
        words = "no estimate yet" if run.running else "no estimate: the run did not come to its end"
        return quiet(words)
    if not estimate.failures:
        bound = _upper_bound(estimate, run_interval_caveats(run.result))
        answer = f"P(violation): no violation was seen{bound}"
    else:
        digits = digits_of(estimate.ci_low, estimate.ci_high)
        answer = f"P(violation) = {number(estimate.probability, digits)}"
    interval = _interval(estimate, run_interval_caveats(run.result))
    rules = run.config.rules
    what = f"any of {len(rules)} rules" if rules else run.config.spec
    counts = (
        f"{estimate.failures} of {estimate.rollouts_in_estimate} rollouts"
        f"{aimed_text(estimate)} violate {what}, {estimate.rollouts_simulated} simulated"
    )
    lines = f"<div style='font-size:16px;font-weight:600;margin:2px 0'>{answer}</div>"
    asked = beyond_default_text(run.result)
    given = f"; with {asked}" if asked else ""
    per = occasion_text(run.config)
    lines += quiet(f"in one {per}, if error model {run.result.pem.name} is right{given}")
    lines += quiet(f"{interval}; {counts}" if estimate.failures else counts)
    worth = assumption_worth(run.result.memory)
    lines += warning(f"{worth} (more in Why)") if worth else ""
    rate = rate_line(run.result)
    lines += quiet(rate) if rate else ""
    lines += _rules(run.result)
    diagnostics = run_diagnostics(run.result)
    for first in diagnostics[:1]:
        others = len(diagnostics) - 1
        lines += warning(f"{first.text} (and {others} more in Why)" if others else first.text)
    return lines + uncertainty_plot(run.result) + _next(run.result)


def _rules(result: RunResult) -> str:
    """Each rule's answer; nothing without rules."""
    if not result.rules:
        return ""
    rows = [tuple(map(escape, row[:-1])) for row in rule_rows(result)]
    return grid(RULE_COLUMNS[:-1], rows, name=RULES_TITLE)


def _gate(run: RunData, limit: float | None) -> str:
    """Whether the answer stays below a limit; nothing without one."""
    if limit is None or run.running:
        return ""
    decision = decide_run(run.result, limit=limit)
    words = f"Fail above {number(limit, 2)}: {decision.sentence}"
    return good(words) if decision.outcome == "passed" else warning(words)


def _next(result: RunResult) -> str:
    """What to measure next, the first line of it; the tab Why has the rest."""
    for collect, then in short_rows(result)[:1]:
        return quiet(f"Measure next: {collect}; {then} (more in Why)")
    return ""


def _interval(estimate: Estimate, caveats: Sequence[str]) -> str:
    words = interval_name(estimate, caveats=caveats)
    digits = digits_of(estimate.ci_low, estimate.ci_high)
    interval = f"{words} {number(estimate.ci_low, digits)} to {number(estimate.ci_high, digits)}"
    return f"{interval}, {_doubt(estimate, caveats) if caveats else 'sampling alone'}"


def _upper_bound(estimate: Estimate, caveats: Sequence[str]) -> str:
    if estimate.ci_high is None:
        return " and there is no upper bound"
    if caveats:
        return f"; upper bound {number(estimate.ci_high)}, {_doubt(estimate, caveats)}"
    return f"; {level_text(estimate)} upper bound {number(estimate.ci_high)}"


def _doubt(estimate: Estimate, caveats: Sequence[str]) -> str:
    """What an interval is not, and the first reason; the tab Why has them all."""
    more = f" (and {len(caveats) - 1} more in Why)" if len(caveats) > 1 else ""
    return f"{no_interval_text(estimate)}: {caveats[0]}{more}"


def status(state: PanelState) -> str:
    """What runs, how far it is, what went wrong."""
    if state.error is not None:
        return block(f"<div role='alert'>{warning(state.error)}</div>")
    if not state.running:
        return block(f"<div role='status'>{quiet('Ready.')}</div>")
    if state.stopping:
        words = "Stopping; what is finished is kept."
    elif state.progress is None:
        words = "Starting\N{HORIZONTAL ELLIPSIS}"
    else:
        words = progress_text(state.progress)
    return block(f"<div role='status'>{quiet(words)}</div>")


def progress_text(progress: Progress) -> str:
    """Stage, rollouts, time left."""
    stage = min(progress.stage, progress.stages - 1)
    words = f"Stage {stage} of {progress.stages - 1}"
    if progress.stages == 1:
        words = "Simulating"
    if progress.repetitions > 1:
        words = f"Repetition {progress.repetition + 1} of {progress.repetitions}, {words.lower()}"
    if progress.by_level:
        words += f": {progress.share:.0%} of the way to violations"
    else:
        words += f": {progress.done:,} of {progress.planned:,} rollouts"
    if progress.left_s is not None:
        words += f", about {_duration(progress.left_s)} left"
    return words


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    if seconds < 5400.0:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h"
