"""A sweep as one table, a row a run: CSV for people, Parquet for programs."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from pemviz.reports.escape import printable_line
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sweep.carry_out import RunState
from pemviz.sweep.fields import field_annotations, value_type
from pemviz.sweep.folders import RUNS
from pemviz.sweep.plan import Plan

FIGURES = (
    "probability", "log10_probability", "std_error", "ci_low", "ci_high", "failures", "ess",
    "pareto_k", "max_weight_share", "rollouts_simulated",
)  # fmt: skip
"""Of an :class:`~pemviz.types.Estimate`, those that the table has."""
CAVEATS = "interval_caveats"
"""Why ``ci_low`` and ``ci_high`` are no 95 % interval; empty if they are one."""
WHOLE = ("failures", "rollouts_simulated")
TEXTS = ("status", "message", "run_folder")
KINDS: dict[type | None, str] = {bool: "bool", int: "int64", float: "float64"}

Cell = str | int | float | bool | None
Row = dict[str, Cell]


def columns(plan: Plan) -> dict[str, str]:
    """Names and types of the table's columns: varied fields, seed, figures, status."""
    annotations = field_annotations()
    varied = {name: KINDS.get(value_type(annotations[name]), "string") for name in plan.fields}
    figures = {name: "int64" if name in WHOLE else "float64" for name in FIGURES}
    return {**varied, "seed": "int64", **figures, **dict.fromkeys((CAVEATS, *TEXTS), "string")}


def rows(plan: Plan, states: Sequence[RunState]) -> list[Row]:
    """A row for every run, in the plan's order; ``None`` where a figure is undefined."""
    return [_row(plan, state) for state in states]


def _row(plan: Plan, state: RunState) -> Row:
    chosen = dict(state.planned.setting)
    row: Row = {name: chosen[name] for name in plan.fields}
    row["seed"] = state.planned.config.seed
    for name in FIGURES:
        row[name] = None if state.estimate is None else getattr(state.estimate, name)
    row[CAVEATS] = None if state.estimate is None else "; ".join(interval_caveats(state.estimate))
    row["status"] = state.status
    row["message"] = None if state.message is None else printable_line(state.message)
    row["run_folder"] = f"{RUNS}/{state.planned.name}"
    return row


def csv_text(plan: Plan, table: Sequence[Row]) -> str:
    """The table as CSV with a header; numbers with all their digits, undefined ones empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = list(columns(plan))
    writer.writerow(names)
    writer.writerows([_cell(row[name]) for name in names] for row in table)
    return stream.getvalue()


def _cell(value: Cell) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def parquet_bytes(plan: Plan, table: Sequence[Row]) -> bytes:
    """The table as a Parquet file; undefined figures are null."""
    import pyarrow as pa  # noqa: PLC0415  slow to import
    from pyarrow import parquet  # noqa: PLC0415

    types: dict[str, Any] = {
        "bool": pa.bool_(),
        "int64": pa.int64(),
        "float64": pa.float64(),
        "string": pa.string(),
    }
    schema = pa.schema([(name, types[kind]) for name, kind in columns(plan).items()])
    stream = io.BytesIO()
    parquet.write_table(pa.Table.from_pylist(list(table), schema=schema), stream)
    return stream.getvalue()
