"""Where the shipped files (models, presets, sample run) lie, in a checkout and in a wheel."""

from importlib import resources
from pathlib import Path

from pemviz.errors import InputError


def asset_root() -> Path:
    """The folder of shipped files: the wheel's copy if there is one, else the checkout's.

    Raises:
        InputError: neither exists, as in a partial copy of the package.
    """
    places = _places("_assets", "assets")
    for candidate in places:
        if candidate.is_dir():
            return candidate
    raise InputError(f"shipped files not found: neither {' nor '.join(map(str, places))} is there")


def asset_path(*parts: str) -> Path:
    """Path of a shipped file or folder, for example ``asset_path("pem", "ml-nn.safetensors")``.

    Raises:
        InputError: no such file is shipped; the message lists what is there.
    """
    root = asset_root()
    path = root.joinpath(*parts)
    if root not in (path.resolve(), *path.resolve().parents):
        raise InputError(f"{'/'.join(parts)!r} leaves the folder of shipped files")
    if not path.exists():
        raise InputError(f"no shipped file {'/'.join(parts)!r}; there are: {_listing(root, parts)}")
    return path


def sample_run() -> Path | None:
    """The run folder of the shipped sample; ``None`` if it is not there."""
    runs = _places("_sample", "recordings/sample")
    return next((folder for folder in runs if (folder / "result.json").is_file()), None)


def _places(installed: str, checkout: str) -> tuple[Path, Path]:
    """Where something lies in an installed wheel and in a checkout, the first of which counts."""
    package = Path(str(resources.files("pemviz")))
    return package / installed, Path(__file__).resolve().parents[2] / checkout


def _listing(root: Path, parts: tuple[str, ...]) -> str:
    folder = root
    for part in parts[:-1]:
        if not (folder / part).is_dir():
            break
        folder = folder / part
    return ", ".join(sorted(entry.name for entry in folder.iterdir())) or "none"
