"""Carries a sweep's runs out: hands them to workers, keeps their folders, retries once."""

import contextlib
import logging
import shutil
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pemviz.config.toml_files import config_text
from pemviz.errors import ConfigError, InputError, RunError
from pemviz.files.atomic import held, write_bytes
from pemviz.runs.reading import read_result, run_differs
from pemviz.runs.result_file import has_result
from pemviz.runs.uncertainty import run_diagnostics
from pemviz.sweep import run_task
from pemviz.sweep.plan import PlannedRun
from pemviz.sweep.run_task import Keep, RunOutcome
from pemviz.sweep.workers import Workers
from pemviz.types import Estimate

LOG = logging.getLogger(__name__)
POLL_S = 0.2
ATTEMPTS = 2
OTHER_RESULT = "its result is not what was requested: another model, or a damaged file"
RUNS = "runs"
LOCK = ".sweep.lock"
PARTIAL, REPLACED = ".partial", ".replaced"
ALL_FILES = (*run_task.RESULT_FILES, "rollouts.npz", "run.rrd")

RunStatus = Literal["done", "failed", "not run"]


@dataclass(frozen=True)
class RunState:
    """How a run stands: what it found if it is done, why it failed if it did."""

    planned: PlannedRun
    status: RunStatus
    estimate: Estimate | None = None
    message: str | None = None


@dataclass(frozen=True)
class RunReport:
    """What just became of a run; whether it failed and will be tried ``again``."""

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
    models: Mapping[run_task.NamedModels, run_task.ModelFiles],
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
    failures = dict.fromkeys(by_name, 0)
    running = 0
    while (waiting or running) and not should_stop():
        capacity = workers.capacity
        while waiting and running < capacity:
            one = waiting.popleft()
            model = models[run_task.models_of(one.config)]
            workers.submit(run_task.task_of(one, model=model, keep=keep))
            running += 1
        for outcome in workers.finished(timeout_s=POLL_S):
            running -= 1
            state = _keep(runs, by_name[outcome.name], outcome, keep=keep)
            failures[outcome.name] += state.status == "failed"
            again = state.status == "failed" and failures[outcome.name] < ATTEMPTS
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


@contextlib.contextmanager
def sweep_folder(out: Path) -> Generator[Path, None, None]:
    """The sweep's folder, made if need be and held for this process alone; yields its runs'.

    Raises:
        InputError: It cannot be made, or another sweep is at work there.
    """
    runs = out / RUNS
    unusable = f"out = {out}: cannot be used"
    try:
        runs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"{unusable} ({error.strerror or error})"
        raise ConfigError(message) from error
    busy = f"out = {out}: another sweep is at work there"
    with held(out / LOCK, busy=busy, unusable=unusable):
        for path in runs.iterdir():  # what a sweep that was killed was in the middle of writing
            if path.name.startswith(".") and path.name.endswith((PARTIAL, REPLACED)):
                shutil.rmtree(path, ignore_errors=True)
        yield runs


def write_folder(runs: Path, name: str, files: Sequence[run_task.File]) -> None:
    """Put a run's folder in place, whole; one of that name is replaced.

    Raises:
        RunError: It cannot be written, or a file's name is none.
    """
    partial, target = runs / f".{name}{PARTIAL}", runs / name
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        for file_name, content in files:
            if not file_name or Path(file_name).name != file_name or file_name.startswith("."):
                message = f"run {name}: a worker sent a file named {file_name!r}"
                raise RunError(message)
            write_bytes(partial / file_name, content)
        replaced = runs / f".{name}{REPLACED}"
        shutil.rmtree(replaced, ignore_errors=True)
        if target.exists():
            target.replace(replaced)
        partial.replace(target)
        shutil.rmtree(replaced, ignore_errors=True)
    except OSError as error:
        shutil.rmtree(partial, ignore_errors=True)
        message = f"run {name}: its folder cannot be written ({error.strerror or error})"
        raise RunError(message) from error


def read_finished(runs: Path, planned: PlannedRun, *, keep: Keep) -> Estimate | None:
    """The answer of a run that is done, as configured, with that error model; else ``None``.

    Its diagnostics are those of the run: what the reference says is among them. Whatever is
    damaged or does not agree counts as not done, and is told of.
    """
    folder = runs / planned.name
    if keep == "all" and not all((folder / name).is_file() for name in ALL_FILES):
        return None
    try:
        config = (folder / "config.toml").read_bytes()
    except OSError:
        return None
    if config != config_text(planned.config).encode():
        return None
    try:
        result = read_result(folder)
    except InputError as error:
        if has_result(folder):
            LOG.warning("%s; the run counts as not done", error)
        return None
    difference = run_differs(
        result,
        config=planned.config,
        pem_digest=planned.pem_digest,
        position_digest=planned.position_digest,
    )
    if result.status != "done" or difference is not None or result.estimate is None:
        return None
    return replace(result.estimate, diagnostics=run_diagnostics(result))
