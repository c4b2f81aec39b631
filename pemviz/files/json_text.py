"""JSON from files that may come from anywhere: strict, no deeper than can be walked, or by rows."""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn, TextIO, cast

from pemviz.errors import PemError
from pemviz.files.atomic import is_file
from pemviz.files.text_files import open_text

DEEPEST = 100
"""Levels of nesting; our own files have fewer than ten."""
_TOO_DEEP = f"nested more than {DEEPEST} levels deep"
CHUNK = 1 << 15
"""Characters read at a time; what is left of them is copied for each row, so not many."""
LONGEST_ROW = 1 << 24
"""Characters; what is longer is no row of a table."""


def parse_json(text: str, *, strict: bool = True) -> Any:
    """The value that a JSON text spells out.

    Args:
        text: The text.
        strict: Also refuse what other programs may not read: NaN, infinities, and numbers
            beyond float64.

    Raises:
        ValueError: It is not JSON, or nested more than 100 levels deep; one line says what.
    """
    numbers: dict[str, Any] = {"parse_constant": _refuse, "parse_float": _finite} if strict else {}
    try:
        value: Any = json.loads(text, parse_int=_whole, **numbers)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level: list[Any] = [value]
    for _ in range(DEEPEST + 1):
        inner = [item for item in level if isinstance(item, dict | list)]
        if not inner:
            return value
        level = [
            child
            for item in cast(list[dict[str, Any] | list[Any]], inner)
            for child in (item.values() if isinstance(item, dict) else item)
        ]
    raise ValueError(_TOO_DEEP)


def read_json(path: Path) -> Any:
    """The value that a file holds; numbers beyond float64 are passed on.

    Raises:
        PemError: It is not there, cannot be read, or is not JSON; one line says where.
    """
    if not is_file(path):
        raise PemError(f"{path}: no such file")
    try:
        with open_text(path) as stream:
            return parse_json(stream.read(), strict=False)
    except json.JSONDecodeError as error:
        raise PemError(f"{path}:{error.lineno}: column {error.colno}: {error.msg}") from None
    except ValueError as error:
        raise PemError(f"{path}: {error}") from None


def _refuse(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a JSON number")


def _finite(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        raise ValueError(f"the number {word[:40]} is beyond what a float64 holds")
    return value


def _whole(word: str) -> int:
    if len(word) > 300:
        raise ValueError(f"the number {word[:40]}... has {len(word)} digits, allowed are 300")
    return int(word)


def json_rows(path: Path, *, needs: tuple[str, ...]) -> Iterator[Mapping[str, Any]]:
    """The objects of a JSON list of objects, one after the other: it may be larger than memory.

    Args:
        path: The file.
        needs: Fields that each object must have.

    Raises:
        PemError: It cannot be read, is no such list, or a row (counted from 0) lacks a field.
    """
    with open_text(path) as stream:
        try:
            for number, row in enumerate(_values(stream)):
                if not isinstance(row, dict):
                    raise ValueError(f"row {number} is no object")
                lacking = [name for name in needs if name not in row]
                if lacking:
                    raise ValueError(f"row {number} lacks {lacking[0]!r}")
                yield row
        except RecursionError:
            raise PemError(f"{path}: nested too deep") from None
        except ValueError as error:
            raise PemError(f"{path}: {error}") from None


def _values(stream: TextIO) -> Iterator[Any]:
    """The values of the list that a stream holds."""
    decoder, text, is_first = json.JSONDecoder(), "", True
    while True:
        text = _beyond_space(stream, text)
        opener = "[" if is_first else ",]"
        if text[:1] not in opener or not text:
            raise ValueError("not a JSON list of objects" if is_first else "the list is cut off")
        at, is_first = text[0], False
        text = _beyond_space(stream, text[1:])
        if at == "]" or (at == "[" and text[:1] == "]"):
            if _beyond_space(stream, text[at == "[" :]):
                raise ValueError("something follows the list")
            return
        value, text = _value(decoder, stream, text)
        yield value


def _beyond_space(stream: TextIO, text: str) -> str:
    """The text from what is no white space on; empty at the file's end."""
    text = text.lstrip(" \t\r\n")
    while not text and (more := stream.read(CHUNK)):
        text = more.lstrip(" \t\r\n")
    return text


def _value(decoder: json.JSONDecoder, stream: TextIO, text: str) -> tuple[Any, str]:
    """The value that a text begins with, read on as far as need be, and what follows it."""
    while True:
        problem = "the list is cut off"
        try:
            value, end = decoder.raw_decode(text)
            if end < len(text):  # else a number might go on
                return value, text[end:]
        except json.JSONDecodeError as error:
            problem = error.msg
        more = stream.read(CHUNK) if len(text) < LONGEST_ROW else ""
        if not more:
            raise ValueError(problem)
        text += more
