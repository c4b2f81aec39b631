"""A run that is kept in a folder, and that goes on from what an earlier process left there."""

import json
import logging
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from pemviz.config.toml_files import config_table
from pemviz.errors import InputError
from pemviz.files.locks import held
from pemviz.runs.engine import run, versions
from pemviz.runs.events import Observer
from pemviz.runs.experiment import Experiment
from pemviz.runs.finished_stages import Archive
from pemviz.runs.result import RunResult
from pemviz.runs.result_documents import read_document
from pemviz.runs.store import RunStore

LOG = logging.getLogger(__name__)
LOCK = ".lock"


def carry_out(
    experiment: Experiment,
    folder: Path,
    *,
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
        observers: Told of everything that happens, after the folder has it.
        should_stop: Asked between batches of rollouts.

    Raises:
        InputError: Another process is at work in the folder, or the folder was begun with
            another error model.
        RunError: The run failed.
    """
    with run_lock(folder):
        check_same_run(experiment, folder)
        archive = Archive(folder, experiment.problem.simulator.signals)
        problem = replace(experiment.problem, finished=archive)
        return run(
            replace(experiment, problem=problem),
            run_id=folder.name,
            observers=[RunStore(folder, archive=archive), *observers],
            should_stop=should_stop,
        )


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


def read_result(folder: Path) -> dict[str, Any] | None:
    """The contents of a run folder's ``result.json``; ``None`` if there is none.

    Raises:
        InputError: It is damaged.
    """
    path = folder / "result.json"
    return read_document(path) if path.exists() else None


def check_same_run(experiment: Experiment, folder: Path) -> None:
    """Refuse to go on with other settings or another error model; warn of other versions.

    Raises:
        InputError: They differ, or ``result.json`` is damaged.
    """
    document = read_result(folder)
    if document is None:
        return
    settings = json.loads(json.dumps(config_table(experiment.config)))
    if document.get("config") != settings:
        message = (
            f"run {folder}: was begun with settings other than those of its config.toml; "
            "start a new run"
        )
        raise InputError(message)
    pem = document.get("pem")
    digest = cast(dict[str, Any], pem).get("digest") if isinstance(pem, dict) else None
    if digest != experiment.pem.digest:
        message = (
            f"run {folder}: was begun with another error model of the name "
            f"{experiment.config.pem!r} (digest {str(digest)[:12]}, now "
            f"{experiment.pem.digest[:12]}); start a new run"
        )
        raise InputError(message)
    if document.get("versions") != versions():
        LOG.warning("run %s: was begun with other versions; last digits may differ", folder)
