"""An argument as a file in the YAML of gsn2x, and whether what it says still holds.

Elements are keys; ``text``, ``supportedBy``, ``inContextOf`` and ``undeveloped`` are gsn2x's,
further attributes are texts that it shows when asked (its layers). A check reads the runs and the
budget again that the argument was made from, compares digests, judges the claims anew and compares.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from pemviz.errors import InputError
from pemviz.files.atomic import file_digest, write_named
from pemviz.files.yaml_text import parse_yaml, yaml_text
from pemviz.reports.argument import (
    BELOW,
    BUDGET,
    CLAIM,
    DIGEST,
    FILE,
    RUN,
    TOP,
    Argument,
    Element,
    argument_of_budget,
    argument_of_runs,
    undeveloped,
)
from pemviz.reports.case_runs import read_case_run
from pemviz.reports.escape import printable_line
from pemviz.runs.risk_budget import judge_budget

LARGEST_BYTES = 20_000_000
LIST_FIELDS = ("supportedBy", "inContextOf")
WIDTH = 100
ABOUT = (
    "# The argument of a safety case in the Goal Structuring Notation, for gsn2x and other readers "
    "of its YAML.\n# Checked again by: pemviz report --check {name}\n"
)


def write_gsn(path: Path, argument: Argument) -> None:
    """Write an argument; files that it names are seen from the folder of ``path``.

    Raises:
        InputError: It cannot be written.
    """
    document = {one.name: _table(one, path.parent) for one in argument}
    _write(path, document)


def _write(path: Path, document: Mapping[str, Any]) -> None:
    about = ABOUT.format(name=printable_line(path.name))
    write_named("gsn", path, about + yaml_text(document, width=WIDTH))


def _table(one: Element, beside: Path) -> dict[str, Any]:
    table: dict[str, Any] = {"text": printable_line(one.text)}
    if one.supported_by:
        table["supportedBy"] = list(one.supported_by)
    if one.in_context_of:
        table["inContextOf"] = list(one.in_context_of)
    if one.undeveloped:
        table["undeveloped"] = True
    for name, value in one.details.items():
        table[name] = _seen_from(beside, value) if _is_path(name) else value
    return table


def _is_path(name: str) -> bool:
    return name in (FILE, BUDGET) or _is_run(name)


def _seen_from(folder: Path, path: str) -> str:
    try:
        return Path(os.path.relpath(Path(path).resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return str(Path(path).resolve())


@dataclass(frozen=True)
class GsnFile:
    """A file as it was read.

    Attributes:
        document: All that it holds.
        argument: Its elements, the top goal first.
    """

    document: Mapping[str, Any]
    argument: Argument


def read_gsn(path: Path) -> GsnFile:
    """Read an argument that :func:`write_gsn` wrote, whatever was added to it by hand.

    Raises:
        InputError: It cannot be read, is no such YAML, or has no top goal of ours.
    """
    where = f"gsn {path}"
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES + 1)
    except OSError as error:
        message = f"{where}: cannot be read ({error.strerror or error})"
        raise InputError(message) from error
    if len(content) > LARGEST_BYTES:
        message = f"{where}: must have at most {LARGEST_BYTES} bytes"
        raise InputError(message)
    try:
        document = parse_yaml(content.decode("utf-8-sig"))
    except ValueError as error:
        message = f"{where}: {error}"
        raise InputError(message) from error
    if not isinstance(document, dict):
        message = f"{where}: must be a table of elements"
        raise InputError(message)
    tables = cast(dict[Any, Any], document)
    elements = [_element(name, table, where) for name, table in tables.items() if name != "module"]
    top = [one for one in elements if one.name == TOP]
    if not top:
        message = f"{where}: has no goal {TOP}; pemviz report --gsn writes one"
        raise InputError(message)
    others = (one for one in elements if one.name != TOP)
    return GsnFile(tables, (*top, *others))


def _element(name: object, table: object, where: str) -> Element:
    if not isinstance(name, str) or not isinstance(table, dict):
        message = f"{where}: {str(name)[:60]!r}: must be a table with a text"
        raise InputError(message)
    values = cast(dict[Any, Any], table)
    for key in LIST_FIELDS:
        given = values.get(key, [])
        names = [given] if isinstance(given, str) else given
        if not isinstance(names, list) or not all(
            isinstance(one, str) for one in cast(list[Any], names)
        ):
            message = f"{where}: {name}.{key}: must be a list of names"
            raise InputError(message)
        values[key] = names
    known = ("text", *LIST_FIELDS, "undeveloped")
    details = {str(key): str(value) for key, value in values.items() if key not in known}
    return Element(
        name=name,
        text=str(values.get("text", "")),
        supported_by=tuple(values["supportedBy"]),
        in_context_of=tuple(values["inContextOf"]),
        undeveloped=values.get("undeveloped") is True,
        details=details,
    )


@dataclass(frozen=True)
class Finding:
    """A claim that does not hold.

    Attributes:
        goal: Its name.
        text: Why.
        is_new: Whether it held when the file was written.
    """

    goal: str
    text: str
    is_new: bool


def check_gsn(path: Path) -> tuple[Finding, ...]:
    """What of an argument does not hold, or never did; nothing is written.

    Raises:
        InputError: The file is damaged.
    """
    return tuple(_findings(read_gsn(path).argument, path))


def update_gsn(path: Path, findings: tuple[Finding, ...]) -> None:
    """Make the goals of what does not hold undeveloped; the rest of the file stays, but comments.

    Raises:
        InputError: The file is damaged, or cannot be written.
    """
    read = read_gsn(path)
    kept = {one.name: one for one in undeveloped(read.argument, {one.goal for one in findings})}
    document = dict[str, Any]()
    for name, table in read.document.items():
        if name == "module":
            document[name] = table
        elif name in kept:
            values = {key: value for key, value in table.items() if value != []}
            if kept[name].undeveloped:
                values.pop("supportedBy", None)
                values["undeveloped"] = True
            document[name] = values
    _write(path, document)


def _findings(argument: Argument, path: Path) -> Iterator[Finding]:
    stored = {one.name: one for one in argument}
    changed = {one.name: why for one in argument if (why := _changed(one, path.parent))}
    fresh, wrong = dict[str, Element](), ""
    try:
        again = _made_again(argument[0], path.parent)
    except InputError as error:
        wrong = str(error)
    else:
        fresh = {one.name: one for one in again}
    for one in argument:
        if CLAIM not in one.details:
            continue
        if one.undeveloped or not one.supported_by:
            yield Finding(one.name, f"is undeveloped: {one.text}", is_new=not one.undeveloped)
            continue
        evidence = [changed[name] for name in one.supported_by if name in changed]
        why = next(iter(evidence), wrong or _differs(one, fresh, stored))
        if why:
            yield Finding(one.name, f"no longer holds: {why}", is_new=True)
    for name, one in fresh.items():
        if CLAIM in one.details and name not in stored:
            text = f"is left out of the file, and the evidence says: {one.text}"
            yield Finding(name, text, is_new=True)


def _changed(one: Element, beside: Path) -> str:
    """Why a solution is not what it was; empty if it is, and of other elements."""
    if one.kind != "Solution" or not {FILE, DIGEST} & set(one.details):
        return ""
    if not {FILE, DIGEST} <= set(one.details):
        return f"{one.name} names no {FILE} with its {DIGEST}"
    path = beside / one.details[FILE]
    try:
        digest = file_digest(path)
    except InputError as error:
        return f"{one.name}: {error}"
    if digest == one.details[DIGEST]:
        return ""
    return f"{one.name}: {path} has changed (digest {digest[:8]}, was {one.details[DIGEST][:8]})"


def _differs(one: Element, fresh: Mapping[str, Element], stored: Mapping[str, Element]) -> str:
    """How a claim, and what it rests on, differ from what the evidence gives now."""
    now = fresh.get(one.name)
    if now is None:
        return "the evidence gives no such claim"
    text = printable_line(now.text)
    if now.undeveloped:
        return text
    if text != one.text:
        return f"it reads {one.text!r}, the evidence gives {text!r}"
    for name in now.supported_by:
        if name not in one.supported_by or name not in stored:
            return f"it does not name {name}, on which it rests"
        if fresh[name].details.get(DIGEST) != stored[name].details.get(DIGEST):
            return f"{name} names another file than the evidence is in"
    return ""


def _made_again(top: Element, beside: Path) -> Argument:
    """The argument from what its top goal says that it was made from.

    Raises:
        InputError: A run or the budget cannot be read, or none is named.
    """
    if BUDGET in top.details:
        return argument_of_budget(judge_budget(beside / top.details[BUDGET]))
    numbered = {int(n.removeprefix(RUN)): v for n, v in top.details.items() if _is_run(n)}
    if not numbered:
        message = f"{top.name}: names neither {BUDGET} nor {RUN}1"
        raise InputError(message)
    runs = [read_case_run(beside / folder) for _, folder in sorted(numbered.items())]
    try:
        below = float(top.details[BELOW]) if BELOW in top.details else None
    except ValueError:
        message = f"{top.name}.{BELOW} = {top.details[BELOW][:40]!r}: must be a number"
        raise InputError(message) from None
    return argument_of_runs(runs, below=below)


def _is_run(name: str) -> bool:
    return name.startswith(RUN) and name.removeprefix(RUN).isdigit()
