"""Finding a model by the name or path that a user gives."""

from pathlib import Path

from pemviz.assets import asset_path
from pemviz.pem.errors import PemError
from pemviz.pem.files import load_file
from pemviz.pem.protocol import Pem

ASSET_FOLDER = "pem"
SUFFIX = ".safetensors"


def shipped_pems() -> tuple[str, ...]:
    """Names of the models that come with pemviz."""
    return tuple(sorted(path.stem for path in asset_path(ASSET_FOLDER).glob(f"*{SUFFIX}")))


def load_pem(name_or_path: str) -> Pem:
    """Load a shipped model by name, or a model file by path.

    Args:
        name_or_path: a name of shipped_pems(), or a path to ``.safetensors`` (ours or the
            authors' format).

    Raises:
        PemError: no such model, or a file that cannot be used; one line says why.
    """
    if name_or_path in shipped_pems():
        return load_file(asset_path(ASSET_FOLDER, f"{name_or_path}{SUFFIX}"))
    path = Path(name_or_path)
    if path.suffix == SUFFIX:
        return load_file(path)
    raise PemError(
        f"no perception error model {name_or_path!r}; give one of {', '.join(shipped_pems())} "
        f"or a path to a {SUFFIX} file"
    )
