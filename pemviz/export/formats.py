"""The formats that a rollout can be written in, and writing it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from pemviz.errors import InputError
from pemviz.export.rollout import RankedRollout
from pemviz.export.table import csv_bytes, parquet_bytes
from pemviz.files.atomic import is_file, is_folder, write_bytes

Format = Literal["openscenario", "commonroad", "csv", "parquet"]
INSTALL = "pip install 'pemviz[export]'"


@dataclass(frozen=True)
class FileFormat:
    """How a format is written.

    Attributes:
        endings: Of its files' names; the first is what the other ones belong to.
        contents: A file for each ending, of a rollout and the name that the files share.
        module: What must be installed beside pemviz.
        package: The package that brings it.
    """

    endings: tuple[str, ...]
    contents: Callable[[RankedRollout, str], tuple[bytes, ...]]
    module: str | None = None
    package: str | None = None

    def check_installed(self, name: str) -> None:
        """Refuse what needs a package that is not there.

        Raises:
            InputError: Says how to install it.
        """
        if self.module is not None and find_spec(self.module) is None:
            message = f"format = {name}: needs {self.package}; install it with {INSTALL}"
            raise InputError(message)


def _openscenario(rollout: RankedRollout, name: str) -> tuple[bytes, ...]:
    from pemviz.export.openscenario import openscenario_files  # noqa: PLC0415  an extra

    return openscenario_files(rollout, road_file=f"{name}.xodr")


def _commonroad(rollout: RankedRollout, name: str) -> tuple[bytes, ...]:  # noqa: ARG001
    from pemviz.export.commonroad import commonroad_bytes  # noqa: PLC0415  an extra

    return (commonroad_bytes(rollout),)


FORMATS: Mapping[Format, FileFormat] = {
    "openscenario": FileFormat(
        (".xosc", ".xodr"), _openscenario, module="scenariogeneration", package="scenariogeneration"
    ),
    "commonroad": FileFormat((".xml",), _commonroad, module="commonroad", package="commonroad-io"),
    "csv": FileFormat((".csv",), lambda rollout, _: (csv_bytes(rollout),)),
    "parquet": FileFormat((".parquet",), lambda rollout, _: (parquet_bytes(rollout),)),
}


def check_place(out: Path, *, form: Format, force: bool) -> tuple[Path, ...]:
    """Where a format's files go, if they may go there.

    Args:
        out: The first file.
        form: The format.
        force: Whether files that are there are replaced.

    Raises:
        InputError: They may not.
    """
    first, *others = FORMATS[form].endings
    if out.suffix == "" or out.suffix in others:
        message = f"out = {out}: must be a file name with an ending, as {out.stem}{first}"
        raise InputError(message)
    if not is_folder(out.parent):
        message = f"out = {out}: must lie in a folder that exists"
        raise InputError(message)
    paths = (out, *(out.with_suffix(ending) for ending in others))
    for path in paths:
        if is_folder(path):
            message = f"out = {path}: must be a file, is a folder"
            raise InputError(message)
        if is_file(path) and not force:
            message = f"out = {path}: is there already; --force replaces it"
            raise InputError(message)
    return paths


def write_rollout(rollout: RankedRollout, paths: tuple[Path, ...], *, form: Format) -> None:
    """Write a rollout; each file is whole or not there.

    Args:
        rollout: Which.
        paths: Of :func:`check_place`.
        form: The format.

    Raises:
        InputError: The format cannot tell of this rollout, or a file cannot be written.
    """
    contents = FORMATS[form].contents(rollout, paths[0].stem)
    for path, content in reversed(tuple(zip(paths, contents, strict=True))):
        try:
            write_bytes(path, content)
        except OSError as error:
            message = f"out = {path}: cannot be written ({error.strerror or error})"
            raise InputError(message) from error
