"""A run that is kept in a folder, and that goes on from what an earlier process left there."""

import logging
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pemviz.errors import InputError
from pemviz.files.atomic import held
from pemviz.runs.engine import run, versions
from pemviz.runs.events import Event, Observer, RunDone, notify_all
from pemviz.runs.experiment import Experiment
from pemviz.runs.finished_stages import Archive
from pemviz.runs.reading import result_left
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import has_result
from pemviz.runs.same_run import run_differs
from pemviz.runs.store import RunStore
from pemviz.sampling.problem import FinishedStage, Problem, rule_scores

LOG = logging.getLogger(__name__)
LOCK, RECORDING = ".lock", "run.rrd"


@dataclass(frozen=True)
class _DoneLast:
    """Tells the folder first, but that the run is done last: a kill may come in between."""

    store: Observer
    recorders: Sequence[Observer]

    def notify(self, event: Event) -> None:
        done = isinstance(event, RunDone) and event.result.status == "done"
        notify_all([*self.recorders, self.store] if done else [self.store, *self.recorders], event)


def carry_out(
    experiment: Experiment,
    folder: Path,
    *,
    recorders: Sequence[Observer] = (),
    observers: Sequence[Observer] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Run an experiment and keep it in ``folder``.

    Stages that an earlier process finished there are read back, not computed again; the end
    is the same, to the last bit but for timings.

    Args:
        experiment: What to run; for a folder with stages in it, the experiment of its
            ``config.toml``.
        folder: The run folder; it exists already, and its name is the run's.
        recorders: Write further files of the run; told of everything after the folder has it, but
            for the end: a folder says that a run is done once they are whole.
        observers: Told of everything that happens, after the folder has it.
        should_stop: Asked between batches of rollouts.

    Raises:
        InputError: Another process is at work in the folder, or the folder was begun with
            another error model.
        RunError: The run failed.
    """
    with run_lock(folder):
        check_resumable(experiment, folder)
        archive = Archive(folder, experiment.declared.signals)
        folding = experiment.folding
        finished = archive if folding is None else folding.finished(archive)
        judged = partial(_judged, finished, experiment.problem)
        problem = replace(experiment.problem, finished=judged)
        store = RunStore(folder, archive=archive, others=(RECORDING,))
        return run(
            replace(experiment, problem=problem),
            run_id=folder.name,
            observers=[_DoneLast(store, recorders), *observers],
            should_stop=should_stop,
        )


def _judged(
    read: Callable[[int, int], FinishedStage | None],
    problem: Problem,
    repetition: int,
    stage: int,
) -> FinishedStage | None:
    """A finished stage with each rule's verdict, which follows from its rollouts."""
    found = read(repetition, stage)
    if found is None or not problem.rules:
        return found
    by_rule = rule_scores(problem.rules, found.scored.rollouts)
    return replace(found, scored=replace(found.scored, **by_rule))


@contextmanager
def run_lock(folder: Path) -> Generator[None, None, None]:
    """Hold the run folder; a process that dies gives it back.

    Raises:
        InputError: Another process holds it, or there is no such folder to write to.
    """
    with held(
        folder / LOCK,
        busy=f"run {folder}: another process is at work in it",
        unusable=f"run {folder}: cannot be written to",
    ):
        yield


def check_resumable(experiment: Experiment, folder: Path) -> None:
    """Refuse to go on with other settings or another error model; warn of other versions.

    A ``result.json`` that is no JSON document, beside finished stages, is warned of: with it goes
    what tells of the error model.

    Raises:
        InputError: They differ, or ``result.json`` is damaged otherwise.
    """
    result = result_left(folder)
    if result is None:
        if has_result(folder):
            LOG.warning(
                "run %s: result.json cannot be read; the run goes on from its stages, "
                "with the error model as it is now",
                folder,
            )
        return
    errors = experiment.back_end.position_errors
    difference = run_differs(
        result,
        config=experiment.config,
        pem_digest=experiment.pem.digest,
        position_digest=None if errors is None else errors.digest,
    )
    if difference is not None:
        message = f"run {folder}: was begun with {difference}; start a new run"
        raise InputError(message)
    if result.versions != versions():
        LOG.warning("run %s: was begun with other versions; last digits may differ", folder)
