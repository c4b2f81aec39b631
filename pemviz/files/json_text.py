"""JSON from files that may come from anywhere: strict, and no deeper than can be walked."""

import json
import math
from collections.abc import Callable
from typing import Any, NoReturn, cast

DEEPEST = 100
"""Levels of nesting; our own files have fewer than ten."""


def parse_json(text: str, *, strict: bool = True) -> Any:
    """The value that a JSON text spells out.

    Args:
        text: The text.
        strict: Also refuse what other programs may not read: NaN, infinities, and numbers
            beyond float64.

    Raises:
        ValueError: It is not JSON, or nested more than 100 levels deep; one line says what.
    """
    refuse = _refuse if strict else None
    number = cast(Callable[[str], Any], _finite) if strict else None
    try:
        value: Any = json.loads(text, parse_constant=refuse, parse_float=number, parse_int=_whole)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    if _depth(value) > DEEPEST:
        raise ValueError(_TOO_DEEP)
    return value


_TOO_DEEP = f"nested more than {DEEPEST} levels deep"


def _refuse(word: str) -> NoReturn:
    message = f"{word} is not a JSON number"
    raise ValueError(message)


def _finite(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        message = f"the number {word[:40]} is beyond what a float64 holds"
        raise ValueError(message)
    return value


def _whole(word: str) -> int:
    if len(word) > 300:
        message = f"the number {word[:40]}... has {len(word)} digits, allowed are 300"
        raise ValueError(message)
    return int(word)


def _depth(value: Any) -> int:
    """Levels of nesting, at most one more than the deepest allowed."""
    level: list[Any] = [value]
    depth = 0
    while level and depth <= DEEPEST:
        inner = [item for item in level if isinstance(item, dict | list)]
        level = [
            child
            for item in cast(list[dict[str, Any] | list[Any]], inner)
            for child in (item.values() if isinstance(item, dict) else item)
        ]
        depth += bool(inner)
    return depth
