"""One run, carried out wherever a worker is: settings and models in, a run folder's files out."""

import os
import sys
import tempfile
import threading
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from threadpoolctl import threadpool_limits

from pemviz._version import __version__
from pemviz.config import ExperimentConfig
from pemviz.config.toml_files import config_from_table, config_text
from pemviz.errors import InputError, RunError
from pemviz.files.atomic import write_bytes
from pemviz.pem.model_files import (
    ENSEMBLE_ENDING,
    SUFFIX,
    is_python,
    shipped_pems,
    shipped_position_errors,
)
from pemviz.processes import ONE_THREAD
from pemviz.runs.events import Observer
from pemviz.runs.experiment import build_experiment
from pemviz.runs.run_folder import record
from pemviz.sweep.plan import PlannedRun

Keep = Literal["results", "all"]
File = tuple[str, bytes]
Files = tuple[File, ...]
NamedModels = tuple[str, str | None]
"""What a configuration calls its error model and its position errors."""

RESULT_FILES = ("config.toml", "result.json")
SCRATCH_PREFIX = "pemviz-run-"
ONE_RUN_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class ModelFiles:
    """Names and contents, for workers that do not see this disk; none of a shipped model.

    ``allow_python``: The error model may be ``module:attribute``, whose module a worker must have.
    """

    pem: Files = ()
    position_errors: Files = ()
    allow_python: bool = False


@dataclass(frozen=True)
class RunTask:
    """Everything that a worker on another machine needs to carry a run out.

    Attributes:
        keep: Which files come back: configuration and result, or all.
        version: Of pemviz; another one might give other results.
    """

    name: str
    config_toml: str
    model: ModelFiles
    keep: Keep
    version: str = __version__


@dataclass(frozen=True)
class RunOutcome:
    """What became of a run: files of its folder as far as it came, and why it failed, if it did."""

    name: str
    message: str | None = None
    files: Files = ()


def models_of(config: ExperimentConfig) -> NamedModels:
    """The models that a configuration names."""
    return config.pem, config.position_errors


def model_files(models: NamedModels, *, allow_python: bool = False) -> ModelFiles:
    """The files that a configuration names: the models, and the error model's ensemble beside it.

    With ``allow_python`` an error model of the user's own code has none.

    Raises:
        InputError: They cannot be read.
    """
    pem, errors = models
    sent = ModelFiles(allow_python=allow_python)
    if pem not in shipped_pems() and not is_python(pem):
        path = Path(pem)
        stem = path.stem.removesuffix(ENSEMBLE_ENDING)
        partner = path.with_name(f"{stem}{ENSEMBLE_ENDING}{SUFFIX}")
        beside = [partner] if partner != path and path.suffix == SUFFIX else []
        present = [path, *(one for one in beside if one.is_file())]
        sent = replace(sent, pem=_read(present, f"pem = {pem!r}"))
    if errors is not None and errors not in shipped_position_errors():
        read = _read([Path(errors)], f"position_errors = {errors!r}")
        sent = replace(sent, position_errors=read)
    return sent


def _read(paths: Sequence[Path], setting: str) -> Files:
    try:
        return tuple((path.name, path.read_bytes()) for path in paths)
    except OSError as error:
        message = f"{setting}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error


def task_of(planned: PlannedRun, *, model: ModelFiles, keep: Keep) -> RunTask:
    """The run as it is handed to a worker."""
    return RunTask(planned.name, config_text(planned.config), model=model, keep=keep)


def carry_out(task: RunTask, *, scratch: Path | None = None) -> RunOutcome:
    """Carry a run out in a temporary folder; whatever goes wrong is told in the outcome."""
    try:
        # limits on threads are those of a process
        with (
            ONE_RUN_AT_A_TIME,
            tempfile.TemporaryDirectory(prefix=SCRATCH_PREFIX, dir=scratch) as temporary,
        ):
            return _carry_out(task, Path(temporary))
    except BaseException as error:  # signals are not for workers: it is the run's own
        return RunOutcome(task.name, message=one_line(error))


def one_line(error: BaseException) -> str:
    """An error in one line; ours speak for themselves, others are named."""
    text = " ".join(str(error).split())
    kind = type(error).__name__
    if type(error).__module__.startswith("pemviz."):
        return text or kind
    return f"{kind}: {text}" if text else kind


def _carry_out(task: RunTask, temporary: Path) -> RunOutcome:
    if task.version != __version__:
        message = f"the worker has pemviz {__version__}, but {task.version} is asking"
        raise RunError(message)
    folder = temporary / task.name
    folder.mkdir()
    named = config = config_from_table(tomllib.loads(task.config_toml))
    if task.model.pem:
        named = replace(named, pem=_written(task.model.pem, temporary / "model"))
    if task.model.position_errors:
        path = _written(task.model.position_errors, temporary / "position-errors")
        named = replace(named, position_errors=path)
    experiment = build_experiment(named, allow_python=task.model.allow_python)
    experiment = replace(experiment, config=config)
    _use_one_thread()
    recorders: list[Observer] = []
    if task.keep == "all":
        from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

        recorders.append(Recorder(folder / "run.rrd"))
    message = None
    try:
        record(experiment, folder, recorders=recorders)
    except RunError as error:
        message = one_line(error)
    files = tuple(
        (path.name, path.read_bytes())
        for path in sorted(folder.iterdir())
        if path.is_file()
        and (task.keep == "all" or path.name in RESULT_FILES)
        and not path.name.startswith(".")
    )
    return RunOutcome(task.name, message=message, files=files)


def _written(files: Files, place: Path) -> str:
    """Write files into a folder made for them, and return the first one's path."""
    place.mkdir()
    for name, content in files:
        write_bytes(place / Path(name).name, content)
    return str(place / Path(files[0][0]).name)


def _use_one_thread() -> None:
    """For this process, for good: the last digit depends on the number of threads."""
    os.environ.update(ONE_THREAD)  # for torch, if a run imports it; not all do, and it takes long
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    threadpool_limits(limits=1)
