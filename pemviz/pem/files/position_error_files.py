"""Models of position errors on disk: safetensors with one line of JSON; nothing read can run code.

The shipped ones lie in a folder of their own, apart from the error models of misses.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from pemviz.arrays import AnyArray, FloatArray
from pemviz.errors import PemError
from pemviz.files.atomic import write_bytes
from pemviz.files.json_text import parse_json
from pemviz.files.shipped import asset_path
from pemviz.pem.files.load import SUFFIX
from pemviz.pem.files.model_files import read_tensors
from pemviz.pem.models.position_error_card import position_card_from_mapping
from pemviz.pem.models.position_errors import ErrorAxis, NoiseMemory, PositionErrorModel
from pemviz.pem.models.tensors import as_double

POSITION_METADATA_KEY = "pemviz-position-errors"
POSITION_ASSET_FOLDER = "position_errors"
FORMAT_VERSION = 1
PARTS = {"mean": (4,), "log_scale": (6,), "tail": (1,), "memory": (2,)}
"""Shape of each tensor of a kind of error."""


def shipped_position_errors() -> tuple[str, ...]:
    """Names of the models of position errors that come with pemviz."""
    return tuple(sorted(path.stem for path in asset_path(POSITION_ASSET_FOLDER).glob(f"*{SUFFIX}")))


def load_position_errors(name_or_path: str) -> PositionErrorModel:
    """Load a shipped model of position errors by name, or a file by path.

    Raises:
        PemError: There is none, or the file cannot be used; one line says why.
    """
    path = Path(name_or_path)
    if name_or_path in shipped_position_errors():
        path = asset_path(POSITION_ASSET_FOLDER, f"{name_or_path}{SUFFIX}")
    elif path.suffix != SUFFIX:
        raise PemError(
            f"no model of position errors {name_or_path!r}; give one of "
            f"{', '.join(shipped_position_errors())}, or a path to {SUFFIX}"
        )
    tensors, metadata = read_tensors(path)
    if POSITION_METADATA_KEY not in metadata:
        raise PemError(f"{path}: no model of position errors ('pemviz pem fit --position-errors')")
    return _model(tensors, metadata[POSITION_METADATA_KEY], where=str(path))


def save_position_errors(model: PositionErrorModel, path: Path) -> None:
    """Write a model as safetensors; the same model gives the same bytes."""
    header = {
        "version": FORMAT_VERSION,
        "axes": [axis.name for axis in model.axes],
        "card": asdict(model.card),
    }
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    contiguous = {name: np.ascontiguousarray(array) for name, array in model.tensors().items()}
    write_bytes(path, save(contiguous, metadata={POSITION_METADATA_KEY: text}))


def is_position_errors(name_or_path: str) -> bool:
    """Whether a shipped name or a readable file is a model of position errors."""
    if name_or_path in shipped_position_errors():
        return True
    path = Path(name_or_path)
    return path.suffix == SUFFIX and POSITION_METADATA_KEY in read_tensors(path)[1]


def _model(tensors: Mapping[str, AnyArray], text: str, *, where: str) -> PositionErrorModel:
    try:
        header: Any = parse_json(text)
    except ValueError as error:
        raise PemError(f"{where}: metadata is not JSON ({error})") from None
    if not isinstance(header, dict) or header.get("version") != FORMAT_VERSION:
        raise PemError(f"{where}: metadata does not say 'version' {FORMAT_VERSION}")
    names, card = header.get("axes"), header.get("card")
    if not isinstance(names, list) or not isinstance(card, dict):
        raise PemError(f"{where}: metadata lacks 'axes' or 'card'")
    if not all(isinstance(name, str) for name in names):
        raise PemError(f"{where}: metadata field 'axes' must hold text")
    read = _Reader(tensors, where)
    axes = tuple(_axis(read, name) for name in names)
    ends = read.taken("ends", (2, 2))
    correlation = read.taken("correlation", (len(axes), len(axes)))
    read.finish()
    try:
        return PositionErrorModel(
            axes=axes,
            correlation=correlation,
            distance_m=(float(ends[0, 0]), float(ends[0, 1])),
            bearing_rad=(float(ends[1, 0]), float(ends[1, 1])),
            card=position_card_from_mapping(card, where=where),
        )
    except PemError as error:
        raise PemError(f"{where}: {str(error).removeprefix(f'{where}: ')}") from None


class _Reader:
    """Takes tensors by name and shape, and knows what was left."""

    def __init__(self, tensors: Mapping[str, AnyArray], where: str) -> None:
        self._left = dict(tensors)
        self._where = where

    def taken(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        array = self._left.pop(name, None)
        if array is None or array.shape != shape:
            found = "missing" if array is None else f"of shape {list(array.shape)}"
            raise PemError(f"{self._where}: tensor {name!r} is {found}, need {list(shape)}")
        return as_double(array)

    def finish(self) -> None:
        if self._left:
            raise PemError(f"{self._where}: unknown tensors {sorted(self._left)}")


def _axis(read: _Reader, name: str) -> ErrorAxis:
    parts = {part: read.taken(f"{name}.{part}", shape) for part, shape in PARTS.items()}
    return ErrorAxis(
        name=name,
        mean=parts["mean"],
        log_scale=parts["log_scale"],
        degrees_of_freedom=float(parts["tail"][0]),
        memory=NoiseMemory(*parts["memory"].tolist()),
    )
