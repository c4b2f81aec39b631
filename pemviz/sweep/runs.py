"""One run, carried out wherever a worker is: settings and files in, a run folder's files out."""

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
from pemviz.config.toml_files import config_from_table, config_text
from pemviz.errors import RunError
from pemviz.processes import ONE_THREAD
from pemviz.runs.events import Observer
from pemviz.runs.experiment import Experiment, build_experiment
from pemviz.runs.resume import carry_out as carry_out_kept
from pemviz.sweep.model_files import ModelFiles
from pemviz.sweep.plan import PlannedRun

Keep = Literal["results", "all"]
File = tuple[str, bytes]

RESULT_FILES = ("config.toml", "result.json")
SCRATCH_PREFIX = "pemviz-run-"
ONE_RUN_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class RunTask:
    """Everything that a worker on another machine needs to carry a run out.

    Attributes:
        name: The run's.
        config_toml: Its configuration.
        model: Files of the error model and the position errors, where they are no shipped ones.
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
    """What became of a run.

    Attributes:
        name: The run's.
        message: Why it failed; ``None`` if it is done.
        files: Of its folder, as far as it came.
    """

    name: str
    message: str | None = None
    files: tuple[File, ...] = ()


def task_of(planned: PlannedRun, *, model: ModelFiles, keep: Keep) -> RunTask:
    """The run as it is handed to a worker."""
    return RunTask(
        name=planned.name, config_toml=config_text(planned.config), model=model, keep=keep
    )


def carry_out(task: RunTask, *, scratch: Path | None = None) -> RunOutcome:
    """Carry a run out in a temporary folder; whatever goes wrong is told in the outcome.

    Args:
        task: The run.
        scratch: Where the temporary folder is made; without it, where the system has them.
    """
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
    experiment = _experiment(task, temporary)
    _use_one_thread()
    message = None
    try:
        carry_out_kept(experiment, folder, recorders=_recorders(task, folder))
    except RunError as error:
        message = one_line(error)
    return RunOutcome(task.name, message=message, files=tuple(_files(folder, task.keep)))


def _experiment(task: RunTask, temporary: Path) -> Experiment:
    """The experiment as configured, with its models read from where their files lie here."""
    config = config_from_table(tomllib.loads(task.config_toml))
    return replace(build_experiment(task.model.put_into(temporary, config)), config=config)


def _recorders(task: RunTask, folder: Path) -> list[Observer]:
    if task.keep != "all":
        return []
    from pemviz.recording import Recorder  # noqa: PLC0415  rerun is slow to import

    return [Recorder(folder / "run.rrd")]


def _use_one_thread() -> None:
    """For this process, for good: the last digit depends on the number of threads."""
    os.environ.update(ONE_THREAD)  # for torch, if a run imports it; not all do, and it takes long
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
    threadpool_limits(limits=1)


def _files(folder: Path, keep: Keep) -> Sequence[File]:
    paths = sorted(path for path in folder.iterdir() if path.is_file())
    wanted = [path for path in paths if keep == "all" or path.name in RESULT_FILES]
    return [(path.name, path.read_bytes()) for path in wanted if not path.name.startswith(".")]
