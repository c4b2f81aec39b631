"""Files of models that a run names, sent along to workers that do not see this machine's disk."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pemviz.config import ExperimentConfig
from pemviz.errors import InputError
from pemviz.files.atomic import write_bytes
from pemviz.pem.files.load import ENSEMBLE_ENDING, SUFFIX, shipped_pems
from pemviz.pem.files.position_error_files import shipped_position_errors

PEM_FOLDER, POSITION_FOLDER = "model", "position-errors"

Files = tuple[tuple[str, bytes], ...]
NamedModels = tuple[str, str | None]
"""What a configuration calls its error model and its position errors."""


@dataclass(frozen=True)
class ModelFiles:
    """Names and contents; none of a model that every worker has.

    Attributes:
        pem: Of the error model, its own first.
        position_errors: Of the position errors.
    """

    pem: Files = ()
    position_errors: Files = ()

    def put_into(self, folder: Path, config: ExperimentConfig) -> ExperimentConfig:
        """Write them below ``folder`` and return the configuration that names them there."""
        if self.pem:
            config = replace(config, pem=str(_written(self.pem, folder / PEM_FOLDER)))
        if self.position_errors:
            path = _written(self.position_errors, folder / POSITION_FOLDER)
            config = replace(config, position_errors=str(path))
        return config


def models_of(config: ExperimentConfig) -> NamedModels:
    """The models that a configuration names."""
    return config.pem, config.position_errors


def model_files(models: NamedModels) -> ModelFiles:
    """The files that a configuration names: the models, and the error model's ensemble beside it.

    Raises:
        InputError: They cannot be read.
    """
    pem, errors = models
    sent = ModelFiles()
    if pem not in shipped_pems():
        path = Path(pem)
        stem = path.stem.removesuffix(ENSEMBLE_ENDING)
        partner = path.with_name(f"{stem}{ENSEMBLE_ENDING}{SUFFIX}")
        beside = [partner] if partner != path and path.suffix == SUFFIX else []
        present = [path, *(one for one in beside if one.is_file())]
        sent = replace(sent, pem=_read(present, f"pem = {pem!r}"))
    if errors is not None and errors not in shipped_position_errors():
        read = _read([Path(errors)], f"position_errors = {errors!r}")
        sent = replace(sent, position_errors=read)
    return sent


def _read(paths: Sequence[Path], setting: str) -> Files:
    try:
        return tuple((path.name, path.read_bytes()) for path in paths)
    except OSError as error:
        message = f"{setting}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error


def _written(files: Files, place: Path) -> Path:
    """Write files into a folder made for them, and return the first one's path."""
    place.mkdir()
    for name, content in files:
        write_bytes(place / Path(name).name, content)
    return place / Path(files[0][0]).name
