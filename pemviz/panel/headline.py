"""The answer and how far to trust it, in a few lines above all tabs; and the progress."""

from html import escape

from pemviz.panel.browser import Browser
from pemviz.panel.controller import PanelState, Progress
from pemviz.panel.page import block, number, quiet
from pemviz.panel.run_data import RunData
from pemviz.reports.document import Caution, Figure, Paragraph, Verdict
from pemviz.reports.gate import decide_run
from pemviz.reports.html import blocks_html, warning
from pemviz.reports.memory_words import assumption_worth
from pemviz.reports.plan_words import short_rows
from pemviz.reports.run_document import run_document


def headline(run: RunData | None, *, limit: float | None = None) -> str:
    """The run's name and its answer, its upper bound compared with a limit."""
    if run is None:
        return block(quiet("Nothing has run yet. Press Run in the Experiment tab."))
    title = (
        f"<div style='display:flex;justify-content:space-between;gap:8px'>"
        f"<b>{escape(run.name)}</b>"
        f"<span style='color:#52606d'>{escape(run.config.method)}, "
        f"{escape(run.config.metric)}</span></div>"
    )
    document = run_document(run.result, running=run.running)
    doubts = [one for one in document.blocks("warnings") if isinstance(one, Caution)]
    more = f" (and {len(doubts) - 1} more in Why)" * (len(doubts) > 1)
    worth = assumption_worth(run.result.memory)
    lines = [
        *document.blocks("answer", brief=True),
        *([Caution(f"{worth} (more in Why)")] if worth else []),
        *document.blocks("rules", brief=True),
        *(Caution(f"{one.text}{more}") for one in doubts[:1]),
        *(one for one in document.blocks("uncertainty", brief=True) if isinstance(one, Figure)),
    ]
    for collect, then in short_rows(run.result)[:1]:
        lines.append(Paragraph(f"Measure next: {collect}; {then} (more in Why)", tone="quiet"))
    if limit is not None and not run.running:
        gate = decide_run(run.result, limit=limit)
        words = f"Fail above {number(limit, 2)}: {gate.sentence}"
        lines.append(Verdict("yes", words) if gate.outcome == "passed" else Caution(words))
    return block(title + blocks_html(lines))


def status(state: PanelState) -> str:
    """What runs, how far it is, what went wrong."""
    if state.error is not None:
        return block(f"<div role='alert'>{warning(state.error)}</div>")
    return block(f"<div role='status'>{quiet(status_words(state))}</div>")


def status_words(state: PanelState) -> str:
    """What runs, and how far it is."""
    if not state.running:
        return "Ready."
    if state.stopping:
        return "Stopping; what is finished is kept."
    if state.progress is None:
        return "Starting\N{HORIZONTAL ELLIPSIS}"
    return _progress_text(state.progress)


def _progress_text(progress: Progress) -> str:
    if progress.goes_on:
        words = f"Stage {progress.stage}"
    elif progress.stages == 1:
        words = "Simulating"
    else:
        words = f"Stage {min(progress.stage, progress.stages - 1)} of {progress.stages - 1}"
    if progress.repetitions > 1:
        words = f"Repetition {progress.repetition + 1} of {progress.repetitions}, {words.lower()}"
    if progress.by_level:
        words += f": {progress.share:.0%} of the way to violations"
    elif progress.goes_on:
        words += f": {progress.done:,} rollouts, until the interval is as narrow as asked"
    else:
        words += f": {progress.done:,} of {progress.planned:,} rollouts"
    left_s = progress.left_s
    if left_s is None:
        return words
    left = f"{max(1, round(left_s))} s"
    if left_s >= 90.0:
        left = f"{round(left_s / 60)} min" if left_s < 5400.0 else f"{left_s / 3600:.1f} h"
    return f"{words}, about {left} left"


class Head:
    """The answer, the state, the progress bar."""

    def __init__(self, browser: Browser) -> None:
        gui = browser.client.gui
        self._headline = gui.add_html("")
        self._status = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, visible=False, color="blue")

    def refresh(self, state: PanelState, run: RunData | None, *, limit: float | None) -> None:
        """Show the state; the answer is judged by ``limit``."""
        self._headline.content = headline(run, limit=limit)
        self._status.content = status(state)
        self._bar.visible = state.running
        self._bar.value = 100.0 * state.progress.share if state.progress is not None else 0.0
