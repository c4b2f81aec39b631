"""The formats that a rollout can be written in, and writing it; tables are written here.

A table has a row for each state: CSV for people, Parquet for programs. Columns: which rollout it is
(``run_id`` to ``violated``, and ``broken.NAME`` for each rule), the same in all rows, so that
tables of several rollouts can be put below each other; ``step``; ``time_s`` of the shipped braking
scenario and of simulators of the user's own; each signal under its key; the outcome at that step,
``detected``, with its log likelihoods ``log_p`` under the error model and ``log_q`` under what it
was sampled from [nats]. Of several slots each has these three, ``detected.NAME``. Of a scenario
with latents each one, ``latents.start.0``, and the mean that it was sampled with,
``latents.start_mean.0``; those at the start are the same in all rows, with what the start adds to
the log weight, ``latents.start_log_weight`` [nats]; of noise also how likely it was to be moved,
``latents.noise_share``, and its spread, mean and share where it was to be narrow.
At the last state perception does not act: what belongs to a step is empty there.
"""

import csv
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.errors import InputError
from pemviz.files.atomic import is_file, is_folder, write_bytes
from pemviz.runs.kept_rollout import PER_OUTCOME, KeptRollout

Format = Literal["openscenario", "commonroad", "csv", "parquet"]
INSTALL = "pip install 'pemviz[export]'"
SHARES = "noise_share", "noise_narrow_share"
"""One for all latents of a step."""
METADATA = b"pemviz"
"""Key of a Parquet file's metadata under which the run's settings stand as JSON."""


def columns(rollout: KeptRollout) -> dict[str, list[Any]]:
    """The table's columns, ``T`` values each; ``None`` where there is none."""
    states = rollout.states
    same: dict[str, Any] = {
        "run_id": rollout.result.run_id,
        "rank": rollout.rank,
        "repetition": rollout.repetition,
        "stage": rollout.stage,
        "rollout": rollout.rollout,
        "robustness": rollout.robustness,
        "violated": rollout.violated,
        **{f"broken.{name}": broken for name, broken in rollout.broken.items()},
    }
    table: dict[str, list[Any]] = {name: [value] * states for name, value in same.items()}
    table["step"] = list(range(states))
    timed = rollout.scenario or rollout.result.simulator
    if timed is not None:
        table["time_s"] = (np.arange(states) * timed.dt_s).tolist()
    table |= {name: values.tolist() for name, values in rollout.signals.items()}
    for slot in rollout.detected:
        for name in PER_OUTCOME:
            values: Mapping[str, AnyArray] = getattr(rollout, name)
            table[f"{name}.{slot}" if slot else name] = [*values[slot].tolist(), None]
    for name, latents in rollout.latents.items():
        if name in SHARES:
            table[f"latents.{name}"] = [*latents.tolist(), None]
            continue
        if not latents.ndim:
            table[f"latents.{name}"] = [float(latents)] * states
            continue
        for place in range(latents.shape[-1]):
            own: Any = latents[..., place].tolist()
            cells = [own] * states if latents.ndim == 1 else [*own, None]
            table[f"latents.{name}.{place}"] = cells
    return table


def csv_bytes(rollout: KeptRollout) -> bytes:
    """The table as CSV in UTF-8 with a header; numbers with all their digits."""
    table = columns(rollout)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table)
    writer.writerows([_cell(value) for value in row] for row in zip(*table.values(), strict=True))
    return stream.getvalue().encode("utf-8")


def _cell(value: str | int | float | bool | None) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def parquet_bytes(rollout: KeptRollout) -> bytes:
    """The table as a Parquet file, beside it as JSON what the run was asked for."""
    import pyarrow as pa  # noqa: PLC0415  slow to import
    from pyarrow import parquet  # noqa: PLC0415

    table = pa.table(columns(rollout))
    config, pem, memory = rollout.result.config, rollout.result.pem, rollout.result.memory
    settings = {
        "simulator": config.simulator,
        "spec": config.spec,
        "rules": {rule.name: rule.formula for rule in config.rules},
        "metric": config.metric,
        "method": config.method,
        "pem": pem.name,
        "pem_digest": pem.digest,
        "memory_s": None if memory is None else memory.tau_s,
        "frailty": None if memory is None else memory.frailty,
        "hidden": [] if memory is None else list(memory.hidden),
        "seed": config.seed,
    }
    metadata = {METADATA: json.dumps(settings, ensure_ascii=False).encode("utf-8")}
    stream = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata(metadata), stream)
    return stream.getvalue()


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
    contents: Callable[[KeptRollout, str], tuple[bytes, ...]]
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


def _openscenario(rollout: KeptRollout, name: str) -> tuple[bytes, ...]:
    from pemviz.export.openscenario import openscenario_files  # noqa: PLC0415  an extra

    return openscenario_files(rollout, road_file=f"{name}.xodr")


def _commonroad(rollout: KeptRollout, name: str) -> tuple[bytes, ...]:  # noqa: ARG001
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
    """Where a format's files go, ``out`` the first; ``force`` replaces those that are there.

    Raises:
        InputError: They may not go there.
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


def write_rollout(rollout: KeptRollout, paths: tuple[Path, ...], *, form: Format) -> None:
    """Write a rollout to paths of :func:`check_place`; each file is whole or not there.

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
