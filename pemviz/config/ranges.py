"""Allowed ranges of configuration values, declared where the fields are declared."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pemviz.config.entry_points import NamedPart
from pemviz.errors import ConfigError


@dataclass(frozen=True)
class Range:
    """An interval of allowed numbers; a ``None`` bound is open to infinity."""

    low: float | None = None
    high: float | None = None
    low_open: bool = False
    high_open: bool = False

    def contains(self, value: float) -> bool:
        """Whether the finite number ``value`` lies in the interval."""
        if not is_finite(value):
            return False
        if self.low is not None and (value < self.low or (self.low_open and value == self.low)):
            return False
        return not (
            self.high is not None and (value > self.high or (self.high_open and value == self.high))
        )

    def __str__(self) -> str:
        """The interval in words, as error messages and help texts quote it."""
        parts: list[str] = []
        if self.low is not None:
            parts.append(f"{'above' if self.low_open else 'at least'} {self.low:g}")
        if self.high is not None:
            parts.append(f"{'below' if self.high_open else 'at most'} {self.high:g}")
        return " and ".join(parts) or "any finite number"


def is_finite(value: float) -> bool:
    """Whether ``value`` is a finite float64; a whole number may be too large for one."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def allowed_text(annotation: object) -> str:
    """What values a field annotated with ``annotation`` accepts, in words."""
    if get_origin(annotation) is Annotated:
        base, *extras = get_args(annotation)
        for extra in extras:
            if isinstance(extra, NamedPart):
                return "one of " + ", ".join(extra.names())
        ranges = [extra for extra in extras if isinstance(extra, Range)]
        kind = allowed_text(base)
        return f"{kind}, {ranges[0]}" if ranges else kind
    if get_origin(annotation) is Literal:
        return "one of " + ", ".join(str(choice) for choice in get_args(annotation))
    if get_origin(annotation) in (Union, UnionType):
        kinds = [arm for arm in get_args(annotation) if arm is not type(None)]
        return " or ".join(allowed_text(kind) for kind in kinds)
    names = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}
    return names.get(annotation, str(annotation)) if isinstance(annotation, type) else "a value"


def check_value(*, name: str, value: object, annotation: object) -> object:
    """``value`` converted to the annotated type (only int to float is converted).

    Raises:
        ConfigError: The type is wrong, the number lies outside its range, or there is no part
            of that name.
    """
    kind, limits = _unpack(annotation)
    fits = (
        value in get_args(kind)
        if get_origin(kind) is Literal
        else _is_a(value, kind) and (limits is None or limits.contains(_number(value)))
    )
    if not fits:
        message = f"{name} = {_shown(value)}: must be {allowed_text(annotation)}"
        raise ConfigError(message)
    for part in get_args(annotation)[1:]:
        complaint = part.complaint(value) if isinstance(part, NamedPart) else None
        if complaint is not None:
            message = f"{name} = {_shown(value)}: {complaint}"
            raise ConfigError(message)
    return float(_number(value)) if kind is float else value


def check_fields(instance: Any, *, prefix: str = "") -> None:
    """Check every field of a dataclass, nested dataclasses included.

    Raises:
        ConfigError: Naming the first field that is out of range, with what is allowed.
    """
    for name, value, annotation in _annotated_fields(instance):
        if is_dataclass(value):
            check_fields(value, prefix=f"{prefix}{name}.")
        elif value is not None or not allows_none(annotation):
            check_value(name=f"{prefix}{name}", value=value, annotation=optional_value(annotation))


def optional_value(annotation: object) -> object:
    """The annotation of the value itself, where ``None`` is allowed beside it."""
    if not allows_none(annotation):
        return annotation
    return next(arm for arm in get_args(annotation) if arm is not type(None))


def _annotated_fields(instance: Any) -> Iterator[tuple[str, object, object]]:
    hints = get_type_hints(type(instance), include_extras=True)
    for field in fields(instance):
        yield field.name, getattr(instance, field.name), hints[field.name]


def _unpack(annotation: object) -> tuple[Any, Range | None]:
    if get_origin(annotation) is Annotated:
        base, *extras = get_args(annotation)
        limits = next((extra for extra in extras if isinstance(extra, Range)), None)
        return base, limits
    return annotation, None


def allows_none(annotation: object) -> bool:
    """Whether ``None`` is allowed beside a value."""
    return type(None) in get_args(annotation)


def _is_a(value: object, kind: type) -> bool:
    if kind in (float, int):
        accepted = (int, float) if kind is float else (int,)
        return isinstance(value, accepted) and not isinstance(value, bool)
    return isinstance(value, kind)


def _number(value: Any) -> float:
    return value


def _shown(value: object) -> str:
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        text = f"({type(value).__name__})"
    limit = 60
    return text if len(text) <= limit else text[: limit - 3] + "..."
