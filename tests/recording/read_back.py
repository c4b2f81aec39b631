"""Reading a recording's rollouts back into arrays, with rerun's own reader."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.errors import InputError
from pemviz.recording import paths

TABLE_COLUMNS = ("rollout", "robustness", "violated", "log_weight", "log_p")
SCALARS, TENSOR = "Scalars:scalars", "Tensor:data"


@dataclass(frozen=True)
class RecordedStage:
    """One stage's recorded rollouts, in the order of their index in the stage.

    Attributes:
        rollout: ``[M]`` index in the stage.
        robustness: ``[M]`` under the ranking metric.
        violated: ``[M]`` the classical verdict.
        log_weight: ``[M]`` log importance weight [nats].
        log_p: ``[M]`` log likelihood under the perception error model [nats].
        series: By key: each signal ``[M, T]``, and P(detected) ``[M, T-1]`` of the perception
            error model (``p_detected_pem``) and the proposal (``p_detected_proposal``).
        detected: ``[M, T-1]`` outcomes.
    """

    rollout: IntArray
    robustness: FloatArray
    violated: BoolArray
    log_weight: FloatArray
    log_p: FloatArray
    series: dict[str, FloatArray]
    detected: BoolArray


def read_stages(path: Path) -> dict[int, RecordedStage]:
    """Every stage's recorded rollouts, by stage.

    A recording may have been cut short, or rewritten by ``rerun rrd optimize``. Read only files
    that are otherwise whole: at other damage rerun's reader may end the process.

    Raises:
        InputError: The file cannot be read as a recording.
    """
    parts: dict[int, dict[str, Any]] = {}
    for entity, batch in batches(path):
        pieces = entity.strip("/").split("/")
        if len(pieces) != 3 or f"/{pieces[0]}" != paths.ROLLOUTS:
            continue
        stage = int(pieces[1].removeprefix("stage_"))
        found = parts.setdefault(stage, {})
        _add(found, pieces[2], batch)
    return {stage: _stage(found) for stage, found in sorted(parts.items()) if _whole(found)}


def _add(found: dict[str, Any], part: str, batch: dict[str, Any]) -> None:
    """Take what a chunk holds of a stage; an optimized recording spreads columns over chunks."""
    if part == paths.TABLE:
        columns = {n: np.array(_first(batch, n)) for n in TABLE_COLUMNS if n in batch}
        found.setdefault(paths.TABLE, {}).update(columns)
    elif part == paths.DETECTED:
        if TENSOR in batch:
            found[paths.DETECTED] = _raster(_first(batch, TENSOR)[0])
    elif part != paths.MISSED_SHARE and SCALARS in batch:
        rows = zip(batch[paths.STEP].tolist(), batch[SCALARS], strict=True)
        found.setdefault("series", {}).setdefault(part, {}).update(rows)


def batches(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Entity path and columns by name of every chunk that is not static, in the file's order.

    Raises:
        InputError: The file cannot be read as a recording.
    """
    for chunk in chunks(path):
        if not chunk.is_static:
            yield chunk.entity_path, _columns(chunk.to_record_batch())


def chunks(path: Path) -> Iterator[Any]:
    """Rerun's chunks of the recording, in the file's order; without complaint if it was cut short.

    Raises:
        InputError: The file cannot be read as a recording.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="RRD file has no footer")
            reader = rr.chunk.RrdReader(path)
        yield from reader.stream()
    except (OSError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        message = f"recording {path}: cannot be read ({reason})"
        raise InputError(message) from error


def _columns(batch: Any) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for field, column in zip(batch.schema, batch.columns, strict=True):
        if field.name == SCALARS:
            columns[field.name] = _rows(column)
        elif field.name == paths.STEP:
            columns[field.name] = column.to_numpy(zero_copy_only=False)
        else:
            columns[field.name] = column
    return columns


def _rows(column: Any) -> list[FloatArray]:
    """A list column as one array for each row."""
    values = column.flatten().to_numpy(zero_copy_only=False)
    return np.split(values, np.cumsum(column.value_lengths().to_numpy(zero_copy_only=False))[:-1])


def _first(batch: dict[str, Any], name: str) -> Any:
    return batch[name][0].as_py()


def _raster(tensor: dict[str, Any]) -> AnyArray:
    """A byte tensor as an array; rerun keeps which of its buffers is used in its type."""
    buffer = tensor["buffer"]
    values = next(iter(buffer.values())) if isinstance(buffer, dict) else buffer
    return np.array(list(values), dtype=np.uint8).reshape(tensor["shape"])


def _whole(found: dict[str, Any]) -> bool:
    table_whole = set(found.get(paths.TABLE, ())) == set(TABLE_COLUMNS)
    return table_whole and paths.DETECTED in found and bool(found.get("series"))


def _stage(found: dict[str, Any]) -> RecordedStage:
    table = found[paths.TABLE]
    order = np.argsort(table["rollout"])
    series = {
        key: np.stack([rows[step] for step in sorted(rows)], axis=1)[order]
        for key, rows in found["series"].items()
    }
    return RecordedStage(
        rollout=table["rollout"][order],
        robustness=table["robustness"][order],
        violated=table["violated"][order],
        log_weight=table["log_weight"][order],
        log_p=table["log_p"][order],
        series=series,
        detected=found[paths.DETECTED][::-1][order].astype(np.bool_),
    )
