"""Progress on standard error: a bar on a terminal, a few lines elsewhere."""

import contextlib
import time
from collections.abc import Generator

from rich.console import Console
from rich.progress import Progress as Bars
from rich.progress import ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

from pemviz.bars import bar, drawn_on_terminal
from pemviz.runs.events import (
    Event,
    Observer,
    RepetitionDone,
    RolloutsDone,
    RolloutsSearched,
    RunStarted,
    StageDone,
)
from pemviz.runs.forecast import (
    Progress,
    counted_in_words,
    left_in_words,
    progress_now,
    searched_in_words,
)
from pemviz.runs.ranking import summarise_stage
from pemviz.runs.result import StageSummary

QUARTERS = 4
BAR_WIDTH = 12
SILENT_S = 30.0
STARTING, REPEATED = "starting", "simulated again"


class ProgressBar:
    """Observer that shows stage, threshold, failures and time left."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._task: TaskID | None = None
        self._stage = STARTING
        self._progress = progress_now()

    def notify(self, event: Event) -> None:
        """Move the bar."""
        self._progress = self._progress.after(event, now_s=time.monotonic())
        match event:
            case RunStarted():
                self._task = self._bars.add_task(self._stage, total=1.0, progress=self._progress)
            case RolloutsDone(again=True):
                self._move(description=f"{REPEATED}: {event.done} of {event.total}")
            case RolloutsDone():
                self._move(description=self._stage)
            case RolloutsSearched():
                self._move(description=searched_in_words(self._progress))
            case StageDone():
                stage = summarise_stage(event.stage)
                self._stage = stage_line(stage, repetitions=self._progress.repetitions)
                self._move(description=self._stage)
            case _:
                pass

    def _move(self, *, description: str | None = None) -> None:
        if self._task is not None:
            self._bars.update(
                self._task,
                completed=self._progress.share,
                progress=self._progress,
                description=description,
            )


class _Words(ProgressColumn):
    """How far a run is in words, and how long it takes still by the clock."""

    def render(self, task: Task) -> Text:
        """Of the run's one task."""
        progress: Progress = task.fields["progress"]
        left = left_in_words(progress, now_s=time.monotonic())
        return Text(", ".join(filter(None, (counted_in_words(progress), left))))


class ProgressLines:
    """Observer that prints a line where a quarter of the stages is done, or of the repetitions.

    What takes long is told of more often: once in :data:`SILENT_S`, if a batch of rollouts ends;
    and how long it takes still, where that is so long.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = progress_now()
        self._reported_s = time.monotonic()

    def notify(self, event: Event) -> None:
        """Print what is done."""
        self._progress = self._progress.after(event, now_s=time.monotonic())
        repetitions = self._progress.repetitions
        match event:
            case RolloutsDone() if event.done < event.total and self._is_silent():
                of = f", repetition {event.repetition + 1}" if repetitions > 1 else ""
                at = REPEATED if event.again else f"stage {event.stage}"
                self._print(f"{at}{of}: {event.done} of {event.total} rollouts")
            case RolloutsSearched() if self._is_silent():
                self._print(searched_in_words(self._progress))
            case StageDone() if repetitions == 1:
                if self._is_due(event.stage.stage, self._progress.stages):
                    self._print(stage_line(summarise_stage(event.stage), repetitions=1))
            case RepetitionDone() if repetitions > 1:
                if self._is_due(event.repetition, repetitions):
                    number = f"repetition {event.repetition + 1} of {repetitions}"
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
        left_s = self._progress.left_s
        if left_s is not None and left_s >= SILENT_S:
            text = f"{text}; {left_in_words(self._progress)}"
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
        with bar(console, _Words(Column(no_wrap=True)), width=BAR_WIDTH) as bars:
            yield ProgressBar(bars)
