"""Reading a run folder: the one way in, by which nothing is believed that the rest contradicts."""

import math
from collections.abc import Iterator
from pathlib import Path

from pemviz.config.toml_files import load_config
from pemviz.errors import InputError
from pemviz.files.atomic import file_digest
from pemviz.runs.coherence import complaints
from pemviz.runs.recount import ROLLOUTS, recount
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import (
    CHANGED,
    RESULT_FILE,
    SHOWN,
    KeptResult,
    UnreadableResultError,
    has_result,
    read_kept,
)
from pemviz.runs.rollout_files import stage_files
from pemviz.runs.same_run import run_differs

CONFIG = "config.toml"


def read_result(folder: Path, *, most_bytes: float = math.inf) -> RunResult:
    """The result that a run folder holds, held to itself and to the folder's other files.

    Figures must agree with each other, settings with ``config.toml``, estimates with those formed
    again from ``rollouts.npz``, files with their digests. A file that is not there any more is
    not missed.

    Args:
        folder: The run folder.
        most_bytes: Larger files are believed: :func:`read_result` without it looks at them too.

    Raises:
        UnreadableResultError: ``result.json`` is no JSON document.
        InputError: Something is damaged, or does not agree; one line names it.
    """
    kept = read_kept(folder)
    wrong = next(_disagreements(kept, folder, most_bytes), None)
    if wrong is not None:
        message = f"result {folder / RESULT_FILE}: {wrong}"
        raise InputError(message)
    return kept.result


def read_whole_run(folder: Path, *, most_bytes: float = math.inf) -> RunResult:
    """As :func:`read_result`, of a run folder that has its ``config.toml``.

    Raises:
        InputError: As there, or that file is absent.
    """
    result = read_result(folder, most_bytes=most_bytes)
    load_config(folder / CONFIG)
    return result


def result_left(folder: Path) -> RunResult | None:
    """What ``result.json`` says of a run that is to go on.

    ``None`` where there is none, or where a power cut left no JSON document: then finished stages
    beside it are enough to go on from.

    Raises:
        InputError: It is damaged, and there are no stages or it is a document all the same.
    """
    if not has_result(folder):
        return None
    try:
        return read_result(folder)
    except UnreadableResultError:
        if stage_files(folder):
            return None
        raise


def _disagreements(kept: KeptResult, folder: Path, most_bytes: float) -> Iterator[str]:
    """What does not agree; fields first, as digests do not tell which it is."""
    yield from complaints(kept.result)
    if _is_looked_at(folder / CONFIG, most_bytes):
        difference = run_differs(kept.result, config=load_config(folder / CONFIG))
        if difference is not None:
            yield f"run {folder.name} was begun with {difference}"
    if _is_looked_at(folder / ROLLOUTS, most_bytes):
        yield from recount(folder, kept.result)
    for name, told in kept.files.items():
        if _is_looked_at(folder / name, most_bytes):
            found = file_digest(folder / name)
            if found != told:
                digests = f"{told[:SHOWN]!r}...: {name} has {found[:SHOWN]!r}..."
                yield f"files.{name} = {digests}; {CHANGED}"
    if kept.fault is not None:
        yield kept.fault


def _is_looked_at(path: Path, most_bytes: float) -> bool:
    return path.is_file() and path.stat().st_size <= most_bytes
