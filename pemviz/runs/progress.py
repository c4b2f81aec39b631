"""Progress on standard error: a bar on a terminal, a few lines elsewhere."""

import contextlib
import time
from collections.abc import Generator

from rich.console import Console
from rich.progress import (
    Progress,
    TaskID,
    TextColumn,
)

from pemviz.bars import bar, drawn_on_terminal
from pemviz.runs.events import Event, Observer, RepetitionDone, RolloutsDone, RunStarted, StageDone
from pemviz.runs.ranking import summarise_stage
from pemviz.runs.result import StageSummary
from pemviz.sampling.registry import by_name

QUARTERS = 4
SILENT_S = 30.0
REPEATED = "simulated again"


class ProgressBar:
    """Observer that shows stage, threshold, failures and time left."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task: TaskID | None = None
        self._done_before = 0
        self._repetitions = 1
        self._planned = 0
        self._by_level = False

    def notify(self, event: Event) -> None:
        """Move the bar."""
        match event:
            case RunStarted():
                self._repetitions = event.config.repetitions
                self._planned = event.planned_rollouts
                self._by_level = by_name(event.config.method).counting == "level"
                self._task = self._progress.add_task("starting", total=self._planned, counted="")
            case RolloutsDone(again=True):
                text = f"{REPEATED}: {event.done} of {event.total}"
                self._move(self._done_before, description=text)
            case RolloutsDone():
                self._move(self._done_before + event.done)
            case StageDone():
                self._done_before += event.stage.count
                text = stage_line(summarise_stage(event.stage), repetitions=self._repetitions)
                self._move(self._done_before, description=text)
            case _:
                pass

    def _move(self, done: int, *, description: str | None = None) -> None:
        if self._task is not None:
            counted = counted_in_words(done, self._planned, by_level=self._by_level)
            self._progress.update(
                self._task, completed=done, counted=counted, description=description
            )


def counted_in_words(done: int, planned: int, *, by_level: bool) -> str:
    """How far a run is; ``by_level``: by the levels passed, not by rollouts."""
    if by_level:
        return f"{done / max(planned, 1):.0%} of the way to violations"
    return f"{done:,} of {planned:,} rollouts"


class ProgressLines:
    """Observer that prints a line where a quarter of the stages is done, or of the repetitions.

    What takes long is told of more often: once in :data:`SILENT_S`, if a batch of rollouts ends.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._repetitions = 1
        self._stages = 1
        self._reported_s = time.monotonic()

    def notify(self, event: Event) -> None:
        """Print what is done."""
        match event:
            case RunStarted():
                self._repetitions, self._stages = event.config.repetitions, event.stages
            case RolloutsDone() if event.done < event.total and self._is_silent():
                of = f", repetition {event.repetition + 1}" if self._repetitions > 1 else ""
                at = REPEATED if event.again else f"stage {event.stage}"
                self._print(f"{at}{of}: {event.done} of {event.total} rollouts")
            case StageDone() if self._repetitions == 1:
                if self._is_due(event.stage.stage, self._stages):
                    self._print(stage_line(summarise_stage(event.stage), repetitions=1))
            case RepetitionDone() if self._repetitions > 1:
                if self._is_due(event.repetition, self._repetitions):
                    number = f"repetition {event.repetition + 1} of {self._repetitions}"
                    self._print(f"{number}: probability {event.estimate.probability:.3g}")
            case _:
                pass

    def _is_due(self, place: int, count: int) -> bool:
        """Whether a quarter more is done, or nothing was told for long."""
        quarter = (place + 1) * QUARTERS // count > place * QUARTERS // count
        return quarter or self._is_silent()

    def _is_silent(self) -> bool:
        return time.monotonic() - self._reported_s > SILENT_S

    def _print(self, text: str) -> None:
        self._reported_s = time.monotonic()
        self._console.print(text, highlight=False, markup=False)


class NoProgress:
    """Observer that shows nothing."""

    def notify(self, event: Event) -> None:
        """Take no note of ``event``."""


def stage_line(stage: StageSummary, *, repetitions: int) -> str:
    """A stage in a few words."""
    parts = [f"stage {stage.stage}"]
    if repetitions > 1:
        parts.insert(0, f"repetition {stage.repetition + 1} of {repetitions}")
    if stage.kind != "learn":
        parts.append({"pretrain": "pre-training", "final": "final"}[stage.kind])
    if stage.threshold is not None:
        parts.append(f"threshold {stage.threshold:.3g}")
    parts.append(f"{stage.failures} of {stage.rollouts} violate")
    return ", ".join(parts)


@contextlib.contextmanager
def progress_observer(*, quiet: bool = False) -> Generator[Observer, None, None]:
    """The observer that suits standard error."""
    console = Console(stderr=True)
    if quiet and not drawn_on_terminal(console):
        yield NoProgress()
    elif not drawn_on_terminal(console):
        yield ProgressLines(console)
    else:
        with bar(console, TextColumn("{task.fields[counted]},")) as progress:
            yield ProgressBar(progress)
