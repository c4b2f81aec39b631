"""What a ``result.json`` must look like for us to read it."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from pemviz.errors import InputError
from pemviz.files.json_text import parse_json

LARGEST_COUNT = 2**53


def _is_whole(value: object, *, most: int = LARGEST_COUNT) -> bool:
    is_int = isinstance(value, int) and not isinstance(value, bool)
    return is_int and 0 <= cast(int, value) <= most


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_Kind = tuple[Callable[[object], bool], str]
WHOLE: _Kind = (_is_whole, f"a whole number from 0 to {LARGEST_COUNT}")
SEED: _Kind = (lambda value: _is_whole(value, most=2**63 - 1), "a seed")
NUMBER: _Kind = (_is_number, "a number")
TEXT: _Kind = (lambda value: isinstance(value, str), "a text")
TABLE: _Kind = (lambda value: isinstance(value, Mapping), "a table")
LIST: _Kind = (lambda value: isinstance(value, list), "a list")

ESTIMATE = {
    "method": TEXT,
    **dict.fromkeys(("rollouts_simulated", "rollouts_in_estimate", "failures"), WHOLE),
    **dict.fromkeys(("probability", "log10_probability", "std_error", "ci_low", "ci_high"), NUMBER),
    "confidence": NUMBER,
    **dict.fromkeys(("nll_mean", "nll_log_mean", "ess", "pareto_k", "max_weight_share"), NUMBER),
    **dict.fromkeys(("warnings", "diagnostics"), LIST),
}
STAGE = {
    **dict.fromkeys(("repetition", "stage", "rollouts", "elites", "failures"), WHOLE),
    **dict.fromkeys(("threshold", "probability", "log10_probability", "ess", "loss"), NUMBER),
    "kind": TEXT,
}
RESULT = {
    "run_id": TEXT,
    "status": TEXT,
    "seed": SEED,
    **dict.fromkeys(("config", "estimate", "reference", "pem_interval"), TABLE),
    **dict.fromkeys(("stages", "repetitions", "assumptions", "warnings"), LIST),
}
INTERVAL = {**dict.fromkeys(("low", "high", "median", "confidence"), NUMBER), "members": WHOLE}
REFERENCE = {"probability": NUMBER, "std_error": NUMBER}
REQUIRED = {"stages": ("repetition", "stage", "rollouts", "failures")}


def read_document(path: Path) -> dict[str, Any]:
    """The contents of a ``result.json``.

    Raises:
        InputError: It cannot be read, is not a JSON object, or holds what no result holds.
    """
    try:
        document = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        message = f"result {path}: cannot be read ({error})"
        raise InputError(message) from error
    if not isinstance(document, dict):
        message = f"result {path}: must be a JSON object"
        raise InputError(message)
    found = cast(dict[str, Any], document)
    check_document(found, where=str(path))
    return found


def check_document(document: Mapping[str, Any], *, where: str) -> None:
    """Check what is calculated with; null is allowed wherever a run may write it.

    Raises:
        InputError: Naming the first entry that no run writes.
    """
    _check(document, RESULT, where=f"result {where}")
    for name, fields in (
        ("estimate", ESTIMATE),
        ("reference", REFERENCE),
        ("pem_interval", INTERVAL),
    ):
        _check(document.get(name) or {}, fields, where=f"result {where}: {name}")
    for name, fields in (("stages", STAGE), ("repetitions", ESTIMATE)):
        for index, entry in enumerate(document.get(name) or ()):
            shown = f"result {where}: {name}[{index}]"
            _expect(entry, TABLE, where=shown)
            _check(entry, fields, where=shown)
            for field in REQUIRED.get(name, ()):
                _expect(entry.get(field), fields[field], where=f"{shown}.{field}")


def _check(table: Mapping[str, Any], fields: Mapping[str, _Kind], *, where: str) -> None:
    for name, kind in fields.items():
        if table.get(name) is not None:
            _expect(table[name], kind, where=f"{where}.{name}")


def _expect(value: object, kind: _Kind, *, where: str) -> None:
    fits, allowed = kind
    if not fits(value):
        message = f"{where} is {str(value)[:60]!r}, must be {allowed}"
        raise InputError(message)
