"""How far a run is, and how long it takes still: what terminal and panel show of it.

Time is told by what a rollout has taken so far, and the last fit, times how many there will be. A
method that goes on until its answer is precise says after each stage what it has decided to sample
still, and whether what it learns may ask for more.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Self

from pemviz.runs.events import (
    Event,
    RepetitionDone,
    RolloutsDone,
    RolloutsSearched,
    RunStarted,
    StageDone,
)
from pemviz.sampling.registry import by_name
from pemviz.sampling.rollouts.repeat import SHARE as AGAIN

SOME = 10
"""Rollouts that tell what one takes."""
MINUTES_FROM_S, HOURS_FROM_S = 90.0, 5400.0


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a run is; stage and repetition are zero-based, times are of one clock [s].

    Attributes:
        began_s: When it began.
        now_s: When the last event came.
        repetitions: How many there will be.
        stages: Of a repetition, as it begins.
        repetition: Under way.
        stage: Under way.
        before: Rollouts of the stages that are done.
        before_repetition: Of earlier repetitions.
        current: Rollouts that are done of the stage under way.
        planned: Rollouts in all; 0: not known yet.
        share: Done share of the run, 0 to 1; it never shrinks, though more may be planned.
        may_grow: Whether what is learned may ask for more than is planned.
        by_level: Whether rollouts done and planned tell how far splitting's levels have come.
        goes_on: Whether the method goes on until its answer is precise.
        most_s: A run may take that long.
        searches: Rollouts that may come beside the planned ones, as of the last stage's end.
        searched: Rollouts beside them since then.
        learning_stages: That are still to come.
        sampling_since_s: From when on rollouts of the stage under way were sampled.
        sampled: Rollouts that were sampled here, no interrupted run's, in stages that are done.
        sampled_s: What these took.
        current_s: What those of the stage under way took.
        fit_s: What the last fit took.
        workers: Who simulates, in words; empty: this process.
    """

    began_s: float
    now_s: float
    repetitions: int = 1
    stages: int = 1
    repetition: int = 0
    stage: int = 0
    before: int = 0
    before_repetition: int = 0
    current: int = 0
    planned: int = 0
    share: float = 0.0
    may_grow: bool = False
    by_level: bool = False
    goes_on: bool = False
    most_s: float = math.inf
    searches: int = 0
    searched: int = 0
    learning_stages: int = 0
    sampling_since_s: float = 0.0
    sampled: int = 0
    sampled_s: float = 0.0
    current_s: float = 0.0
    fit_s: float = 0.0
    workers: str = ""

    @property
    def done(self) -> int:
        """Rollouts so far."""
        return self.before + self.current

    @property
    def elapsed_s(self) -> float:
        """Since the run began."""
        return self.now_s - self.began_s

    @property
    def left_s(self) -> float | None:
        """Time left; ``None`` while it cannot be told."""
        if self.by_level:
            return self.elapsed_s * (1.0 - self.share) / self.share if self.share else None
        took_s, sampled = self.sampled_s, self.sampled
        if self.current_s:
            took_s, sampled = took_s + self.current_s, sampled + self.current
        if sampled < SOME or not self.planned:
            return None
        beside = max(self.searches - self.searched, 0) + AGAIN * self.planned
        rollouts = max(self.planned - self.done, 0) + beside
        left_s = took_s / sampled * rollouts + self.fit_s * self.learning_stages
        return min(left_s, max(self.most_s - self.elapsed_s, 0.0))

    def after(self, event: Event, *, now_s: float) -> Self:
        """As ``event`` leaves it, which came at ``now_s``."""
        match event:
            case RunStarted():
                at = self._started(event, now_s)
            case RolloutsDone(again=False):
                at = self._sampling(event, now_s)
            case RolloutsSearched():
                at = replace(
                    self,
                    repetition=event.repetition,
                    stage=event.stage,
                    searched=self.searched + event.count,
                    sampling_since_s=now_s,
                )
            case StageDone():
                at = self._stage_done(event, now_s)
            case RepetitionDone():
                at = replace(self, before_repetition=self.before)
            case _:
                at = self
        share = min(at.done / at.planned, 1.0) if at.planned else 0.0
        return replace(at, now_s=now_s, share=max(self.share, share))

    def _started(self, event: RunStarted, now_s: float) -> Self:
        method, minutes = by_name(event.config.method), event.config.max_minutes
        goes_on = method.most is not None
        return replace(
            self,
            repetitions=event.config.repetitions,
            stages=event.stages,
            planned=0 if goes_on else event.planned_rollouts,
            by_level=method.counting == "level",
            goes_on=goes_on,
            most_s=math.inf if minutes is None else 60.0 * minutes,
            sampling_since_s=now_s,
        )

    def _sampling(self, event: RolloutsDone, now_s: float) -> Self:
        at = replace(self, repetition=event.repetition, stage=event.stage, current=event.done)
        if event.done == 0:  # learned on a surrogate
            return replace(at, sampling_since_s=now_s)
        # an interrupted run's stage is done at once
        is_left = event.done == event.total and not self.current_s
        return replace(at, current_s=0.0 if is_left else now_s - self.sampling_since_s)

    def _stage_done(self, event: StageDone, now_s: float) -> Self:
        stage, foreseen = event.stage, event.foreseen
        before, others = self.before + stage.count, self.repetitions - stage.repetition - 1
        learning = max(self.stages - stage.stage - 2, 0) + others * (self.stages - 1)
        planned, searches, may_grow = self.planned, 0, False
        if foreseen is not None:
            own = before - self.before_repetition + foreseen.rollouts
            planned = before + foreseen.rollouts + others * own
            learning = foreseen.learning_stages + others * (stage.stage + foreseen.learning_stages)
            searches, may_grow = foreseen.searches, foreseen.may_grow
        elif self.goes_on:
            planned = 0
        took = stage.timings_s
        sampled_s = took.get("simulation", 0.0) + took.get("robustness", 0.0)
        return replace(
            self,
            stage=stage.stage + 1,
            before=before,
            current=0,
            planned=planned,
            searches=searches,
            searched=0,
            may_grow=may_grow,
            learning_stages=learning,
            sampling_since_s=now_s,
            sampled=self.sampled + (stage.count if sampled_s else 0),
            sampled_s=self.sampled_s + sampled_s,
            current_s=0.0,
            fit_s=took.get("fit", self.fit_s),
        )


def progress_now(*, workers: str = "") -> Progress:
    """That of a run that begins now, by ``workers``."""
    now_s = time.monotonic()
    return Progress(began_s=now_s, now_s=now_s, workers=workers)


def counted_in_words(progress: Progress) -> str:
    """How far a run is, by its rollouts, or by the levels passed."""
    if progress.by_level:
        return f"{progress.share:.0%} of the way to violations"
    if not progress.planned:
        return f"{progress.done:,} rollouts"
    return f"{progress.done:,} of {progress.planned:,} rollouts"


def searched_in_words(progress: Progress) -> str:
    """What a search beside the stage under way has simulated."""
    return f"stage {progress.stage}, searching: {progress.searched:,} rollouts"


def left_in_words(progress: Progress, *, now_s: float | None = None) -> str:
    """The time left at ``now_s``, or when the last event came; empty where it cannot be told."""
    left_s = progress.left_s
    if left_s is None:
        return ""
    left_s -= 0.0 if now_s is None else now_s - progress.now_s
    left = f"{max(1, round(left_s))} s"
    if left_s >= MINUTES_FROM_S:
        left = f"{round(left_s / 60)} min" if left_s < HOURS_FROM_S else f"{left_s / 3600:.1f} h"
    return f"about {left} left{', or more' if progress.may_grow else ''}"
