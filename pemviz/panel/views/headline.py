"""The answer and how far to trust it, in a few lines above all tabs; and the progress."""

from html import escape

from pemviz.panel.controller import PanelState
from pemviz.panel.run_data import RunData
from pemviz.panel.run_observer import Progress
from pemviz.panel.views.html import block, number, quiet, warning
from pemviz.runs.judge import run_diagnostics


def headline(run: RunData | None) -> str:
    """The run's name and its answer."""
    if run is None:
        return block(quiet("Nothing has run yet. Press Run in the Experiment tab."))
    config = run.config
    title = (
        f"<div style='display:flex;justify-content:space-between;gap:8px'>"
        f"<b>{escape(run.name)}</b>"
        f"<span style='color:#52606d'>{escape(config.method)}, {escape(config.metric)}</span></div>"
    )
    return block(title + _answer(run))


def _answer(run: RunData) -> str:
    estimate = run.result.estimate
    if estimate is None:
        words = "no estimate yet" if run.running else "no estimate: the run did not come to its end"
        return quiet(words)
    if not estimate.failures:
        upper = estimate.ci_high
        bound = (
            f"; 95 % upper bound {number(upper)}"
            if upper is not None
            else " and there is no upper bound"
        )
        answer = f"P(violation): no violation was seen{bound}"
    else:
        answer = (
            f"P(violation) = {number(estimate.probability)}"
            f" \N{PLUS-MINUS SIGN} {number(estimate.std_error, 2)}"
        )
    interval = f"95 % interval {number(estimate.ci_low, 2)} to {number(estimate.ci_high, 2)}"
    counts = (
        f"{number(estimate.failures, 6)} of {number(estimate.rollouts_in_estimate, 6)} rollouts"
        f" violate, {number(estimate.rollouts_simulated, 6)} simulated"
    )
    lines = f"<div style='font-size:16px;font-weight:600;margin:2px 0'>{answer}</div>"
    lines += quiet(f"{interval}; {counts}" if estimate.failures else counts)
    diagnostics = run_diagnostics(run.result)
    for first in diagnostics[:1]:
        others = len(diagnostics) - 1
        lines += warning(f"{first.text} (and {others} more in Why)" if others else first.text)
    return lines


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
