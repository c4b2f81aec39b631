"""Allowed ranges of numbers, declared where the fields are declared."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin, get_type_hints

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


Count = Annotated[int, Range(low=0, high=2**53)]
"""How many of something: no more than a float64 tells apart."""
StepIndex = Annotated[int, Range(low=0, high=2**31 - 1)]
"""A step of a rollout, from 0; few enough that each has a time of its own in float64."""
AtLeastZero = Annotated[float, Range(low=0.0)]
Share = Annotated[float, Range(low=0.0, high=1.0 + 1e-9)]
"""A part of a whole, or a probability; a sum of many may be rounded to a little above 1."""
Confidence = Annotated[float, Range(low=0.0, low_open=True, high=1.0, high_open=True)]
Log10 = Annotated[float, Range(high=300.0)]
"""Decimal logarithm of what is a probability but for its error, so that its power is a float64."""


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


@cache
def checker(annotation: object) -> Callable[[object], str | None]:
    """Tells what is wrong with a value, not ``None``, of a field annotated with ``annotation``.

    In words that say what is allowed; ``None`` if nothing is wrong.
    """
    fits = _type_checker(annotation)
    parts = [extra for extra in get_args(annotation)[1:] if isinstance(extra, NamedPart)]

    def check(value: object) -> str | None:
        if not fits(value):
            return f"must be {allowed_text(annotation)}"
        return parts[0].complaint(value) if parts else None

    return check


def _type_checker(annotation: object) -> Callable[[object], bool]:
    """Tells whether a value is of the annotated type and range."""
    kind, limits = _unpack(annotation)
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        return lambda value: value in choices
    if kind is str:
        return _is_text
    types = (int, float) if kind is float else (kind,)
    numeric = kind in (int, float)

    def fits(value: object) -> bool:
        if not isinstance(value, types) or (numeric and isinstance(value, bool)):
            return False
        return limits is None or limits.contains(_number(value))

    return fits


def check_value(*, name: str, value: object, annotation: object) -> object:
    """``value`` converted to the annotated type (only int to float is converted).

    Raises:
        ConfigError: The type is wrong, the number lies outside its range, or there is no part
            of that name.
    """
    complaint = checker(annotation)(value)
    if complaint is not None:
        message = f"{name} = {shown(value)}: {complaint}"
        raise ConfigError(message)
    return float(_number(value)) if _unpack(annotation)[0] is float else value


def check_fields(instance: Any, *, prefix: str = "") -> None:
    """Check every field of a dataclass, nested dataclasses included.

    Raises:
        ConfigError: Naming the first field that is out of range, with what is allowed.
    """
    for name, value, annotation in _annotated_fields(instance):
        if is_dataclass(value):
            check_fields(value, prefix=f"{prefix}{name}.")
        elif get_origin(annotation) is tuple:
            _check_records(value, name=f"{prefix}{name}", kind=get_args(annotation)[0])
        elif value is not None or not allows_none(annotation):
            check_value(name=f"{prefix}{name}", value=value, annotation=optional_value(annotation))


def _check_records(values: Any, *, name: str, kind: Any) -> None:
    if not isinstance(values, tuple):
        message = f"{name} = {shown(values)}: must be a tuple"
        raise ConfigError(message)
    for index, value in enumerate(cast(tuple[object, ...], values)):
        if not isinstance(value, kind):
            message = f"{name}[{index}] = {shown(value)}: must be a {kind.__name__}"
            raise ConfigError(message)
        check_fields(value, prefix=f"{name}[{index}].")


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


def _is_text(value: object) -> bool:
    """Whether ``value`` is a text that files can hold: no half of a surrogate pair alone."""
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def _number(value: Any) -> float:
    return value


def shown(value: object) -> str:
    """``value`` in at most sixty characters, whatever it is."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        text = f"({type(value).__name__})"
    limit = 60
    return text if len(text) <= limit else text[: limit - 3] + "..."
