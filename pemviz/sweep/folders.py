"""A sweep's run folders: written whole, read with suspicion."""

import contextlib
import json
import shutil
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from pemviz.config.toml_files import config_table, config_text
from pemviz.errors import ConfigError, RunError
from pemviz.files.atomic import write_bytes
from pemviz.files.locks import held
from pemviz.sweep.plan import PlannedRun
from pemviz.sweep.runs import RESULT_FILES, File, Keep

RUNS = "runs"
LOCK = ".sweep.lock"
PARTIAL, REPLACED = ".partial", ".replaced"
ALL_FILES = (*RESULT_FILES, "rollouts.npz", "run.rrd")
MAXIMUM_RESULT_BYTES = 100_000_000

Figure = float | int | None


@dataclass(frozen=True)
class RunFigures:
    """The figures of a finished run that the table has; ``None`` where undefined."""

    probability: float
    log10_probability: float | None
    std_error: float | None
    ci_low: float | None
    ci_high: float | None
    failures: int
    ess: float | None
    pareto_k: float | None
    max_weight_share: float | None
    rollouts_simulated: int


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


def read_finished(runs: Path, planned: PlannedRun, *, keep: Keep) -> RunFigures | None:
    """The figures of a run that is done, as configured, with that error model; else ``None``.

    Whatever is damaged counts as not done.
    """
    folder = runs / planned.name
    if keep == "all" and not all((folder / name).is_file() for name in ALL_FILES):
        return None
    document = _document(folder / "result.json")
    if document is None or document.get("status") != "done":
        return None
    if not _same_text(folder / "config.toml", config_text(planned.config)):
        return None
    # asked for as JSON has it, where there are no tuples
    wanted = json.loads(json.dumps(config_table(planned.config)))
    pem = document.get("pem")
    if document.get("config") != wanted or not isinstance(pem, dict):
        return None
    if cast(dict[str, Any], pem).get("digest") != planned.pem_digest:
        return None
    return figures_of(document.get("estimate"))


def figures_of(estimate: object) -> RunFigures | None:
    """A result's estimate as figures; ``None`` if one is missing or no number."""
    if not isinstance(estimate, dict):
        return None
    table = cast(dict[str, Any], estimate)
    names = list(RunFigures.__dataclass_fields__)
    if not all(name in table for name in names):
        return None
    values: dict[str, Any] = {name: table[name] for name in names}
    for name, value in values.items():
        whole = name in ("failures", "rollouts_simulated")
        needed = whole or name == "probability"
        if value is None and not needed:
            continue
        if isinstance(value, bool) or not isinstance(value, int if whole else int | float):
            return None
        values[name] = value if whole else float(value)
    return RunFigures(**values)


def _document(path: Path) -> dict[str, Any] | None:
    try:
        if path.stat().st_size > MAXIMUM_RESULT_BYTES:
            return None
        document: object = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return cast(dict[str, Any], document) if isinstance(document, dict) else None


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
