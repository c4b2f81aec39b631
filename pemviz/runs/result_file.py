"""``result.json``: the one place that writes a run's result to its folder and reads it back.

What a result.json may hold (schema 2):

- One JSON object in UTF-8, of at most 100 MB, strict: null where a figure is undefined or
  infinite, never NaN or Infinity.
- ``schema``, which is 2, and the fields of :class:`pemviz.runs.result.RunResult`, each with the
  type and the range that its annotation states; null only where that says ``None``.
- ``seed``, the configuration's, for scripts that look for it.
- An estimate's unbiased figures in a table ``unbiased`` of ``probability`` and ``std_error``,
  and its ``warnings``, the texts of its ``diagnostics``.
- Beside ``confidence`` an estimate's ``interval_caveats``: why ``ci_low`` and ``ci_high`` are no
  interval at that level, in words; empty if they are one. If not, ``try_next``: what to do.
  They follow from the rest of the document and are not kept when it is read.
- The :class:`~pemviz.analysis.explanation.Explanation` as two entries, both null without one:
  ``sensitivity``, and its other fields under ``causes``.
- ``measured`` in ``memory`` and in ``rules`` where the answer was looked at with memories that were
  measured, else ``unmeasured`` in ``memory``: why not; neither in older results.
- ``check`` in ``memory`` only where the error model's card tells of predictive checks.
- ``rules``, ``least_robust_by_rule``, and ``broken`` in ``least_robust``, only where there are
  rules.
- ``starts`` (:mod:`pemviz.analysis.starts`), only where the simulator names random ones.
- ``lost``, only where rollouts could not be simulated to their end.
- ``surrogate``, only where proposals were learned on one.
- ``per_hour``, only where encounters an hour are given, or ``per_km``, only where ``driven`` is
  (:mod:`pemviz.runs.rates`), follows from the estimates too.
- ``uncertainty``, what leaves the answer open
  (:class:`pemviz.runs.uncertainty.UncertaintySource`): it follows from the other fields, which are
  what is read. Older results have it as ``ladder``.
- Null for the robustness of a rollout where it is infinite.
- ``files``, SHA-256 of files of the run folder by name: of ``config.toml``, and once the run is
  done of all that it left there.
- Last ``digest``, SHA-256 of everything before it (:func:`pemviz.files.atomic.document_digest`).
  It finds what was changed; whoever means to forge a result can compute it too.

Schema 1 is the same without these two: what older versions write, and ``record --json`` prints.

A field that has a default may be absent, as it is in results of versions that did not know it.
Entries that this version does not know are ignored, but for settings in ``config``: a setting
says what the figures mean. A result of another schema is refused.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

from pemviz.analysis.explanation import Explanation
from pemviz.analysis.sensitivity import BandSensitivity
from pemviz.config.ranges import AtLeastZero, shown
from pemviz.config.records import read_record, read_value
from pemviz.config.toml_files import config_from_table, config_table
from pemviz.errors import InputError
from pemviz.files.atomic import document_digest, file_digest, write_json
from pemviz.files.json_text import parse_json
from pemviz.runs.rates import DistanceRate, ViolationRate, distance_rates, violation_rates
from pemviz.runs.result import RankedRollout, RunResult
from pemviz.runs.uncertainty import (
    UncertaintySource,
    remedy_of,
    run_interval_caveats,
    uncertainty_budget,
)
from pemviz.sampling.estimates.diagnostics import classified
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.types import Estimate

Table = dict[str, Any]

SCHEMA, OPEN_SCHEMA = 2, 1
RESULT_FILE = "result.json"
LARGEST_BYTES = 100_000_000
DIGEST = "digest"
CHANGED = "it was changed after it was written"
SHOWN = 12
"""Of a digest in a message."""


class UnreadableResultError(InputError):
    """``result.json`` is no JSON document: empty or cut, as a power cut may leave it."""


@dataclass(frozen=True)
class KeptResult:
    """What a ``result.json`` holds.

    Attributes:
        result: The result.
        files: SHA-256 of the run's files by name; empty in older versions' results.
        fault: How its digest says that it was changed; ``None``: not at all, or it has none.
    """

    result: RunResult
    files: Mapping[str, str]
    fault: str | None


def has_result(folder: Path) -> bool:
    """Whether the run folder holds a ``result.json``."""
    return (folder / RESULT_FILE).is_file()


def read_kept(folder: Path) -> KeptResult:
    """What the ``result.json`` of a run folder holds, believed so far.

    :func:`pemviz.runs.reading.read_result` holds it to itself and to the folder's other files.

    Raises:
        UnreadableResultError: It is no JSON document.
        InputError: It cannot be opened, or holds what no run writes; one line names the field.
    """
    path = folder / RESULT_FILE
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_BYTES + 1)
        if len(content) > LARGEST_BYTES:
            raise InputError(f"result {path}: must be of at most {LARGEST_BYTES} bytes")
        document = parse_json(content.decode("utf-8"))
    except OSError as error:
        raise InputError(f"result {path}: cannot be read ({error})") from error
    except ValueError as error:
        raise UnreadableResultError(f"result {path}: cannot be read ({error})") from error
    try:
        return _kept(document)
    except InputError as error:
        raise InputError(f"result {path}: {error}") from error


def write_result(folder: Path, result: RunResult, *, files: Sequence[str] = ()) -> None:
    """Write ``result.json``, whole or not at all.

    Args:
        folder: The run folder.
        result: What is written.
        files: Names of files in it that are whole; those that are there get a digest.
    """
    there = [name for name in files if (folder / name).is_file()]
    digests = {name: file_digest(folder / name) for name in there}
    document = {**result_document(result), "schema": SCHEMA, "files": digests}
    write_json(folder / RESULT_FILE, {**document, DIGEST: document_digest(document)})


def result_document(result: RunResult) -> Table:
    """The contents of ``result.json`` as plain values, in the order in which they stand there.

    Of schema 1, which has no digests: a result may be anywhere, they belong to a run folder.
    """
    explanation = {"sensitivity": None, "causes": None}
    if result.explanation is not None:
        causes = _fields_of(result.explanation)
        explanation = {"sensitivity": causes.pop("sensitivity"), "causes": causes}
    document: Table = {
        "schema": OPEN_SCHEMA,
        "run_id": result.run_id,
        "status": result.status,
        "message": result.message,
        "seed": result.config.seed,
        "versions": dict(result.versions),
        **_unless_empty(simulator=result.simulator),
        "config": config_table(result.config),
        "pem": result.pem,
        "estimate": (
            None
            if result.estimate is None
            else _estimate_table(result, result.estimate, run_interval_caveats(result))
        ),
        **_unless_empty(
            rules=[
                {
                    **_without(_fields_of(rule), "measured"),
                    "estimate": _estimate_table(result, rule.estimate),
                }
                for rule in result.rules
            ],
            per_hour=violation_rates(result),
            per_km=distance_rates(result),
            driven=result.driven,
            lost=result.lost,
            surrogate=result.surrogate,
        ),
        "memory": (
            None
            if result.memory is None
            else _without(
                _fields_of(result.memory),
                "measured",
                "unmeasured",
                "check",
                "visibility",
                "carried",
            )
        ),
        **_unless_empty(
            latents=result.latents, position_errors=result.position_errors, starts=result.starts
        ),
        "reference": result.reference,
        "pem_interval": result.pem_interval,
        "model_classes": result.model_classes,
        "uncertainty": uncertainty_budget(result),
        "data_bound": result.data_bound,
        "plan": result.plan,
        **explanation,
        **_unless_empty(robustness_tail=result.robustness_tail),
        "repetitions": [_estimate_table(result, estimate) for estimate in result.repetitions],
        "stages": result.stages,
        "least_robust": [_ranked_table(rollout) for rollout in result.least_robust],
        **_unless_empty(
            least_robust_by_rule={
                rule: [_ranked_table(rollout) for rollout in ranked]
                for rule, ranked in result.least_robust_by_rule.items()
            }
        ),
        "assumptions": list(result.assumptions),
        "warnings": list(result.warnings),
        "timings_s": dict(result.timings_s),
    }
    return cast(Table, _strict(document))


def _without(table: Table, *names: str) -> Table:
    """The table without those of these entries that are empty."""
    return {name: value for name, value in table.items() if value or name not in names}


def _unless_empty(**entries: Any) -> Table:
    return {name: entry for name, entry in entries.items() if entry not in (None, (), [], {})}


def _estimate_table(
    result: RunResult, estimate: Estimate, caveats: Sequence[str] | None = None
) -> Table:
    table = _fields_of(estimate)
    against = interval_caveats(estimate) if caveats is None else caveats
    better = remedy_of(result, estimate.diagnostics)
    probability, std_error = table.pop("unbiased_probability"), table.pop("unbiased_std_error")
    diagnostics, confidence = table.pop("diagnostics"), table.pop("confidence")
    return {
        **table,
        "warnings": list(estimate.warnings),
        "confidence": confidence,
        "interval_caveats": list(against),
        **_unless_empty(try_next=better if against else None),
        "unbiased": {"probability": probability, "std_error": std_error},
        "diagnostics": diagnostics,
    }


def _ranked_table(rollout: RankedRollout) -> Table:
    table = _fields_of(rollout)
    if not rollout.broken:
        del table["broken"]
    return table


def _fields_of(record: Any) -> Table:
    """A dataclass's values by name, in order; those that are dataclasses stay so."""
    return {name: getattr(record, name) for name in _field_names(type(record))}


@cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(one.name for one in fields(kind))


def _strict(value: Any) -> Any:
    """``value`` with every number that JSON cannot hold replaced by null, tuples as lists.

    Dataclasses become tables.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if is_dataclass(value):
        return {name: _strict(getattr(value, name)) for name in _field_names(type(value))}
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in cast(Table, value).items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in cast(list[Any], value)]
    return value


def result_from_document(document: object) -> RunResult:
    """The inverse of :func:`result_document`, for values that may come from anywhere.

    Raises:
        InputError: It holds what no run writes.
    """
    if not isinstance(document, dict):
        raise InputError(f"is {shown(document)}, must be a JSON object")
    table = cast(Table, document)
    schema = table.get("schema")
    if isinstance(schema, bool) or schema not in (SCHEMA, OPEN_SCHEMA):
        raise InputError(
            f"schema = {shown(schema)}: must be {SCHEMA} or {OPEN_SCHEMA}; another version of "
            "pemviz wrote it"
        )
    config = config_from_table(table.get("config"), name="config")
    config.validate()
    if table.get("seed", config.seed) != config.seed:
        raise InputError(f"seed = {shown(table['seed'])}: must be that of config, {config.seed}")
    read_value(tuple[UncertaintySource, ...], table.get("uncertainty", []), name="uncertainty")
    read_value(tuple[ViolationRate, ...], table.get("per_hour", []), name="per_hour")
    read_value(tuple[DistanceRate, ...], table.get("per_km", []), name="per_km")
    by_rule = table.get("least_robust_by_rule", {})
    if isinstance(by_rule, dict):
        ranked = cast(Table, by_rule).items()
        by_rule = {name: _each(rollouts, _ranked_fields) for name, rollouts in ranked}
    values = {
        **table,
        "config": config,
        "estimate": _estimate(table.get("estimate"), "estimate"),
        "explanation": _explanation(table.get("causes"), table.get("sensitivity")),
        "repetitions": _each(table.get("repetitions", []), _estimate, "repetitions"),
        "rules": _each(table.get("rules", []), _rule_fields, "rules"),
        "least_robust": _each(table.get("least_robust", []), _ranked_fields),
        "least_robust_by_rule": by_rule,
    }
    return read_record(RunResult, values, ignore_unknown=True)


def _kept(document: object) -> KeptResult:
    """A document with its digests."""
    result = result_from_document(document)
    table = cast(Table, document)
    if table["schema"] == OPEN_SCHEMA:
        digests = [name for name in ("files", DIGEST) if name in table]
        if digests:
            message = f"schema = {OPEN_SCHEMA}: must be {SCHEMA}, as there is {digests[0]!r}"
            raise InputError(message)
        return KeptResult(result, {}, None)
    files: Mapping[str, str] = read_value(Mapping[str, str], table.get("files"), name="files")
    strange = [name for name in files if not name or name in (".", "..") or set(name) & set("/\\")]
    if strange:
        raise InputError(f"files.{strange[0]}: must be the name of a file in the run's folder")
    written = read_value(str, table.get(DIGEST), name=DIGEST)
    found = document_digest({name: value for name, value in table.items() if name != DIGEST})
    before = f"all before it gives {found[:SHOWN]!r}..."
    fault = f"{DIGEST} = {written[:SHOWN]!r}...: {before}; {CHANGED}"
    return KeptResult(result, files, None if written == found else fault)


@dataclass(frozen=True)
class _Unbiased:
    """The table ``unbiased`` of an estimate."""

    probability: AtLeastZero | None
    std_error: AtLeastZero | None


def _estimate(entry: object, name: str) -> object:
    """The estimate of a table; what is no table is left as it is."""
    if not isinstance(entry, dict):
        return entry
    table = cast(Table, entry)
    unbiased = read_record(
        _Unbiased, table.get("unbiased"), name=f"{name}.unbiased", ignore_unknown=True
    )
    values = {
        **table,
        "unbiased_probability": unbiased.probability,
        "unbiased_std_error": unbiased.std_error,
    }
    estimate = read_record(Estimate, values, name=name, ignore_unknown=True)
    read_value(tuple[str, ...], table.get("interval_caveats", []), name=f"{name}.interval_caveats")
    read_value(str, table.get("try_next", ""), name=f"{name}.try_next")
    warnings = read_value(tuple[str, ...], table.get("warnings", []), name=f"{name}.warnings")
    if "diagnostics" not in table:
        return replace(estimate, diagnostics=classified(warnings, estimate))
    if estimate.warnings != warnings:
        message = f"{name}.warnings = {shown(warnings)}: must be the texts of its diagnostics"
        raise InputError(message)
    return estimate


def _explanation(causes: object, sensitivity: object) -> Explanation | None:
    if causes is None and sensitivity is None:
        return None
    bands = read_value(
        tuple[BandSensitivity, ...], sensitivity, name="sensitivity", ignore_unknown=True
    )
    values = {**cast(Table, causes), "sensitivity": bands} if isinstance(causes, dict) else causes
    explanation = read_record(Explanation, values, name="causes", ignore_unknown=True)
    if len(bands) != len(explanation.misses_by_distance) + 1:
        raise InputError(
            f"sensitivity has {len(bands)} entries: must have one for all distances and one for "
            f"each of the {len(explanation.misses_by_distance)} of causes.misses_by_distance"
        )
    return explanation


def _rule_fields(entry: object, name: str) -> object:
    if not isinstance(entry, dict):
        return entry
    table = cast(Table, entry)
    return {**table, "estimate": _estimate(table.get("estimate"), f"{name}.estimate")}


def _ranked_fields(entry: object, _: str) -> object:
    """A ranked rollout with null, an infinite robustness, as the verdict says which."""
    if not isinstance(entry, dict) or cast(Table, entry).get("robustness", 0.0) is not None:
        return cast(object, entry)
    table = cast(Table, entry)
    return {**table, "robustness": -math.inf if table.get("violated") is True else math.inf}


def _each(entries: object, change: Callable[[object, str], object], name: str = "") -> object:
    """The list with every entry changed; what is no list is left as it is."""
    if not isinstance(entries, list):
        return entries
    numbered = enumerate(cast(list[object], entries))
    return [change(entry, f"{name}[{index}]") for index, entry in numbered]
