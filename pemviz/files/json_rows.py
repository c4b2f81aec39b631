"""The rows of a JSON table, one after the other: a file may be larger than memory."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from pemviz.errors import PemError
from pemviz.files.text_files import open_text

CHUNK = 1 << 15
"""Characters read at a time; what is left of them is copied for each row, so not many."""
LONGEST_ROW = 1 << 24
"""Characters; what is longer is no row of a table."""
_SPACE = " \t\r\n"


def json_rows(path: Path, *, needs: tuple[str, ...]) -> Iterator[Mapping[str, Any]]:
    """The objects of a JSON list of objects.

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
    """The values of the list that a stream holds.

    Raises:
        ValueError: It holds no whole list.
    """
    decoder, text, is_first = json.JSONDecoder(), "", True
    while True:
        text = _further(stream, text)
        opener = "[" if is_first else ",]"
        if text[:1] not in opener or not text:
            raise ValueError("not a JSON list of objects" if is_first else "the list is cut off")
        at, is_first = text[0], False
        text = _further(stream, text[1:])
        if at == "]" or (at == "[" and text[:1] == "]"):
            if _further(stream, text[at == "[" :]):
                raise ValueError("something follows the list")
            return
        value, text = _value(decoder, stream, text)
        yield value


def _further(stream: TextIO, text: str) -> str:
    """The text from what is no white space on; empty at the file's end."""
    text = text.lstrip(_SPACE)
    while not text and (more := stream.read(CHUNK)):
        text = more.lstrip(_SPACE)
    return text


def _value(decoder: json.JSONDecoder, stream: TextIO, text: str) -> tuple[Any, str]:
    """The value that a text begins with, read on as far as need be, and what follows it."""
    while True:
        try:
            value, end = decoder.raw_decode(text)
            if end < len(text):  # else a number might go on
                return value, text[end:]
        except json.JSONDecodeError as error:
            problem = error.msg
        else:
            problem = "the list is cut off"
        more = stream.read(CHUNK) if len(text) < LONGEST_ROW else ""
        if not more:
            raise ValueError(problem)
        text += more
