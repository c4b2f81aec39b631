"""An estimate as a table of ``result.json``, and back."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, cast

from pemviz.config.ranges import AtLeastZero, shown
from pemviz.config.records import read_record, read_value
from pemviz.errors import InputError
from pemviz.sampling.estimates.diagnostics import classified
from pemviz.types import Estimate

Table = dict[str, Any]


@dataclass(frozen=True)
class _Unbiased:
    """The table ``unbiased`` of an estimate."""

    probability: AtLeastZero | None
    std_error: AtLeastZero | None


def estimate_table(estimate: Estimate, *, caveats: Sequence[str]) -> Table:
    """An estimate as ``result.json`` has it."""
    table = fields_of(estimate)
    probability, std_error = table.pop("unbiased_probability"), table.pop("unbiased_std_error")
    diagnostics, confidence = table.pop("diagnostics"), table.pop("confidence")
    return {
        **table,
        "warnings": list(estimate.warnings),
        "confidence": confidence,
        "interval_caveats": list(caveats),
        "unbiased": {"probability": probability, "std_error": std_error},
        "diagnostics": diagnostics,
    }


def estimate_of(entry: object, *, name: str) -> object:
    """The estimate of a table; what is no table is left as it is.

    Raises:
        InputError: The table holds what no run writes.
    """
    if not isinstance(entry, dict):
        return entry
    table = cast(Table, entry)
    unbiased = read_record(
        _Unbiased, table.get("unbiased"), name=f"{name}.unbiased", ignore_unknown=True
    )
    estimate = read_record(
        Estimate,
        {
            **table,
            "unbiased_probability": unbiased.probability,
            "unbiased_std_error": unbiased.std_error,
        },
        name=name,
        ignore_unknown=True,
    )
    read_value(tuple[str, ...], table.get("interval_caveats", []), name=f"{name}.interval_caveats")
    warnings = read_value(tuple[str, ...], table.get("warnings", []), name=f"{name}.warnings")
    if "diagnostics" not in table:
        return replace(estimate, diagnostics=classified(warnings, estimate))
    if estimate.warnings != warnings:
        message = f"{name}.warnings = {shown(warnings)}: must be the texts of its diagnostics"
        raise InputError(message)
    return estimate


def fields_of(record: Any) -> Table:
    """A dataclass's values by name, in order; those that are dataclasses stay so."""
    return {name: getattr(record, name) for name in field_names(type(record))}


@cache
def field_names(kind: Any) -> tuple[str, ...]:
    """The names of a dataclass's fields, in order."""
    return tuple(one.name for one in fields(kind))
