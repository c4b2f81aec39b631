"""A small TOML that says where the columns of somebody's log are: names, units, constants.

A log has a row for each obstacle at each moment, with what a detector made of it; in one file, or
in two whose rows belong together. The mapping names, for each column of the table that models learn
from, a column of the log or a number::

    [labels]                              # and [detections], for the second file
    separator = ","                       # the default; or ";", "tab", "whitespace"
    header = ["t", "x", "y"]              # only where the file has no header line

    [columns]
    class_id = 0                          # a number: the same in every row
    x_m = "lateral"                       # a column
    z_m = { column = "range_cm", times = 0.01, plus = -1.5 }
    occlusion = { column = "visible", values = { full = 0, part = 1 } }

Needed are the salient variables of ``pemviz.pem.SALIENT_COLUMNS`` (without ``alpha_rad`` it follows
from place and rotation) and ``detected``. ``x_error_m`` and ``z_error_m`` count where detected;
``sequence``, ``frame``, ``track`` and ``rate_hz`` make a table of tracks of it.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pemviz.config.records import read_record
from pemviz.errors import ConfigError, PemError
from pemviz.pem.data.position_errors import PLANE_COLUMNS, TRACK_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN
from pemviz.pem.models.protocol import SALIENT_COLUMNS

Separator = Literal[",", ";", "tab", "whitespace"]
SEPARATORS: Mapping[Separator, str | None] = {",": ",", ";": ";", "tab": "\t", "whitespace": None}
ALPHA = "alpha_rad"
NEEDED = (*(name for name in SALIENT_COLUMNS if name != ALPHA), OUTCOME_COLUMN)
KNOWN = (*NEEDED, ALPHA, *PLANE_COLUMNS, *TRACK_COLUMNS)
LARGEST_BYTES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class FileShape:
    """How one file of a log is written."""

    separator: Separator = ","
    """Between columns."""
    header: tuple[str, ...] = ()
    """Names of the columns where the file itself has none."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a column's values come from: times * value + plus."""

    column: str
    """Of the log."""
    times: float = 1.0
    """For other units, or the other direction."""
    plus: float = 0.0
    """In the table's unit."""
    values: Mapping[str, float] = field(default_factory=dict[str, float])
    """What stands for each text; numbers are read as they are without it."""


@dataclass(frozen=True)
class ColumnMapping:
    """A log's columns.

    Attributes:
        labels: How the first file is written.
        detections: How the second one is.
        columns: For each column of the table: from where, or a constant.
    """

    labels: FileShape
    detections: FileShape
    columns: Mapping[str, Source | float]


def read_mapping(path: Path) -> ColumnMapping:
    """Read a mapping.

    Raises:
        PemError: it cannot be read, or a line of it says what, where and what is allowed.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES)
        table = tomllib.loads(content.decode("utf-8"))
        unknown = set(table) - {"labels", "detections", "columns"}
        if unknown:
            message = f"{min(unknown)}: must be labels, detections or columns"
            raise ConfigError(message)
        columns = _columns(table.get("columns"))
        shapes = [
            read_record(FileShape, table.get(name, {}), name=name)
            for name in ("labels", "detections")
        ]
    except OSError as error:
        raise PemError(f"mapping {path}: cannot be read ({error.strerror or error})") from None
    except (ConfigError, ValueError, RecursionError) as error:
        raise PemError(f"mapping {path}: {error}") from None
    return ColumnMapping(labels=shapes[0], detections=shapes[1], columns=columns)


def _columns(given: object) -> Mapping[str, Source | float]:
    """The sources by column.

    Raises:
        ConfigError: One is unknown or malformed, or some are missing.
    """
    table: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
    missing = [name for name in NEEDED if name not in table]
    if missing:
        message = f"columns: lacks {', '.join(missing)}"
        raise ConfigError(message)
    found: dict[str, Source | float] = {}
    for name, value in table.items():
        if name not in KNOWN:
            message = f"columns.{name}: must be one of {', '.join(KNOWN)}"
            raise ConfigError(message)
        if isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = float(value)
        else:
            source = {"column": value} if isinstance(value, str) else value
            found[name] = read_record(Source, source, name=f"columns.{name}")
    tracked = [name for name in TRACK_COLUMNS if name in found]
    if tracked and len(tracked) < len(TRACK_COLUMNS):
        message = f"columns: of {', '.join(TRACK_COLUMNS)} all or none, here {', '.join(tracked)}"
        raise ConfigError(message)
    return found
