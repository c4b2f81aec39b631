"""Carries a sweep's runs out: hands them to workers, keeps what comes back, retries once."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pemviz.sweep.folders import read_finished, write_folder
from pemviz.sweep.model_files import ModelFiles, NamedModels, models_of
from pemviz.sweep.plan import PlannedRun
from pemviz.sweep.runs import Keep, RunOutcome, task_of
from pemviz.sweep.workers import Workers
from pemviz.types import Estimate

POLL_S = 0.2
ATTEMPTS = 2
OTHER_RESULT = "its result is not what was asked for: another model, or a damaged file"

RunStatus = Literal["done", "failed", "not run"]


@dataclass(frozen=True)
class RunState:
    """How a run stands.

    Attributes:
        planned: The run.
        status: Whether it is done.
        estimate: What it found, if it is done; a sweep may have more runs than there is room
            for results.
        message: Why it failed, if it did.
    """

    planned: PlannedRun
    status: RunStatus
    estimate: Estimate | None = None
    message: str | None = None


@dataclass(frozen=True)
class RunReport:
    """What just became of a run, for progress displays.

    Attributes:
        state: How the run stands; after a first failure it is ``not run``.
        again: Whether it failed and will be tried once more.
    """

    state: RunState
    again: bool = False


OnReport = Callable[[RunReport], None]


def finished_before(runs: Path, planned: Sequence[PlannedRun], *, keep: Keep) -> list[RunState]:
    """How every run stands before anything is done."""
    estimates = [(one, read_finished(runs, one, keep=keep)) for one in planned]
    return [RunState(one, "not run" if e is None else "done", e) for one, e in estimates]


def carry_out_runs(
    runs: Path,
    planned: Sequence[PlannedRun],
    workers: Workers,
    *,
    models: Mapping[NamedModels, ModelFiles],
    keep: Keep,
    on_report: OnReport,
    on_end: Callable[[RunState], None],
    should_stop: Callable[[], bool],
) -> None:
    """Carry runs out and keep their folders; what fails is tried once more, at the end.

    Args:
        runs: Where the run folders are made.
        planned: The runs.
        workers: Who carries them out, ready for it.
        models: Files of models by the names that configurations have for them.
        keep: What is kept of a run.
        on_report: Told of every run that is done or failed, for progress displays.
        on_end: Told of every run that is done, or failed for good.
        should_stop: Asked several times a second; runs that are going on then are given up.

    Raises:
        RunError: A folder cannot be written, or the workers are gone.
    """
    waiting = deque(planned)
    by_name = {one.name: one for one in planned}
    failures: dict[str, int] = {}
    running = 0
    while (waiting or running) and not should_stop():
        capacity = workers.capacity
        while waiting and running < capacity:
            one = waiting.popleft()
            workers.submit(task_of(one, model=models[models_of(one.config)], keep=keep))
            running += 1
        for outcome in workers.finished(timeout_s=POLL_S):
            running -= 1
            state = _keep(runs, by_name[outcome.name], outcome, keep=keep)
            if state.status == "failed":
                failures[outcome.name] = failures.get(outcome.name, 0) + 1
            again = 0 < failures.get(outcome.name, 0) < ATTEMPTS and state.status == "failed"
            if again:
                waiting.append(state.planned)
            else:
                on_end(state)
            on_report(RunReport(state, again=again))


def _keep(runs: Path, planned: PlannedRun, outcome: RunOutcome, *, keep: Keep) -> RunState:
    if outcome.files:
        write_folder(runs, planned.name, outcome.files)
    if outcome.message is not None:
        return RunState(planned, "failed", message=outcome.message)
    estimate = read_finished(runs, planned, keep=keep)
    if estimate is None:
        return RunState(planned, "failed", message=OTHER_RESULT)
    return RunState(planned, "done", estimate)
