"""Ratios of speed that are kept, so that a later run can be held against an earlier one."""

import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from statistics import median
from typing import Any, cast

from pemviz import _version
from pemviz.errors import InputError
from pemviz.files.json_text import parse_json

SCHEMA = 1
LARGEST_FILE_BYTES = 1_000_000
LIBRARIES = ("numpy", "numba", "torch", "highway-env")


@dataclass(frozen=True)
class Ratio:
    """How many times faster something is than what it is held against; more is better.

    Attributes:
        name: What is measured.
        against: What it is held against.
        value: The median over several turns, each a ratio of processor seconds measured one right
            after the other.
        low: The least of them.
        high: The largest.
        note: What else was measured; empty as a rule.
    """

    name: str
    against: str
    value: float
    low: float
    high: float
    note: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """What makes it the same measure in another run."""
        return self.name, self.against


@dataclass(frozen=True)
class LeftOut:
    """What could not be measured here, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Comparison:
    """The ratios of one run.

    Attributes:
        ratios: In the order of the table.
        left_out: What could not be measured.
        made_with: Versions and machine, by name.
    """

    ratios: tuple[Ratio, ...]
    left_out: tuple[LeftOut, ...]
    made_with: Mapping[str, str]

    def document(self) -> dict[str, Any]:
        """As JSON keeps it."""
        return {
            "schema": SCHEMA,
            "made_with": dict(self.made_with),
            "ratios": [asdict(ratio) for ratio in self.ratios],
            "left_out": [asdict(one) for one in self.left_out],
        }


@dataclass(frozen=True)
class Change:
    """One measure in an earlier run and in this one.

    Attributes:
        name: What is measured.
        against: What it is held against.
        before: The earlier ratio; ``None`` if there was none.
        now: This run's; ``None`` if there is none.
        slower: Whether it fell by more than the threshold.
    """

    name: str
    against: str
    before: float | None
    now: float | None
    slower: bool


def ratio_of_turns(
    name: str,
    against: str,
    *,
    theirs_s: Sequence[float],
    ours_s: Sequence[float],
    note: str = "",
) -> Ratio:
    """Their time over ours, turn by turn."""
    each = [their_s / our_s for their_s, our_s in zip(theirs_s, ours_s, strict=True)]
    return Ratio(name, against, median(each), min(each), max(each), note)


def made_with() -> dict[str, str]:
    """Versions of what decides the speed, and the machine."""
    found = {"pemviz": _version.__version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not there"
    return {**found, "machine": f"{platform.machine()}, {os.cpu_count()} cores"}


def changes(earlier: Comparison, now: Comparison, *, threshold: float) -> Iterator[Change]:
    """Every measure of either run, this run's order first.

    Args:
        earlier: The run to hold against.
        now: This run.
        threshold: Share of the earlier ratio by which one must fall to count as slower, 0 to 1.
    """
    before = {ratio.key: ratio.value for ratio in earlier.ratios}
    after = {ratio.key: ratio.value for ratio in now.ratios}
    for key in {**after, **before}:
        was, is_now = before.get(key), after.get(key)
        slower = was is not None and is_now is not None and is_now < was * (1.0 - threshold)
        yield Change(*key, was, is_now, slower)


def read_comparison(path: Path) -> Comparison:
    """What ``python -m benchmarks compare --out`` wrote.

    Raises:
        InputError: The file is not there, or is no such file; one line says where.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise InputError(f"{path}: larger than {LARGEST_FILE_BYTES:,} bytes")
        document = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:  # text that is not UTF-8 too
        raise InputError(f"{path}: not JSON ({error})") from None
    if not isinstance(document, dict) or cast(dict[str, Any], document).get("schema") != SCHEMA:
        raise InputError(f"{path}: not from benchmarks compare --out (schema must be {SCHEMA})")
    return _comparison(cast(dict[str, Any], document), path)


def _comparison(document: Mapping[str, Any], path: Path) -> Comparison:
    made = _checked(document.get("made_with"), dict, f"{path}: made_with")
    return Comparison(
        ratios=tuple(
            Ratio(
                name=_checked(row.get("name"), str, f"{where}.name"),
                against=_checked(row.get("against"), str, f"{where}.against"),
                value=_positive(row.get("value"), f"{where}.value"),
                low=_positive(row.get("low"), f"{where}.low"),
                high=_positive(row.get("high"), f"{where}.high"),
                note=_checked(row.get("note", ""), str, f"{where}.note"),
            )
            for where, row in _rows(document, "ratios", path)
        ),
        left_out=tuple(
            LeftOut(
                name=_checked(row.get("name"), str, f"{where}.name"),
                why=_checked(row.get("why"), str, f"{where}.why"),
            )
            for where, row in _rows(document, "left_out", path)
        ),
        made_with={
            name: _checked(text, str, f"{path}: made_with.{name}") for name, text in made.items()
        },
    )


def _rows(
    document: Mapping[str, Any], name: str, path: Path
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for index, row in enumerate(_checked(document.get(name), list, f"{path}: {name}")):
        where = f"{path}: {name}[{index}]"
        yield where, _checked(row, dict, where)


def _checked(value: Any, kind: type[Any], where: str) -> Any:
    if not isinstance(value, kind):
        names = {str: "a text", dict: "an object", list: "a list"}
        raise InputError(f"{where} must be {names[kind]}")
    return value


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} must be a number")
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{where} = {value} must be a number, above 0")
    return float(value)
