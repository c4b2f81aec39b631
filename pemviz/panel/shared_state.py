"""What all pages are told as it changes: the run shown, and how far the one under way is."""

from pemviz.panel.controller import PanelState
from pemviz.panel.run_summary import summary
from pemviz.panel.site import Json
from pemviz.runs.forecast import Progress, counted_in_words, left_in_words

LONG_S = 30.0
"""From when on it is told how many rollouts a minute brings."""


def shared_state(state: PanelState) -> Json:
    """The state as a page gets it."""
    run, progress = state.run, state.progress
    return {
        "running": state.running,
        "stopping": state.stopping,
        "error": state.error,
        "words": status_words(state),
        "share": None if progress is None else progress.share,
        "run": None if run is None else run.name,
        "kept": 0 if run is None else run.kept,
        "summary": None if run is None else summary(run.result, running=run.running),
        "finished": state.finished_runs,
    }


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
    words += f": {counted_in_words(progress)}"
    if progress.searched:
        words += f" and {progress.searched:,} in a search"
    words += f" {progress.workers}" if progress.workers else ""
    if progress.elapsed_s >= LONG_S and not progress.by_level:
        words += f", {60.0 * progress.done / progress.elapsed_s:,.0f} a minute"
    return ", ".join(filter(None, (words, left_in_words(progress))))
