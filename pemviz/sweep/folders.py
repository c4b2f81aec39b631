"""A sweep's run folders: written whole, read with suspicion."""

import contextlib
import logging
import shutil
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path

from pemviz.config.toml_files import config_text
from pemviz.errors import ConfigError, InputError, RunError
from pemviz.files.atomic import held, write_bytes
from pemviz.runs.reading import read_result
from pemviz.runs.result_file import has_result
from pemviz.runs.same_run import run_differs
from pemviz.runs.trust import run_diagnostics
from pemviz.sweep.plan import PlannedRun
from pemviz.sweep.runs import RESULT_FILES, File, Keep
from pemviz.types import Estimate

LOG = logging.getLogger(__name__)
RUNS = "runs"
LOCK = ".sweep.lock"
PARTIAL, REPLACED = ".partial", ".replaced"
ALL_FILES = (*RESULT_FILES, "rollouts.npz", "run.rrd")


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
        _remove_leftovers(runs)
        yield runs


def write_folder(runs: Path, name: str, files: Sequence[File]) -> None:
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
    if not _same_text(folder / "config.toml", config_text(planned.config)):
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


def _same_text(path: Path, text: str) -> bool:
    try:
        return path.read_bytes() == text.encode()
    except OSError:
        return False


def _remove_leftovers(runs: Path) -> None:
    """What a sweep that was killed was in the middle of writing; none is at work now."""
    for path in runs.iterdir():
        if path.name.startswith(".") and path.name.endswith((PARTIAL, REPLACED)):
            shutil.rmtree(path, ignore_errors=True)
