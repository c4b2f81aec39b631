"""Reading a run folder: the one way in, by which nothing is believed that the rest contradicts.

And whether its run is the one that is wanted: before a run goes on, before a sweep takes a run for
done, before the panel shows one.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from pemviz.config import WITHOUT_EFFECT, ExperimentConfig
from pemviz.config.toml_files import every_setting, load_config
from pemviz.errors import InputError
from pemviz.files.atomic import file_digest
from pemviz.runs.coherence import complaints, recount
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
from pemviz.runs.rollout_files import ROLLOUTS_FILE, stage_files

CONFIG = "config.toml"


def read_result(folder: Path | str, *, most_bytes: float = math.inf) -> RunResult:
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

    Example:
        >>> import pemviz
        >>> from pemviz.files.shipped import sample_run
        >>> result = pemviz.read_result(sample_run())
        >>> print(result.status, f"{result.estimate.probability:.1e}", result.estimate.failures)
        done 3.2e-17 80
    """
    folder = Path(folder)
    kept = read_kept(folder)
    wrong = next(_disagreements(kept, folder, most_bytes), None)
    if wrong is not None:
        raise InputError(f"result {folder / RESULT_FILE}: {wrong}")
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
    """What does not agree; fields first, as digests do not say which it is."""
    yield from complaints(kept.result)
    if _is_looked_at(folder / CONFIG, most_bytes):
        difference = run_differs(kept.result, config=load_config(folder / CONFIG))
        if difference is not None:
            yield f"run {folder.name} was begun with {difference}"
    if _is_looked_at(folder / ROLLOUTS_FILE, most_bytes):
        yield from recount(folder, kept.result)
    for name, written in kept.files.items():
        if _is_looked_at(folder / name, most_bytes):
            found = file_digest(folder / name)
            if found != written:
                digests = f"{written[:SHOWN]!r}...: {name} has {found[:SHOWN]!r}..."
                yield f"files.{name} = {digests}; {CHANGED}"
    if kept.fault is not None:
        yield kept.fault


def _is_looked_at(path: Path, most_bytes: float) -> bool:
    return path.is_file() and path.stat().st_size <= most_bytes


def run_differs(
    result: RunResult,
    *,
    config: ExperimentConfig,
    pem_digest: str | None = None,
    position_digest: str | None = None,
    free: Sequence[str] = WITHOUT_EFFECT,
) -> str | None:
    """How the run of a result differs from the one wanted, in words; ``None``: not at all.

    Args:
        result: What the folder holds.
        config: What is wanted.
        pem_digest: SHA-256 of the error model that is wanted; ``None``: any of its name.
        position_digest: The same of the position errors.
        free: Settings that may differ.
    """
    settings = setting_differences(result.config, config)
    decisive = {name: both for name, both in settings.items() if name not in free}
    if decisive:
        name, (begun, wanted) = next(iter(decisive.items()))
        return f"settings other than those of its config.toml ({name} = {begun!r}, not {wanted!r})"
    if pem_digest is not None and result.pem.digest != pem_digest:
        return (
            f"another error model of the name {config.pem!r} (digest "
            f"{result.pem.digest[:SHOWN]}, now {pem_digest[:SHOWN]})"
        )
    errors = result.position_errors
    if position_digest is not None and errors is not None and errors.digest != position_digest:
        return (
            f"other position errors of the name {config.position_errors!r} (digest "
            f"{errors.digest[:SHOWN]}, now {position_digest[:SHOWN]})"
        )
    return None


def setting_differences(
    first: ExperimentConfig, second: ExperimentConfig
) -> dict[str, tuple[Any, Any]]:
    """The settings in which two configurations differ, by dotted name, with both values."""
    one, other = flat_settings(every_setting(first)), flat_settings(every_setting(second))
    names = [*one, *(name for name in other if name not in one)]
    return {n: (one.get(n), other.get(n)) for n in names if one.get(n) != other.get(n)}


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings with dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found |= flat_settings(cast(Mapping[str, Any], value), f"{prefix}{name}.")
        else:
            found[prefix + name] = value
    return found
