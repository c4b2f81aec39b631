"""An error model's files, sent along to workers that do not see this machine's disk."""

from dataclasses import dataclass
from pathlib import Path

from pemviz.errors import InputError
from pemviz.files.atomic import write_bytes
from pemviz.pem.files.load import ENSEMBLE_ENDING, SUFFIX, shipped_pems

FOLDER = "model"


@dataclass(frozen=True)
class ModelFiles:
    """Names and contents, the model's own first; none for a model that every worker has."""

    files: tuple[tuple[str, bytes], ...] = ()

    def put_into(self, folder: Path) -> Path | None:
        """Write them below ``folder`` and return the model's path; ``None`` if there are none."""
        if not self.files:
            return None
        place = folder / FOLDER
        place.mkdir()
        for name, content in self.files:
            write_bytes(place / Path(name).name, content)
        return place / Path(self.files[0][0]).name


def model_files(pem: str) -> ModelFiles:
    """The files that ``pem`` of a configuration names: the model, its ensemble beside it.

    Raises:
        InputError: They cannot be read.
    """
    if pem in shipped_pems():
        return ModelFiles()
    path = Path(pem)
    partner = path.with_name(f"{path.stem.removesuffix(ENSEMBLE_ENDING)}{ENSEMBLE_ENDING}{SUFFIX}")
    try:
        files = [(path.name, path.read_bytes())]
        if partner != path and path.suffix == SUFFIX and partner.is_file():
            files.append((partner.name, partner.read_bytes()))
    except OSError as error:
        message = f"pem = {pem!r}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error
    return ModelFiles(tuple(files))
