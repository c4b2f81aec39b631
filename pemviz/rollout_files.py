"""Rollouts and proposals on disk, a file a stage while a run goes on, then one for all."""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.lib import format as npy

from pemviz.array_files import read_arrays
from pemviz.arrays import AnyArray
from pemviz.errors import InputError
from pemviz.files import write_atomically
from pemviz.types import Signal, StageResult

PART_FOLDER = "stages"


def stage_arrays(stage: StageResult, signals: Sequence[Signal]) -> dict[str, AnyArray]:
    """A stage's rollouts under the keys of ``rollouts.npz``."""
    scored = stage.scored
    rollouts = scored.rollouts
    count = rollouts.count
    return {
        "repetition": np.full(count, stage.repetition, dtype=np.int64),
        "stage": np.full(count, stage.stage, dtype=np.int64),
        **{signal.key: rollouts.signals[signal.name] for signal in signals},
        "detected": rollouts.detected,
        "log_p": rollouts.log_p,
        "log_q": rollouts.log_q,
        "robustness": scored.robustness,
        "violated": scored.violated,
    }


def part_path(folder: Path, *, repetition: int, stage: int) -> Path:
    """Where one stage's rollouts lie while the run goes on."""
    return folder / PART_FOLDER / f"repetition-{repetition:05d}-stage-{stage:05d}.npz"


def write_part(path: Path, arrays: Mapping[str, AnyArray]) -> None:
    """Write one stage's arrays.

    Raises:
        OSError: They cannot be written.
    """
    path.parent.mkdir(exist_ok=True)
    contents = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    write_atomically(path, lambda stream: np.savez(stream, **cast(Any, contents)))


def join_parts(parts: Sequence[Path], target: Path) -> None:
    """Join the stages' files into one, holding one array of one stage in memory at a time.

    Raises:
        OSError: A file cannot be read or written.
    """

    def write(stream: IO[bytes]) -> None:
        with (
            zipfile.ZipFile(stream, mode="w", compression=zipfile.ZIP_STORED) as archive,
        ):
            with np.load(parts[0], allow_pickle=False) as first:
                names = list(first.files)
            for name in names:
                with archive.open(f"{name}.npy", mode="w", force_zip64=True) as entry:
                    _join_array(entry, name, parts)

    write_atomically(target, write)


def _join_array(entry: IO[bytes], name: str, parts: Sequence[Path]) -> None:
    shapes: list[tuple[int, ...]] = []
    for part in parts:
        with np.load(part, allow_pickle=False) as arrays:
            array = cast(AnyArray, arrays[name])
            shapes.append(array.shape)
            dtype = array.dtype
    header = {
        "descr": npy.dtype_to_descr(dtype),  # pyright: ignore[reportPossiblyUnboundVariable]
        "fortran_order": False,
        "shape": (sum(shape[0] for shape in shapes), *shapes[0][1:]),
    }
    npy.write_array_header_2_0(entry, cast(Any, header))
    for part in parts:
        with np.load(part, allow_pickle=False) as arrays:
            entry.write(np.ascontiguousarray(arrays[name]).tobytes())


def load_rollouts(folder: Path) -> dict[str, AnyArray]:
    """The rollouts of a run folder, finished or not, stages in order.

    Raises:
        InputError: There are none, or a file is damaged.
    """
    whole = folder / "rollouts.npz"
    parts = [whole] if whole.exists() else sorted((folder / PART_FOLDER).glob("*.npz"))
    if not parts:
        message = f"run {folder}: has no rollouts (no rollouts.npz, no finished stage)"
        raise InputError(message)
    tables = [read_arrays(part) for part in parts]
    for part, table in zip(parts[1:], tables[1:], strict=True):
        if _layout(table) != _layout(tables[0]):
            message = f"rollouts {part}: must hold the same arrays as {parts[0].name}"
            raise InputError(message)
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def _layout(table: Mapping[str, AnyArray]) -> dict[str, tuple[str, int, tuple[int, ...]]]:
    """Type and shape, but for the number of rollouts, of each array."""
    return {name: (array.dtype.str, array.ndim, array.shape[1:]) for name, array in table.items()}
