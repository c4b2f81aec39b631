"""What a field means and which values it may have, as declared where it is: ranges, names."""

import ast
import difflib
import inspect
import math
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, lru_cache
from importlib import metadata
from itertools import pairwise
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pemviz.errors import ConfigError
from pemviz.faults import exception_text

Kind = TypeVar("Kind", bound=type)


@dataclass(frozen=True)
class Range:
    """An interval of allowed numbers; a ``None`` bound is open to infinity."""

    low: float | None = None
    high: float | None = None
    low_open: bool = False
    high_open: bool = False

    def contains(self, value: float) -> bool:
        """Whether ``value`` is a finite float64 that lies in the interval."""
        try:
            if not math.isfinite(value):
                return False
        except OverflowError:  # a whole number that is too large for one
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
            parts.append(f"{'above' if self.low_open else 'at least'} {_bound(self.low)}")
        if self.high is not None:
            parts.append(f"{'below' if self.high_open else 'at most'} {_bound(self.high)}")
        return " and ".join(parts) or "any finite number"


def _bound(value: float) -> str:
    """A bound as it is read: whole ones in full, up to those of 64 bits."""
    is_long = 1e5 <= abs(value) < 1e19 and value == int(value)
    return f"{int(value):,}" if is_long else f"{value:g}"


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


@dataclass(frozen=True)
class NamedPart:
    """A part of an experiment that is chosen by name: shipped, or registered by packages.

    As an annotation of a text field it says which values the field may have. A package registers
    one in its ``pyproject.toml``, for instance a method::

        [project.entry-points."pemviz.methods"]
        my-method = "my_package.method:DESCRIPTION"

    Attributes:
        kind: What it is, as messages and the configuration name it, e.g. ``method``.
        group: The entry points' group: ``pemviz.`` and the kind in the plural.
        shipped: Names that this package has; they go before registered ones of the same name.
    """

    kind: str
    group: str
    shipped: tuple[str, ...]

    def names(self) -> tuple[str, ...]:
        """All names: shipped ones first, then registered ones in alphabetical order."""
        registered = {point.name for point in metadata.entry_points(group=self.group)}
        return (*self.shipped, *sorted(registered - {*self.shipped}))

    def complaint(self, name: object) -> str | None:
        """What is wrong with a name, and which there are; ``None`` if it is one of them."""
        if name in self.shipped:
            return None
        names = self.names()
        if name in names:
            return None
        near = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
        guess = f"did you mean {near[0]}? There" if near else "there"
        return f"no such {self.kind}; {guess} are: {', '.join(names)}"

    def registered(
        self,
        name: str,
        *,
        made: Callable[[Any], Any],
        fits: Callable[[Any], bool],
        complaint: str,
    ) -> Any:
        """What a package registers under ``name``.

        Args:
            name: Its name.
            made: What the entry point names, to the part itself.
            fits: Whether it is such a part.
            complaint: What to say where it is not, ``{}`` standing for what it is instead.

        Raises:
            ConfigError: There is none, two packages register it, or it cannot be loaded, made
                or used.
        """
        points = {
            point.value: point for point in metadata.entry_points(group=self.group, name=name)
        }
        where = f"{self.kind} = {name!r}"
        if not points:
            raise ConfigError(f"{where}: {self.complaint(name)}")
        if len(points) > 1:
            raise ConfigError(f"{where}: registered more than once, as {' and '.join(points)}")
        (point,) = points.values()
        try:
            part = made(point.load())
            is_fit = fits(part)
        except BaseException as error:  # code of another package may raise anything
            raise ConfigError(f"{where}: {point.value} raises {exception_text(error)}") from error
        if not is_fit:
            raise ConfigError(f"{where}: {point.value} {complaint.format(described(part))}")
        return part


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """The end of a message about a name that there is not: the nearest one that there is."""
    near = difflib.get_close_matches(name[:100], list(names), n=1)
    return f"; did you mean {near[0]}?" if near else ""


@lru_cache(maxsize=16)
def field_docs(kind: type) -> dict[str, str]:
    """The text beneath each field of a dataclass, on one line."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    docs: dict[str, str] = {}
    for field, after in pairwise(body):
        match field, after:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(words))),
            ):
                docs[name] = " ".join(words.split())
            case _:
                pass
    return docs


class _WithFields:
    """A docstring with the text beneath each field, put together when it is asked for."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __get__(self, instance: object, owner: type) -> str:
        told = [f"    {name}: {words}" for name, words in field_docs(owner).items()]
        return "\n".join([self._text, "", "Fields:", *told])


def explains_fields(kind: Kind) -> Kind:
    """Let ``help`` tell of each field of a dataclass what stands beneath it."""
    text: Any = _WithFields(inspect.cleandoc(kind.__doc__ or ""))
    kind.__doc__ = text
    return kind


def described(part: object) -> str:
    """What something is, for a message that says that it should be something else."""
    if isinstance(part, type):
        return f"the class {part.__name__}"
    return "nothing" if part is None else f"a value of type {type(part).__name__}"


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
        return limits is None or limits.contains(cast(float, value))

    return fits


def check_value(*, name: str, value: object, annotation: object) -> object:
    """``value`` converted to the annotated type (only int to float is converted).

    Raises:
        ConfigError: The type is wrong, the number lies outside its range, or there is no part
            of that name.
    """
    complaint = checker(annotation)(value)
    if complaint is not None:
        raise ConfigError(f"{name} = {shown(value)}: {complaint}")
    return float(cast(float, value)) if _unpack(annotation)[0] is float else value


def check_fields(instance: Any, *, prefix: str = "") -> None:
    """Check every field of a dataclass, nested dataclasses included.

    Raises:
        ConfigError: Naming the first field that is out of range, with what is allowed.
    """
    hints = get_type_hints(type(instance), include_extras=True)
    for field in fields(instance):
        name, annotation = f"{prefix}{field.name}", hints[field.name]
        value = getattr(instance, field.name)
        if is_dataclass(value):
            check_fields(value, prefix=f"{name}.")
        elif get_origin(annotation) is tuple:
            _check_records(value, name=name, kind=get_args(annotation)[0])
        elif value is not None or not allows_none(annotation):
            check_value(name=name, value=value, annotation=optional_value(annotation))


def _check_records(values: Any, *, name: str, kind: Any) -> None:
    if not isinstance(values, tuple):
        raise ConfigError(f"{name} = {shown(values)}: must be a tuple")
    for index, value in enumerate(cast(tuple[object, ...], values)):
        if not isinstance(value, kind):
            raise ConfigError(f"{name}[{index}] = {shown(value)}: must be a {kind.__name__}")
        check_fields(value, prefix=f"{name}[{index}].")


def optional_value(annotation: object) -> object:
    """The annotation of the value itself, where ``None`` is allowed beside it."""
    if not allows_none(annotation):
        return annotation
    return next(arm for arm in get_args(annotation) if arm is not type(None))


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


def shown(value: object) -> str:
    """``value`` in at most sixty characters, whatever it is."""
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # nested deeply, or a number of thousands of digits
        text = f"({type(value).__name__})"
    limit = 60
    return text if len(text) <= limit else text[: limit - 3] + "..."
