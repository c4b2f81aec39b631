"""Finding a model by the name or path that a user gives."""

from pathlib import Path

from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.shipped import asset_path
from pemviz.pem.files.model_files import load_file
from pemviz.pem.models.protocol import Pem, PemEnsemble
from pemviz.pem.models.python_object import is_object_name, load_object
from pemviz.pem.models.tabulated import load_csv

ASSET_FOLDER = "pem"
SUFFIX = ".safetensors"
ENSEMBLE_ENDING = "-ensemble"


def shipped_pems() -> tuple[str, ...]:
    """Names of the models that come with pemviz."""
    return tuple(sorted(path.stem for path in asset_path(ASSET_FOLDER).glob(f"*{SUFFIX}")))


def load_pem(name_or_path: str, *, allow_python: bool = False) -> Pem:
    """Load a shipped model by name, a model file by path, or an allowed Python object.

    Args:
        name_or_path: a name of shipped_pems(); or a path to ``.safetensors`` (ours or the
            authors' format) or ``.csv`` (columns distance_m and p_detected); or, if allowed,
            ``module:attribute``.
        allow_python: whether code of the user's may run.

    Raises:
        PemError: no such model, or a file that cannot be used; one line says why.
    """
    if name_or_path in shipped_pems():
        return load_file(asset_path(ASSET_FOLDER, f"{name_or_path}{SUFFIX}"))
    path = Path(name_or_path)
    if path.suffix == SUFFIX:
        return load_file(path)
    if path.suffix == ".csv":
        return load_csv(path)
    if is_object_name(name_or_path):
        return load_object(name_or_path, allowed=allow_python)
    if is_file(path):
        raise PemError(f"{path}: not a {SUFFIX} or .csv file; torch and pickle files are refused")
    raise PemError(
        f"no perception error model {name_or_path!r}; give one of {', '.join(shipped_pems())}, "
        f"a path to {SUFFIX} or .csv, or an allowed module:attribute"
    )


def load_ensemble(name_or_path: str) -> PemEnsemble:
    """Load an ensemble by shipped name or path.

    Raises:
        PemError: no such model, or it is no ensemble.
    """
    pem = load_pem(name_or_path)
    if not isinstance(pem, PemEnsemble):
        raise PemError(f"{name_or_path!r} is a single model, not an ensemble")
    return pem


def ensemble_of(name_or_path: str) -> PemEnsemble | None:
    """The ensemble that says how uncertain a model is, if there is one.

    For a shipped ``ml-nn`` that is the shipped ``ml-nn-ensemble``, for a file ``own.safetensors``
    the file ``own-ensemble.safetensors`` beside it; an ensemble is its own.

    Raises:
        PemError: the ensemble is there but cannot be used.
    """
    if name_or_path in shipped_pems():
        partner = f"{name_or_path.removesuffix(ENSEMBLE_ENDING)}{ENSEMBLE_ENDING}"
        return load_ensemble(partner) if partner in shipped_pems() else None
    path = Path(name_or_path)
    if path.suffix != SUFFIX or not is_file(path):
        return None
    partner_path = path.with_name(f"{path.stem.removesuffix(ENSEMBLE_ENDING)}{ENSEMBLE_ENDING}")
    partner_path = partner_path.with_suffix(SUFFIX)
    if is_file(partner_path):
        return load_ensemble(str(partner_path))
    pem = load_pem(name_or_path)
    return pem if isinstance(pem, PemEnsemble) else None
