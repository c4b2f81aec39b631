"""The fields of a configuration by dotted name, and values for them as a command line has them."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

from pemviz.config import ExperimentConfig
from pemviz.config.ranges import allows_none, check_value, optional_value
from pemviz.errors import ConfigError

Value = str | int | float | bool | None
Setting = tuple[tuple[str, Value], ...]

BRACKETS = {"(": ")", "[": "]"}
TRUTH = {"true": True, "false": False}


@dataclass(frozen=True)
class Variation:
    """A field and the values that it takes in turn.

    Attributes:
        field: Its dotted name, such as ``scenario.initial_gap_m``.
        values: At least one, all different.
    """

    field: str
    values: tuple[Value, ...]


@cache
def field_annotations() -> Mapping[str, object]:
    """Annotation by dotted name of every field of a configuration that holds one value."""
    return _annotations(ExperimentConfig, prefix="")


def _annotations(kind: Any, *, prefix: str) -> dict[str, object]:
    hints = get_type_hints(kind, include_extras=True)
    found: dict[str, object] = {}
    for field in fields(kind):
        annotation = hints[field.name]
        if is_dataclass(annotation):
            found |= _annotations(annotation, prefix=f"{prefix}{field.name}.")
        elif get_origin(annotation) is not tuple:  # rules and start values have names
            found[f"{prefix}{field.name}"] = annotation
    return found


def value_type(annotation: object) -> type | None:
    """``bool``, ``int``, ``float`` or ``str``; ``None`` for a choice of texts."""
    inner = optional_value(annotation)
    base = get_args(inner)[0] if get_origin(inner) is Annotated else inner
    return base if isinstance(base, type) else None


def parse_variation(text: str) -> Variation:
    """The field and values of ``FIELD=V1,V2,...``.

    A comma inside brackets or double quotes is part of a value.

    Raises:
        ConfigError: There is no such field, or a value is not allowed in it.
    """
    name, equals, listed = text.partition("=")
    name = name.strip().replace("-", "_")
    if not equals or not name:
        message = f"vary {text!r}: must be FIELD=VALUE,VALUE,..."
        raise ConfigError(message)
    annotation = _annotation(name)
    values: list[Value] = []
    for one in split_values(listed, where=f"vary {name}"):
        value = _parse(one, name=name, annotation=annotation)
        if value in values:
            message = f"vary {name}: {one} is given twice"
            raise ConfigError(message)
        values.append(value)
    return Variation(field=name, values=tuple(values))


def split_values(listed: str, *, where: str) -> list[str]:
    """A list's values, split at commas outside brackets and double quotes.

    Raises:
        ConfigError: A value is empty, or brackets or quotes do not close.
    """
    values = [""]
    closing: list[str] = []
    for character in listed:
        if closing and character == closing[-1]:
            closing.pop()
        elif character == '"' and not closing:
            closing.append('"')
        elif character in BRACKETS and '"' not in closing:
            closing.append(BRACKETS[character])
        elif character == "," and not closing:
            values.append("")
            continue
        values[-1] += character
    if closing:
        message = f"{where}: a {closing[-1]} is missing in {listed!r}"
        raise ConfigError(message)
    stripped = [_unquoted(value.strip()) for value in values]
    if "" in stripped:
        message = f"{where}: a value is empty in {listed!r}"
        raise ConfigError(message)
    return stripped


def with_setting(config: ExperimentConfig, setting: Setting) -> ExperimentConfig:
    """The configuration with these fields replaced; ranges are not checked."""
    for name, value in setting:
        config = _replaced(config, name.split("."), value)
    return config


def _replaced(instance: Any, path: list[str], value: Value) -> Any:
    name, *below = path
    inner = _replaced(getattr(instance, name), below, value) if below else value
    return replace(instance, **{name: inner})


def _annotation(name: str) -> object:
    annotations = field_annotations()
    if name in annotations:
        return annotations[name]
    tables = {one.partition(".")[0] for one in annotations if "." in one}
    if name in tables:
        example = next(one for one in annotations if one.startswith(f"{name}."))
        message = f"vary {name}: is a table; vary one of its fields, such as {example}"
        raise ConfigError(message)
    raise ConfigError(_unknown(name, list(annotations)))


def _unknown(name: str, known: list[str]) -> str:
    by_last_part = {one.rpartition(".")[2]: one for one in known}
    candidates = [*known, *by_last_part]
    near = difflib.get_close_matches(name, candidates, n=1)
    if near:
        return f"vary {name}: no such field; did you mean {by_last_part.get(near[0], near[0])}?"
    return f"vary {name}: no such field; allowed are {', '.join(known)}"


def _parse(text: str, *, name: str, annotation: object) -> Value:
    if allows_none(annotation) and text.lower() == "none":
        return None
    inner = optional_value(annotation)
    value = _converted(text, value_type(annotation))
    return cast(Value, check_value(name=f"vary {name}", value=value, annotation=inner))


def _converted(text: str, kind: type | None) -> Value:
    """``text`` as ``kind``, or as it is where it cannot be read so."""
    if kind is bool:
        return TRUTH.get(text.lower(), text)
    if kind not in (int, float):
        return text
    try:
        if kind is int and not any(mark in text.lower() for mark in ".e"):
            return int(text)
        number = float(text)
    except ValueError:
        return text
    return int(number) if kind is int and number.is_integer() else number


def _unquoted(text: str) -> str:
    quoted = len(text) >= 2 and text[0] == text[-1] == '"' and '"' not in text[1:-1]
    return text[1:-1] if quoted else text
