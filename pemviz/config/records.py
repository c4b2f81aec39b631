"""Records: frozen dataclasses read from the plain values of a TOML or JSON file.

What a record may hold is stated once, by the annotations of its fields: ``bool``, ``int``,
``float``, ``str``, a ``Literal``, numbers with a :class:`~pemviz.config.ranges.Range`, names of
a :class:`~pemviz.config.ranges.NamedPart`, other records, ``tuple[X, ...]``,
``Mapping[str, X]``, and any of these ``| None``.
"""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pemviz.config.ranges import allows_none, checker, optional_value, shown
from pemviz.errors import ConfigError

Record = TypeVar("Record")
_Reader = Callable[[object], Any]
LONGEST_NAME = 200
"""Characters of a field's name in a message."""


class _UnfitError(Exception):
    """A value does not fit; the names of what it lies in are put before it on the way out."""

    def __init__(self, words: str, name: str = "") -> None:
        super().__init__(words)
        self.words = words
        self.name = name

    def inside(self, name: str | int) -> "_UnfitError":
        """The same, seen from what has the value under ``name``, or in a place of a list."""
        joint = "." if self.name and not self.name.startswith("[") else ""
        place = name if isinstance(name, str) else f"[{name}]"
        return _UnfitError(self.words, f"{place}{joint}{self.name}")


def read_record(
    kind: type[Record], table: object, *, name: str = "", ignore_unknown: bool = False
) -> Record:
    """The record of type ``kind`` that a table of plain values spells out.

    A field with a default may be left out. What is a record already is taken as it is.

    Args:
        kind: A dataclass.
        table: Its values by field; lists for tuples.
        name: What the table is called, for messages.
        ignore_unknown: Whether the table may hold more than the record has fields.

    Raises:
        ConfigError: One line that names the field and what is allowed.
    """
    return cast(Record, read_value(kind, table, name=name, ignore_unknown=ignore_unknown))


def read_value(
    annotation: object, value: object, *, name: str, ignore_unknown: bool = False
) -> Any:
    """A plain value as a field annotated with ``annotation`` holds it.

    Raises:
        ConfigError: As for :func:`read_record`.
    """
    try:
        return _reader(annotation, ignore_unknown)(value)
    except _UnfitError as error:
        place = error.inside(name).name if name else error.name
        if len(place) > LONGEST_NAME:  # given by a file
            place = f"{place[:LONGEST_NAME]}..."
        raise ConfigError(f"{place}{error.words}") from None


@cache
def _reader(annotation: Any, ignore_unknown: bool) -> _Reader:
    """What reads values of one annotation, put together once."""
    origin = get_origin(annotation)
    if origin in (Union, UnionType):
        if not allows_none(annotation) or len(get_args(annotation)) > 2:
            raise TypeError(f"{annotation}: a field has one type, None aside")
        inner = _reader(optional_value(annotation), ignore_unknown)
        return lambda value: None if value is None else inner(value)
    if is_dataclass(annotation):
        return _record_reader(cast(type[Any], annotation), ignore_unknown)
    if origin is tuple:
        return _tuple_reader(_reader(get_args(annotation)[0], ignore_unknown))
    if origin is Mapping:
        return _mapping_reader(_reader(get_args(annotation)[1], ignore_unknown))
    return _plain_reader(annotation)


def _plain_reader(annotation: object) -> _Reader:
    base = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    check = checker(annotation)

    def read(value: Any) -> object:
        complaint = check(value)
        if complaint is not None:
            raise _unfit(value, complaint)
        return float(value) if base is float else value

    return read


def _inside(name: str | int, read: _Reader, value: object) -> Any:
    try:
        return read(value)
    except _UnfitError as error:
        raise error.inside(name) from None


def _tuple_reader(entry: _Reader) -> _Reader:
    def read(value: object) -> object:
        if not isinstance(value, list | tuple):
            raise _unfit(value, "must be a list")
        items = enumerate(cast(list[object], value))
        return tuple([_inside(index, entry, item) for index, item in items])

    return read


def _mapping_reader(entry: _Reader) -> _Reader:
    check_name = checker(str)

    def read(value: object) -> object:
        table = _table(value)
        for key in table:
            if check_name(key) is not None:
                raise _unfit(key, "must be a name")
        return {key: _inside(key, entry, item) for key, item in table.items()}

    return read


def _record_reader(kind: type[Any], ignore_unknown: bool) -> _Reader:
    hints = get_type_hints(kind, include_extras=True)
    readers = {field.name: _reader(hints[field.name], ignore_unknown) for field in fields(kind)}
    required = [
        field.name
        for field in fields(kind)
        if field.default is MISSING and field.default_factory is MISSING
    ]

    def read(value: object) -> object:
        if isinstance(value, kind):
            return value
        table = _table(value)
        values: dict[str, object] = {}
        for name, item in table.items():
            if name in readers:
                values[name] = _inside(name, readers[name], item)
            elif not ignore_unknown:
                near = difflib.get_close_matches(name, readers, n=1)
                known = f"allowed are {', '.join(sorted(readers))}"
                hint = f"did you mean {near[0]}?" if near else known
                raise _UnfitError(f": no such field; {hint}", name)
        for name in required:
            if name not in values:
                raise _UnfitError(": is missing", name)
        return kind(**values)

    return read


def _table(value: object) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise _unfit(value, "must be a table")
    return cast(Mapping[str, object], value)


def _unfit(value: object, complaint: str) -> _UnfitError:
    return _UnfitError(f" = {shown(value)}: {complaint}")
