"""The JSON Schema of ``result.json`` (draft 2020-12), made from the types that are written to it.

``python docs/_ext/result_schema.py`` prints it; ``docs/reference/result.schema.json`` is a copy.
It says what this version writes. Older results lack what their version did not know.
"""

import inspect
import json
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.config import ExperimentConfig
from pemviz.config.ranges import Range, allows_none, field_docs, optional_value
from pemviz.config.toml_files import config_table
from pemviz.runs.rates import DistanceRate, ViolationRate
from pemviz.runs.result import RankedRollout, RuleAnswer, RunMemory, RunResult, StageSummary
from pemviz.runs.result_file import OPEN_SCHEMA, SCHEMA
from pemviz.runs.uncertainty import UncertaintySource
from pemviz.types import Estimate, StageResult

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
NAME = "urn:pemviz:result:2"
ATTRIBUTES = re.compile(r"^Attributes:\n(?P<lines>(?:[ ]+.*\n?|\n)*)", re.MULTILINE)
ATTRIBUTE = re.compile(r"^    (?P<name>\w+): (?P<words>.*(?:\n      +.*)*)", re.MULTILINE)
MARKUP = re.compile(r":\w+:`~?\.?([^`]*)`|``([^`]*)``")
NOTHING = re.compile(r"\bNone\b")
SHA_256 = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
TEXT = {"type": "string"}
OPTIONAL: Mapping[type, frozenset[str]] = {
    RunMemory: frozenset({"measured", "unmeasured", "check", "visibility", "carried"}),
    RankedRollout: frozenset({"broken"}),
    RuleAnswer: frozenset({"measured"}),
}
"""Fields that are left out where they are empty."""
SUMMARY_OF: Mapping[type, type] = {StageSummary: StageResult}
"""Types whose fields are those of another, which tells of them."""
WHERE_THERE_IS_SOME = (
    "simulator", "rules", "per_hour", "per_km", "driven", "latents", "position_errors", "starts",
    "lost", "surrogate", "robustness_tail", "least_robust_by_rule",
)  # fmt: skip
"""Likewise of the document itself."""


def result_schema() -> Schema:
    """The schema of what :func:`pemviz.runs.result_file.write_result` writes."""
    found: dict[str, Schema] = {}
    properties = _document(found)
    required = [name for name in properties if name not in (*WHERE_THERE_IS_SOME, *_DIGESTS)]
    return {
        "$schema": DIALECT,
        "$id": NAME,
        "title": "result.json of a pemviz run",
        "description": (
            "Numbers are null where a figure is undefined or infinite. Of schema 2, which run "
            "folders hold; schema 1, which --json prints, has no files and no digest."
        ),
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
        "if": {"properties": {"schema": {"const": SCHEMA}}},
        "then": {"required": list(_DIGESTS)},
        "else": {"properties": dict.fromkeys(_DIGESTS, False)},
        "$defs": {name: found[name] for name in sorted(found)},
    }


_DIGESTS = ("files", "digest")


def _document(found: dict[str, Schema]) -> Schema:
    """The entries of the document, in the order in which they stand there."""
    of_result = _properties(RunResult, found)
    own: Schema = {
        "schema": {"enum": [OPEN_SCHEMA, SCHEMA], "description": "Which of the two it is."},
        "seed": {"type": "integer", "description": "The configuration's."},
        "per_hour": _array(_of(ViolationRate, found), "Violations an hour, by rule."),
        "per_km": _array(_of(DistanceRate, found), "Violations a kilometre, by rule."),
        "uncertainty": _array(
            _of(UncertaintySource, found), "What leaves the answer open, a row a source."
        ),
        "sensitivity": _or_null(
            _array(_of(BandSensitivity, found)) | {"description": "Of all distances, then by band."}
        ),
        "causes": _or_null(_of(Explanation, found))
        | {"description": "Where and when the detector misses before violations."},
        "files": {
            "description": "SHA-256 of the run folder's files by name.",
            "type": "object",
            "additionalProperties": SHA_256,
        },
        "digest": {**SHA_256, "description": "SHA-256 of everything before it."},
    }
    everything = {**of_result, **own}
    return {name: everything[name] for name in ORDER}


ORDER = (
    "schema", "run_id", "status", "message", "seed", "versions", "simulator", "config", "pem",
    "estimate", "rules", "per_hour", "per_km", "driven", "lost", "surrogate", "memory", "latents",
    "position_errors", "starts", "reference", "pem_interval", "model_classes", "uncertainty",
    "data_bound", "plan", "sensitivity", "causes", "robustness_tail", "repetitions", "stages",
    "least_robust", "least_robust_by_rule", "assumptions", "warnings", "timings_s", *_DIGESTS,
)  # fmt: skip


def _of(  # noqa: PLR0911 (one case per kind of annotation)
    annotation: Any, found: dict[str, Schema]
) -> Schema:
    """The schema of a value annotated so; dataclasses go into ``found``."""
    if allows_none(annotation):
        return _or_null(_of(optional_value(annotation), found))
    origin = get_origin(annotation)
    if origin is Annotated:
        base, *marks = get_args(annotation)
        limits = next((mark for mark in marks if isinstance(mark, Range)), None)
        return _of(base, found) | ({} if limits is None else _limits(limits))
    if origin is Literal:
        return {"enum": list(get_args(annotation))}
    if origin is tuple:
        return _array(_of(get_args(annotation)[0], found))
    if origin is not None and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _of(get_args(annotation)[1], found)}
    if is_dataclass(annotation):
        return _record(annotation, found)
    kinds = {float: "number", int: "integer", str: "string", bool: "boolean"}
    return {"type": kinds[annotation]}


def _record(kind: Any, found: dict[str, Schema]) -> Schema:
    """A reference to the schema of a dataclass."""
    if kind.__name__ not in found:
        found[kind.__name__] = {}  # a type may lie in itself
        properties = _properties(kind, found)
        optional = OPTIONAL.get(kind, frozenset[str]())
        if kind is ExperimentConfig:
            always = config_table(ExperimentConfig())
            optional = frozenset(properties) - (set(always) - {"scenario"})
        elif kind.__name__.endswith("Config"):  # a table of which a run may have taken a part
            optional = frozenset(properties)
        elif kind is Estimate:
            optional = frozenset({"try_next"})
        elif kind is Explanation:
            del properties["sensitivity"]
        found[kind.__name__] = {
            "description": _plain(inspect.cleandoc(kind.__doc__ or "").partition("\n\n")[0]),
            "type": "object",
            "properties": properties,
            "required": [name for name in properties if name not in optional],
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{kind.__name__}"}


def _properties(kind: Any, found: dict[str, Schema]) -> dict[str, Schema]:
    hints, words = get_type_hints(kind, include_extras=True), _words(kind)
    by_name = {one.name: _of(hints[one.name], found) for one in fields(kind)}
    if kind is ExperimentConfig:
        texts: Schema = {"type": "object", "additionalProperties": TEXT}
        by_name |= {"rules": texts, "start": texts}
    if kind is RankedRollout:
        by_name["robustness"] = _or_null(by_name["robustness"])
    if kind is Estimate:
        unbiased = {name: by_name.pop(f"unbiased_{name}") for name in ("probability", "std_error")}
        by_name |= {
            "warnings": _array(TEXT, "The texts of the diagnostics."),
            "interval_caveats": _array(TEXT, "Why ci_low and ci_high are no interval; empty: are."),
            "try_next": {**TEXT, "description": "What to do where they are none."},
            "unbiased": {
                "type": "object",
                "properties": unbiased,
                "required": list(unbiased),
                "additionalProperties": False,
                "description": words.get("unbiased_probability", ""),
            },
        }
    told = {name: {"description": words[name]} if name in words else {} for name in by_name}
    return {name: {**schema, **told[name]} for name, schema in by_name.items()}


def _words(kind: type) -> dict[str, str]:
    """What a dataclass's docstring, or the text beneath a field, says of each."""
    section = ATTRIBUTES.search(inspect.cleandoc(kind.__doc__ or ""))
    listed = ATTRIBUTE.finditer(section["lines"]) if section else ()
    told = {one["name"]: " ".join(one["words"].split()) for one in listed}
    whole = _words(SUMMARY_OF[kind]) if kind in SUMMARY_OF else {}
    own = {name: _plain(words) for name, words in {**told, **field_docs(kind)}.items()}
    return {**whole, **own}


def _plain(words: str) -> str:
    named = MARKUP.sub(lambda found: found[1] or found[2], words)
    return NOTHING.sub("null", " ".join(named.split()))


def _array(items: Schema, words: str = "") -> Schema:
    return {"type": "array", "items": items, **({"description": words} if words else {})}


def _or_null(schema: Schema) -> Schema:
    if isinstance(schema.get("type"), str):
        return {**schema, "type": [schema["type"], "null"]}
    if "enum" in schema:
        return {"enum": [*schema["enum"], None]}
    return {"anyOf": [schema, {"type": "null"}]}


def _limits(limits: Range) -> Schema:
    low, high = limits.low, limits.high
    return {
        **({} if low is None else {"exclusiveMinimum" if limits.low_open else "minimum": low}),
        **({} if high is None else {"exclusiveMaximum" if limits.high_open else "maximum": high}),
    }


if __name__ == "__main__":
    print(json.dumps(result_schema(), indent=1, ensure_ascii=False))
