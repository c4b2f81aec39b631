"""SHA-256 of files of any size, and of documents whatever their spacing and order."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pemviz.errors import InputError


def file_digest(path: Path) -> str:
    """SHA-256 of a file, read a piece at a time.

    Raises:
        InputError: It cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        message = f"{path}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error


def document_digest(document: Mapping[str, Any]) -> str:
    """SHA-256 of a document in JSON: keys sorted, no spaces, ASCII.

    Raises:
        ValueError: The document holds NaN or an infinity.
    """
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()
