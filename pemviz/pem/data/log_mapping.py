"""Where the columns of somebody's own log are: a small TOML.

It names, for each column of the table that models learn from, a column of the log or a number::

    [labels]                              # and [detections], for the second file
    separator = ","                       # the default; or ";", "tab", "whitespace"
    header = ["t", "x", "y"]              # only where the file has no header line

    [columns]
    class_id = 0                          # a number: the same in every row
    x_m = "lateral"                       # a column
    z_m = { column = "range_cm", unit = "cm", plus = -1.5 }
    y_m = { column = "up", times = -1 }
    occlusion = { column = "visible", values = { full = 0, part = 1 } }

Needed are the salient variables of ``pemviz.pem.SALIENT_COLUMNS`` (without ``alpha_rad`` it follows
from place and rotation) and ``detected``. ``x_error_m`` and ``z_error_m`` count where detected;
``sequence`` and ``track``, with ``frame`` and ``rate_hz`` or with ``time_s``, make a table of
tracks of it.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pemviz.config.records import read_record
from pemviz.errors import ConfigError, PemError
from pemviz.pem.data.log_batches import FileShape
from pemviz.pem.data.position_errors import PLANE_COLUMNS
from pemviz.pem.data.table import OUTCOME_COLUMN, RATE_COLUMN, TIME_COLUMN
from pemviz.pem.data.units import Unit, unit_factor
from pemviz.pem.models.protocol import SALIENT_COLUMNS

ALPHA = "alpha_rad"
NEEDED = (*(name for name in SALIENT_COLUMNS if name != ALPHA), OUTCOME_COLUMN)
NAMES = ("sequence", "track")
"""Columns whose texts are kept."""
MOMENTS = ("frame", RATE_COLUMN, TIME_COLUMN)
KNOWN = (*NEEDED, ALPHA, *PLANE_COLUMNS, *NAMES, *MOMENTS)
LARGEST_BYTES = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a column's values come from: times * value + plus."""

    column: str
    unit: Unit | None = None
    """Of the log's values, which are converted to the table's."""
    times: float = 1.0
    """For other scales, or the other direction; after the unit."""
    plus: float = 0.0
    """In the table's unit."""
    values: Mapping[str, float] = field(default_factory=dict[str, float])
    """What stands for each text; numbers are read as they are without it."""


@dataclass(frozen=True)
class ColumnMapping:
    """How the files of a log are written, and where each column of the table is from."""

    labels: FileShape
    detections: FileShape
    columns: Mapping[str, Source | float]

    @property
    def wanted(self) -> set[str]:
        """Columns of the log that are read."""
        return {one.column for one in self.columns.values() if isinstance(one, Source)}

    @property
    def written(self) -> tuple[str, ...]:
        """Columns of the table, in order."""
        order = (*NAMES, *MOMENTS, *SALIENT_COLUMNS, OUTCOME_COLUMN, *PLANE_COLUMNS)
        return tuple(name for name in order if name in self.columns or name == ALPHA)


def read_mapping(path: Path) -> ColumnMapping:
    """Read a mapping.

    Raises:
        PemError: it cannot be read, or a line of it says what, where and what is allowed.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES)
        table = tomllib.loads(content.decode("utf-8-sig"))
        if unknown := set(table) - {"labels", "detections", "columns"}:
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
    table: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
    if missing := [name for name in NEEDED if name not in table]:
        message = f"columns: lacks {', '.join(missing)}"
        raise ConfigError(message)
    found: dict[str, Source | float] = {}
    for name, value in table.items():
        if name not in KNOWN:
            message = f"columns.{name}: must be one of {', '.join(KNOWN)}"
            raise ConfigError(message)
        if isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = float(value)
            continue
        source = {"column": value} if isinstance(value, str) else value
        one = read_record(Source, source, name=f"columns.{name}")
        if one.unit is not None:
            unit_factor(one.unit, name, where=f"columns.{name}")
        found[name] = one
    _check_tracks(found)
    return found


def _check_tracks(columns: Mapping[str, object]) -> None:
    tracked = [name for name in (*NAMES, *MOMENTS) if name in columns]
    is_whole = set(NAMES) <= set(tracked) and (
        TIME_COLUMN in tracked or {"frame", RATE_COLUMN} <= set(tracked)
    )
    if tracked and not is_whole:
        message = (
            f"columns: of {', '.join(NAMES)}, frame, {RATE_COLUMN} all or none ({TIME_COLUMN} may "
            f"stand for the last two), here {', '.join(tracked)}"
        )
        raise ConfigError(message)
