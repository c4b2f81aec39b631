"""Reading a recording back into arrays, with rerun's own reader."""

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
from pemviz.recording.plot import Frame

TABLE_COLUMNS = ("rollout", "robustness", "violated", "log_weight", "log_p")
SCALARS, TENSOR = "Scalars:scalars", "Tensor:data"


@dataclass(frozen=True)
class RecordedStage:
    """One stage's ``[M]`` recorded rollouts, in the order of their index in the stage.

    Attributes:
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


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in chunks(path)}


def columns(path: Path, entity: str) -> dict[str, Any]:
    """Every column logged along an entity, by name; of each the last."""
    return {
        name: column
        for chunk in chunks(path)
        if chunk.entity_path == entity and not chunk.is_static
        for batch in [chunk.to_record_batch()]
        for name, column in zip(batch.schema.names, batch.columns, strict=True)
    }


def newest(path: Path, name: str) -> dict[str, list[Any]]:
    """The last row of a component at each path."""
    batches = ((chunk.entity_path, chunk.to_record_batch()) for chunk in chunks(path))
    return {e: b[name].to_pylist()[-1] for e, b in batches if name in b.schema.names}


def texts(path: Path) -> dict[str, str]:
    """The last text at each path."""
    return {entity: row[0] for entity, row in newest(path, "TextDocument:text").items()}


def titles(path: Path) -> list[str]:
    """Of the views in the recording's last layout, which has most; the first is of texts alone."""
    reader, name = rr.chunk.RrdReader(path), "ViewBlueprint:display_name"
    layouts = []
    for layout in reader.blueprints():
        stored = [chunk.to_record_batch() for chunk in reader.stream(store=layout)]
        rows = [row for b in stored if name in b.schema.names for row in b[name].to_pylist()]
        layouts.append([title for row in rows for title in row])
    return max(layouts, key=len)


def strips(path: Path, entity: str) -> list[AnyArray]:
    """The last line strips ``[N, 2]`` at a path."""
    return [np.array(strip, float) for strip in newest(path, "LineStrips2D:strips")[entity]]


def dots(path: Path, entity: str) -> AnyArray:
    """The last points ``[N, 2]`` at a path."""
    return np.array(newest(path, "Points2D:positions")[entity], float)


def values_at(frame: Frame, places: AnyArray) -> tuple[AnyArray, AnyArray]:
    """What was drawn at places ``[N, 2]``."""
    across, up = places[:, 0] / frame.shape.width, 1.0 - places[:, 1]
    return (
        frame.x.low + across * (frame.x.high - frame.x.low),
        frame.y.low + up * (frame.y.high - frame.y.low),
    )


def scalars(path: Path, entity: str, timeline: str) -> dict[int, list[float]]:
    """Rows of scalars by time."""
    rows = {}
    for chunk in chunks(path):
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            rows.update(zip(batch[timeline].to_pylist(), batch[SCALARS].to_pylist(), strict=True))
    return rows


def read_stages(path: Path) -> dict[int, RecordedStage]:
    """Every stage's recorded rollouts, by stage.

    A recording may have been cut short, or rewritten by ``rerun rrd optimize``, which spreads
    columns over chunks. Read only files that are otherwise whole: at other damage rerun's reader
    may end the process.

    Raises:
        InputError: The file cannot be read as a recording.
    """
    parts: dict[int, dict[str, Any]] = {}
    for chunk in chunks(path):
        root, *pieces = chunk.entity_path.strip("/").split("/")
        if chunk.is_static or len(pieces) != 2 or root != "rollouts":
            continue
        stage, part = int(pieces[0].removeprefix("stage_")), pieces[1]
        found = parts.setdefault(stage, {"table": {}, "series": {}})
        batch = chunk.to_record_batch()
        names = batch.schema.names
        if part == paths.TABLE:
            known = {n: np.array(batch[n][0].as_py()) for n in TABLE_COLUMNS if n in names}
            found["table"].update(known)
        elif part == paths.DETECTED and TENSOR in names:
            found["detected"] = _raster(batch[TENSOR][0].as_py()[0])
        elif part != paths.MISSED_SHARE and SCALARS in names:
            steps = batch[paths.STEP].to_pylist()
            rows = batch[SCALARS].flatten().to_numpy(zero_copy_only=False)
            rows = rows.reshape(len(steps), -1)
            found["series"].setdefault(part, {}).update(zip(steps, rows, strict=True))
    return {stage: _stage(found) for stage, found in sorted(parts.items()) if _whole(found)}


def _raster(tensor: dict[str, Any]) -> AnyArray:
    """A byte tensor as an array; rerun keeps which of its buffers is used in its type."""
    buffer = tensor["buffer"]
    values = next(iter(buffer.values())) if isinstance(buffer, dict) else buffer
    return np.array(list(values), dtype=np.uint8).reshape(tensor["shape"])


def _whole(found: dict[str, Any]) -> bool:
    return set(found["table"]) == set(TABLE_COLUMNS) and "detected" in found and found["series"]


def _stage(found: dict[str, Any]) -> RecordedStage:
    order = np.argsort(found["table"]["rollout"])
    series = {
        key: np.stack([rows[step] for step in sorted(rows)], axis=1)[order]
        for key, rows in found["series"].items()
    }
    table = {name: values[order] for name, values in found["table"].items()}
    detected = found["detected"][::-1][order].astype(np.bool_)
    return RecordedStage(**table, series=series, detected=detected)
