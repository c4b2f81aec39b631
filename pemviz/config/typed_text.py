"""A setting as a person types it, and as it is typed again."""

import re
from typing import Annotated, Any, get_args, get_origin

from pemviz.config.ranges import Range, allows_none, checker, optional_value
from pemviz.errors import ConfigError

PERCENT = re.compile(r"^(?P<number>\d+(\.\d+)?)\s?%$")
"""A word that is a percentage stands for its share: 10% for 0.1."""
SWITCHES = {"true": True, "false": False}


def share_of(percent: re.Match[str]) -> str:
    """The share that a percentage stands for, as it is typed."""
    return repr(float(percent["number"]) / 100.0)


def read_typed(text: str, annotation: object) -> Any:
    """The value of a field annotated with ``annotation`` that was typed as ``text``.

    Empty text leaves out what may be left out. Whole numbers may be typed as 1e6, shares, which
    are at most 1, in per cent.

    Raises:
        ConfigError: It is none, or is not allowed; the line says what is.
    """
    typed = text.strip()
    if not typed and allows_none(annotation):
        return None
    kind = optional_value(annotation)
    value: Any = _value(typed, kind)
    complaint = checker(kind)(value)
    if complaint is not None:
        raise ConfigError(f"{complaint}{_hint(typed, value)}")
    return float(value) if _base(kind) is float else value


def typed_text(value: object) -> str:
    """How a value is typed, so that :func:`read_typed` reads it back; nothing for ``None``."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return short if float(short := f"{value:g}") == value else repr(value)
    return str(value)


def _value(typed: str, kind: object) -> object:
    """Of the type that the field has, or the text itself."""
    base = _base(kind)
    if base is bool:
        return SWITCHES.get(typed, typed)
    if base not in (int, float) or not typed.isascii():
        return typed
    number = PERCENT.sub(share_of, typed) if base is float and _is_share(kind) else typed
    try:
        return int(number) if base is int else float(number)
    except ValueError:
        pass
    try:  # a whole number with an exponent
        return int(value) if (value := float(number)).is_integer() else value
    except (ValueError, OverflowError):
        return typed


def _hint(typed: str, value: object) -> str:
    """What is behind some texts that are no numbers."""
    if value != typed or not any(letter.isdigit() for letter in typed):
        return ""
    if not typed.isascii():
        return "; in plain digits and signs"
    return "; a comma is not understood" if "," in typed else ""


def _base(kind: Any) -> Any:
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _is_share(kind: object) -> bool:
    return any(
        isinstance(part, Range) and part.high is not None and part.high <= 1.0
        for part in get_args(kind)
    )
