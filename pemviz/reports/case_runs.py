"""What a safety case is made from: runs as they were kept, and the cards of their models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.errors import InputError
from pemviz.files.atomic import file_digest
from pemviz.pem import PemCard, load_pem
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result import RunResult
from pemviz.runs.result_file import RESULT_FILE, has_result
from pemviz.runs.rollout_files import load_rollouts, log_weights

ROLLOUTS = "rollouts.npz"
LARGEST_BYTES = 200_000_000
KEPT_FILES = (RESULT_FILE, "config.toml", ROLLOUTS, "proposals.safetensors", "run.rrd")
SWEEP_RUNS = "runs"
LIKELIEST = 12
GAP = "gap_m"


@dataclass(frozen=True)
class Violations:
    """The violating rollouts that carry most of the estimate, the likeliest first.

    Gaps ``[V, T]`` [m], outcomes ``[V, T-1]``, shares of all violating rollouts' weight ``[V]``.
    """

    gap_m: FloatArray
    missed: BoolArray
    share: FloatArray


@dataclass(frozen=True)
class CaseRun:
    """A run of a safety case.

    Attributes:
        card: Of its error model; ``None`` where the model is not at hand, or is another one now.
        digests: SHA-256 of the files that were kept, by name.
        violations: The likeliest; ``None`` where rollouts were not kept, or nothing violates.
        folder: Where the files are.
    """

    name: str
    result: RunResult
    card: PemCard | None
    digests: Mapping[str, str]
    violations: Violations | None
    folder: Path = Path()


def run_folders(paths: Sequence[Path]) -> list[Path]:
    """Run folders, with those of a sweep in place of the sweep's.

    Raises:
        InputError: One is no run or sweep, or is named twice.
    """
    folders: list[Path] = []
    for path in paths:
        if not path.is_dir():
            message = f"run {path}: there is no such folder"
            raise InputError(message)
        within = path / SWEEP_RUNS
        if not has_result(path) and within.is_dir():
            runs = sorted(run for run in within.iterdir() if has_result(run))
            if not runs:
                message = f"sweep {path}: holds no run that was finished"
                raise InputError(message)
            folders += runs
        else:
            folders.append(path)
    seen: set[Path] = set()
    for folder in folders:
        if folder.resolve() in seen:
            message = f"run {folder}: is named twice"
            raise InputError(message)
        seen.add(folder.resolve())
    return folders


def read_case_run(folder: Path) -> CaseRun:
    """A run folder as evidence.

    Raises:
        InputError: Its files are absent or damaged, or do not belong together.
    """
    result = read_whole_run(folder)
    digests = {name: file_digest(folder / name) for name in KEPT_FILES if (folder / name).is_file()}
    return CaseRun(
        name=folder.resolve().name,
        result=result,
        card=_card(result),
        digests=digests,
        violations=_violations(folder, result),
        folder=folder,
    )


def _card(result: RunResult) -> PemCard | None:
    """The card of the very model that was used, where it is at hand; no code is run for it."""
    try:
        model = load_pem(result.config.pem)
    except InputError:
        return None
    card: object = getattr(model, "card", None)
    return card if isinstance(card, PemCard) and model.digest == result.pem.digest else None


def _violations(folder: Path, result: RunResult) -> Violations | None:
    """Of the final rollouts if some of them violate, otherwise of all; not of very large files.

    Raises:
        InputError: The rollouts are damaged.
    """
    path = folder / ROLLOUTS
    if not path.is_file() or path.stat().st_size > LARGEST_BYTES:
        return None
    rollouts = load_rollouts(folder)
    try:
        return _likeliest(rollouts, result)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        message = f"rollouts {path}: do not fit together ({error})"
        raise InputError(message) from error


def _likeliest(rollouts: Mapping[str, AnyArray], result: RunResult) -> Violations | None:
    violated = np.asarray(rollouts["violated"], dtype=np.bool_)
    final = {(stage.repetition, stage.stage) for stage in result.stages if stage.kind == "final"}
    pairs = zip(rollouts["repetition"].tolist(), rollouts["stage"].tolist(), strict=True)
    in_final = np.fromiter((pair in final for pair in pairs), dtype=np.bool_, count=violated.size)
    found = np.flatnonzero(violated & in_final if np.any(violated & in_final) else violated)
    if found.size == 0 or GAP not in rollouts or rollouts["detected"].ndim > 2:
        return None  # the picture is of one obstacle's misses against its gap
    log_weight = log_weights(rollouts)[found]
    weight = np.exp(log_weight - np.max(log_weight))
    order = np.argsort(-weight, kind="stable")[:LIKELIEST]
    missed = ~np.asarray(rollouts["detected"][found[order]], dtype=np.bool_)
    gap_m = np.asarray(rollouts[GAP][found[order]], dtype=np.float64)
    if missed.shape != (order.size, gap_m.shape[1] - 1) or not np.isfinite(gap_m).all():
        message = "gaps and outcomes differ in shape, or are no numbers"
        raise ValueError(message)
    return Violations(gap_m=gap_m, missed=missed, share=weight[order] / float(np.sum(weight)))
