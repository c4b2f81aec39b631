"""Rollouts on disk, a file a stage while a run goes on, then one for all.

A stage that holds some of its rollouts also says what is known of all of them.
"""

import contextlib
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
from numpy.lib import format as npy

from pemviz.arrays import LARGEST_NUMBER, AnyArray, FloatArray, IntArray, row_sums
from pemviz.config import LIMITS
from pemviz.errors import InputError
from pemviz.files.array_files import DIGEST, append_digest, read_arrays, read_digested
from pemviz.files.atomic import write_atomically
from pemviz.latents import Latents
from pemviz.sampling.problem import FinishedStage
from pemviz.types import (
    RolloutBatch,
    SampledRollouts,
    ScoredRollouts,
    Signal,
    StageResult,
    outcome_log_likelihood,
)

ROLLOUTS_FILE, PART_FOLDER = "rollouts.npz", "stages"
ALL = "all."
"""Before the names of what is known of all rollouts, in the file of a stage that holds some."""
EVERY = f"{ALL}every"
ROLLOUT = "rollout"
"""Each rollout's index in its stage, in files that do not hold all of them."""
MEMORY, KEPT = "memory.", "kept."
PARTS_OWN = MEMORY, KEPT, ALL
"""Before the names of what stands in a stage's file alone."""
BROKEN = "broken."
"""Before a rule's name: whether a rollout breaks it."""
COLUMN = "method."
"""Before the names of what the method keeps of each rollout once a run is done."""
LATENTS = "latents."
"""Before the names of :class:`pemviz.latents.Latents`' arrays, of those that have columns."""
SAMPLED = "drawn"
"""How many rollouts a stage drew, in its file if that does not hold all of them."""
MOST_OPEN = 64
"""Stages' files that are open at a time while they are joined; of more each is opened in turn."""
Opened = Callable[[], contextlib.AbstractContextManager[Any]]
"""A stage's file, open for the time of a ``with``."""
LOGITS = {"log_p": "pem_logit", "log_q": "proposal_logit"}
"""Likelihoods of a stage's file are computed from these when they are read."""


def stage_arrays(
    stage: StageResult, signals: Sequence[Signal], *, likelihoods: bool = True
) -> dict[str, AnyArray]:
    """A stage's rollouts under the keys of ``rollouts.npz``, with their likelihoods or without."""
    scored, rollouts, latents = stage.scored, stage.scored.rollouts, stage.scored.rollouts.latents
    kept: dict[str, AnyArray | None] = {}
    if latents is not None:
        has = {"start": latents.start.shape[1], "noise": latents.noise.shape[2]}
        names = [field.name for field in fields(Latents) if has[field.name.partition("_")[0]]]
        kept = {name: getattr(latents, name) for name in names}
    return {
        "repetition": np.full(rollouts.count, stage.repetition, dtype=np.int64),
        "stage": np.full(rollouts.count, stage.stage, dtype=np.int64),
        **{signal.key: rollouts.signals[signal.name] for signal in signals},
        "detected": rollouts.detected,
        **({"log_p": rollouts.log_p, "log_q": rollouts.log_q} if likelihoods else {}),
        **{f"{LATENTS}{name}": values for name, values in kept.items() if values is not None},
        "robustness": scored.robustness,
        "violated": scored.violated,
        **{f"{BROKEN}{name}": broken for name, broken in scored.broken.items()},
    }


def latents_of(arrays: Mapping[str, AnyArray]) -> Latents | None:
    """The latents of rollouts ``arrays`` as they are kept in files; ``None`` if there are none.

    Raises:
        ValueError: They do not fit together, are no finite numbers, or no shares or spreads.
    """
    found = _without_prefix(arrays, LATENTS)
    if not found:
        return None
    count, steps = arrays["detected"].shape[:2]
    columns = {n: np.atleast_1d(found[n]).shape[-1] for n in ("start", "noise") if n in found}
    start, noise = (count, columns.get("start", 0)), (count, steps, columns.get("noise", 0))
    shapes = {"start": start, "start_mean": start, "start_log_weight": start[:1]}
    shapes |= {"noise": noise, "noise_mean": noise, "noise_share": noise[:2], "noise_sd": noise}
    optional = {"noise_narrow_mean": noise, "noise_narrow_share": noise[:2]}
    shapes |= {name: shape for name, shape in optional.items() if name in found}
    kept: dict[str, AnyArray] = {}
    for name, shape in shapes.items():
        declared = columns.get(name.partition("_")[0], 0) > 0
        unmoved = np.full(shape, 0.0 if name.endswith("_weight") else 1.0)
        absent = unmoved if name.endswith("_sd") else np.empty(0)  # not in older files
        values = found.get(name, absent) if declared else unmoved
        if values.shape != shape or values.dtype != np.float64 or not _is_bounded(values):
            raise ValueError(f"{LATENTS}{name} must be finite numbers of shape {shape}")
        if name.endswith("_share") and np.any((values < 0.0) | (values > 1.0)):
            raise ValueError(f"{LATENTS}{name} must be from 0 to 1")
        if name.endswith("_sd") and np.any(values <= 0.0):
            raise ValueError(f"{LATENTS}{name} must be above 0")
        kept[name] = values
    return Latents(**kept)


def log_weights(arrays: Mapping[str, AnyArray]) -> FloatArray:
    """Log importance weights ``[N]`` of rollouts under the keys of ``rollouts.npz`` [nats].

    Raises:
        ValueError: Latents do not fit together, or are no finite numbers.
    """
    of_outcomes = row_sums(np.subtract(arrays["log_p"], arrays["log_q"], order="C"))
    latents = latents_of(arrays)
    return of_outcomes if latents is None else of_outcomes + latents.log_weight


def part_arrays(
    stage: StageResult, signals: Sequence[Signal], *, rows: IntArray | None = None
) -> dict[str, AnyArray]:
    """All that a stage's file holds: whole, enough to go on from it in another process.

    Args:
        stage: The stage.
        signals: The scenario's.
        rows: Which of its rollouts the file holds, ascending; ``None``: all, unnumbered.
    """
    if rows is not None:
        number = rows if stage.sampled is None else stage.sampled.row[rows]
        arrays = part_arrays(replace(stage, scored=stage.scored.take(rows)), signals)
        arrays |= {ROLLOUT: number, SAMPLED: np.array(stage.count)}
        return arrays if stage.sampled is None else arrays | sampled_arrays(stage.sampled)
    rollouts = stage.scored.rollouts
    arrays = stage_arrays(stage, signals, likelihoods=False)
    arrays["pem_logit"] = rollouts.pem_logit
    arrays["proposal_logit"] = rollouts.proposal_logit
    for name, values in rollouts.memory.items():
        if values.dtype != np.object_:  # copies of an environment: no stage is continued inside
            arrays[f"{MEMORY}{name}"] = values
    arrays.update({f"{KEPT}{name}": values for name, values in stage.kept.items()})
    return arrays


def sampled_arrays(sampled: SampledRollouts) -> dict[str, AnyArray]:
    """What is known of all rollouts of a stage, in its file."""
    return {
        EVERY: np.array(sampled.every),
        f"{ALL}robustness": sampled.robustness,
        f"{ALL}violated": sampled.violated,
        f"{ALL}log_weight": sampled.log_weight,
    }


def sampled_of(arrays: Mapping[str, AnyArray]) -> SampledRollouts | None:
    """The same, read back; ``None`` where a file has nothing of it.

    Raises:
        KeyError: Something of it is missing.
        ValueError: Something does not fit the rest, or is of the wrong type.
    """
    if not any(name.startswith(ALL) for name in arrays):
        return None
    robustness, violated = arrays[f"{ALL}robustness"], arrays[f"{ALL}violated"]
    log_weight, row, every = arrays[f"{ALL}log_weight"], arrays[ROLLOUT], arrays[EVERY]
    count = violated.size
    fits = (
        violated.dtype == np.bool_
        and all(values.dtype == np.float64 for values in (robustness, log_weight))
        and all(values.shape == (count,) for values in (robustness, violated, log_weight))
        and not np.isnan(robustness).any()
        and bool(np.isfinite(log_weight).all())
        and all(values.dtype == np.int64 for values in (row, every))
        and every.shape == ()
        and bool(every > 0)
        and row.shape == arrays["violated"].shape
        and bool(np.all(np.diff(row, prepend=-1) > 0))
        and (row.size == 0 or bool(row[-1] < count))
    )
    if not fits:
        raise ValueError("what it says of all rollouts does not fit together")
    return SampledRollouts(row, int(every), robustness, violated, log_weight)


def finished_stage(path: Path, signals: Sequence[Signal]) -> FinishedStage | None:
    """A stage's file as the stage; ``None`` if it does not hold all of its rollouts.

    Raises:
        InputError: It is damaged.
    """
    arrays = read_digested(path, of=_belongs_to(path))
    held = arrays["violated"].size if "violated" in arrays else 0
    try:
        sampled = sampled_of(arrays)
        if sampled is None and SAMPLED in arrays and not np.array_equal(arrays[SAMPLED], held):
            return None
        rollouts = RolloutBatch(
            signals={signal.name: arrays[signal.key] for signal in signals},
            memory=_without_prefix(arrays, MEMORY),
            detected=arrays["detected"],
            pem_logit=arrays["pem_logit"],
            proposal_logit=arrays["proposal_logit"],
            latents=latents_of(arrays),
        ).map(np.asfortranarray)
        scored = ScoredRollouts(rollouts, arrays["robustness"], arrays["violated"])
        _check_shapes(scored)
    except KeyError as error:
        raise InputError(f"stage {path}: {error} is missing") from error
    except ValueError as error:
        raise InputError(f"stage {path}: {error}") from error
    return FinishedStage(scored=scored, kept=_without_prefix(arrays, KEPT), sampled=sampled)


def _without_prefix(arrays: Mapping[str, AnyArray], prefix: str) -> dict[str, AnyArray]:
    return {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}


def _check_shapes(scored: ScoredRollouts) -> None:
    rollouts = scored.rollouts
    if rollouts.detected.ndim not in (2, 3):
        raise ValueError(f"detected has shape {rollouts.detected.shape}")
    count, steps = rollouts.detected.shape[:2]
    expected = {
        (count, steps + 1): (*rollouts.signals.values(), *rollouts.memory.values()),
        rollouts.detected.shape: (rollouts.pem_logit, rollouts.proposal_logit),
        (count,): (scored.robustness, scored.violated),
    }
    for shape, arrays in expected.items():
        if any(array.shape != shape for array in arrays):
            raise ValueError(f"an array has not the shape {shape}")
    outcomes = rollouts.detected, scored.violated
    numbers = *rollouts.signals.values(), rollouts.pem_logit, rollouts.proposal_logit
    if (
        any(array.dtype != np.bool_ for array in outcomes)
        or any(a.dtype.kind != "f" or not _is_bounded(a) for a in numbers)
        or scored.robustness.dtype != np.float64
        or np.isnan(scored.robustness).any()
    ):
        raise ValueError("an array is of the wrong type, or holds what is no number")


def _is_bounded(values: AnyArray) -> bool:
    return bool(np.all(np.abs(values.astype(np.float64, copy=False)) <= LARGEST_NUMBER))


def part_path(folder: Path, *, repetition: int, stage: int) -> Path:
    """Where one stage's rollouts lie while the run goes on."""
    return folder / PART_FOLDER / f"repetition-{repetition:05d}-stage-{stage:05d}.npz"


def _belongs_to(path: Path) -> bytes:
    """What a stage's file is of: repetition and stage by its name, a run by its settings.

    By those but what a run may go on with others of: its limits, and ``lost``, if it has lost none.
    """
    settings = path.parent.parent / "config.toml"
    lines = settings.read_bytes().splitlines(keepends=True) if settings.is_file() else []
    free = tuple(f"{name} = ".encode() for name in ("lost", *LIMITS))
    own = (line for line in lines if not line.startswith(free))
    return path.name.encode() + b"\n" + b"".join(own)


def stage_files(folder: Path) -> list[Path]:
    """The files of a run folder's finished stages, in order; none once the run is done."""
    return sorted((folder / PART_FOLDER).glob("repetition-*.npz"))


def write_part(path: Path, arrays: Mapping[str, AnyArray]) -> None:
    """Write one stage's arrays, and last a digest of them."""
    path.parent.mkdir(exist_ok=True)
    contents = {name: np.asarray(array, order="C") for name, array in arrays.items()}

    def write(stream: BinaryIO) -> None:
        np.savez(stream, **cast(Any, contents))
        append_digest(stream, of=_belongs_to(path))

    write_atomically(path, write)


def join_parts(
    parts: Sequence[Path], target: Path, *, columns: Sequence[Mapping[str, AnyArray]] = ()
) -> None:
    """Join the stages' files into one, holding one array of one stage in memory at a time.

    The same stages give the same bytes.

    Args:
        parts: The stages' files.
        target: The file.
        columns: What the method keeps of all rollouts that each stage sampled, in that order; of
            what it keeps of some stages alone the others have NaN, or -1.
    """

    def write(stream: IO[bytes]) -> None:
        with (
            contextlib.ExitStack() as kept,
            zipfile.ZipFile(stream, mode="w", compression=zipfile.ZIP_STORED) as archive,
        ):

            def entry(name: str) -> IO[bytes]:
                info = zipfile.ZipInfo(f"{name}.npy")  # dated 1980, whenever it is written
                return archive.open(info, mode="w", force_zip64=True)

            stages = [_opened(part, kept if len(parts) <= MOST_OPEN else None) for part in parts]
            with stages[0]() as first:
                names = _documented(first.files)
            rows = 0
            for stage in stages:
                with stage() as arrays:
                    rows += arrays["repetition"].shape[0]
            for name in names:
                with entry(name) as content:
                    _join_array(content, name, stages, rows=rows)
            for name, kind in {n: v.dtype for values in columns for n, v in values.items()}.items():
                held: list[AnyArray] = []
                for stage, values in zip(stages, columns, strict=True):
                    with stage() as arrays:
                        count = arrays["repetition"].shape[0]
                        rows = arrays[ROLLOUT] if ROLLOUT in arrays else slice(None)
                    unknown = np.full(count, np.nan if kind.kind == "f" else -1, dtype=kind)
                    held.append(values[name][rows] if name in values else unknown)
                with entry(f"{COLUMN}{name}") as content:
                    npy.write_array(content, np.concatenate(held), version=(2, 0))

    write_atomically(target, write)


def _opened(part: Path, kept: contextlib.ExitStack | None) -> Opened:
    """Opens a stage's file each time, or once, to be closed with those ``kept``."""
    if kept is None:
        return lambda: np.load(part, allow_pickle=False)
    arrays = kept.enter_context(np.load(part, allow_pickle=False))
    return lambda: contextlib.nullcontext(arrays)


def _documented(names: Sequence[str]) -> list[str]:
    """Of a stage's file, what stands in ``rollouts.npz``, in its order."""
    left_out = {SAMPLED, DIGEST, *LOGITS.values()}
    columns = [n for n in names if not n.startswith((*PARTS_OWN, COLUMN)) and n not in left_out]
    if "log_p" in columns:
        return columns
    after = columns.index("detected") + 1
    return [*columns[:after], *LOGITS, *columns[after:]]


def _array(arrays: Any, name: str) -> AnyArray:
    """One array of a stage's file; likelihoods are computed."""
    if name in LOGITS and name not in arrays:
        return outcome_log_likelihood(arrays[LOGITS[name]], arrays["detected"])
    return arrays[name]


def _join_array(content: IO[bytes], name: str, stages: Sequence[Opened], *, rows: int) -> None:
    for number, stage in enumerate(stages):
        with stage() as arrays:
            array = np.ascontiguousarray(_array(arrays, name))
        if number == 0:
            shape, descr = (rows, *array.shape[1:]), npy.dtype_to_descr(array.dtype)
            header = {"descr": descr, "fortran_order": False, "shape": shape}
            npy.write_array_header_2_0(content, cast(Any, header))
        content.write(cast(Any, array).data.cast("B"))


def load_rollouts(folder: Path) -> dict[str, AnyArray]:
    """The rollouts of a run folder, finished or not, stages in order.

    Without the columns that the method keeps for :mod:`pemviz.runs.coherence`.

    Raises:
        InputError: There are none, or a file is damaged.
    """
    whole = folder / ROLLOUTS_FILE
    # stages' files are there until the run is done, and may be more than were joined so far
    parts = stage_files(folder)
    if parts:
        tables = [read_digested(part, of=_belongs_to(part)) for part in parts]
    elif whole.exists():
        parts, tables = [whole], [read_arrays(whole)]
    else:
        raise InputError(f"run {folder}: has no rollouts (no rollouts.npz, no finished stage)")
    for part, table in zip(parts[1:], tables[1:], strict=True):
        if _layout(table) != _layout(tables[0]):
            raise InputError(f"rollouts {part}: must hold the same arrays as {parts[0].name}")
    try:
        return {
            name: np.concatenate([_array(table, name) for table in tables])
            for name in _documented(list(tables[0]))
        }
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"rollouts {parts[0]}: do not hold a stage's arrays ({error})") from error


def _layout(table: Mapping[str, AnyArray]) -> dict[str, tuple[str, int, tuple[int, ...]]]:
    """Type and shape, but for the number of rollouts, of each array that all stages have."""
    return {
        name: (array.dtype.str, array.ndim, array.shape[1:])
        for name, array in table.items()
        if not name.startswith(PARTS_OWN) and name not in (SAMPLED, DIGEST)
    }
