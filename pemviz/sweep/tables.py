"""What a sweep found: a table with a row a run (CSV, Parquet), and a page with a row a setting."""

import csv
import io
import statistics
from collections.abc import Callable, Sequence
from typing import Any

from pemviz.reports.escape import markdown_table, markdown_text, printable_line
from pemviz.sampling.estimates.diagnostics import SMALL_ESS
from pemviz.sampling.estimates.trust import interval_caveats
from pemviz.sweep.carry_out import RUNS, RunState
from pemviz.sweep.plan import Plan, Setting, field_annotations, value_text, value_type

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
NOTHING = "-"

Row = dict[str, str | int | float | bool | None]


def columns(plan: Plan) -> dict[str, str]:
    """Names and types of the table's columns: varied fields, seed, figures, status."""
    annotations = field_annotations()
    varied = {name: KINDS.get(value_type(annotations[name]), "string") for name in plan.fields}
    figures = {name: "int64" if name in WHOLE else "float64" for name in FIGURES}
    return {**varied, "seed": "int64", **figures, **dict.fromkeys((CAVEATS, *TEXTS), "string")}


def rows(plan: Plan, states: Sequence[RunState]) -> list[Row]:
    """A row for every run, in the plan's order; ``None`` where a figure is undefined."""
    found: list[Row] = []
    for state in states:
        planned, estimate = state.planned, state.estimate
        row: Row = {name: dict(planned.setting)[name] for name in plan.fields}
        row["seed"] = planned.config.seed
        row |= {n: None if estimate is None else getattr(estimate, n) for n in FIGURES}
        row[CAVEATS] = None if estimate is None else "; ".join(interval_caveats(estimate))
        row["status"] = state.status
        row["message"] = None if state.message is None else printable_line(state.message)
        row["run_folder"] = f"{RUNS}/{planned.name}"
        found.append(row)
    return found


def csv_text(plan: Plan, table: Sequence[Row]) -> str:
    """The table as CSV with a header; numbers with all their digits, undefined ones empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    names = list(columns(plan))
    writer.writerow(names)
    for row in table:
        values = [row[name] for name in names]
        writer.writerow(["" if value is None else value_text(value) for value in values])
    return stream.getvalue()


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


def by_setting(states: Sequence[RunState]) -> dict[Setting, list[RunState]]:
    """The runs grouped by setting, in their order."""
    grouped: dict[Setting, list[RunState]] = {}
    for state in states:
        grouped.setdefault(state.planned.setting, []).append(state)
    return grouped


def summary_markdown(plan: Plan, states: Sequence[RunState]) -> str:
    """The page: counts, a table of settings with their figures over the seeds, what failed."""
    count = {name: sum(s.status == name for s in states) for name in ("done", "failed", "not run")}
    header = (
        *map(markdown_text, plan.fields),
        "runs done",
        "median probability",
        "least",
        "greatest",
        "seeds without violation",
        "effective sample size",
        "largest Pareto k-hat",
        "sampling unreliable",
    )
    parts = [
        "# Sweep",
        f"{len(states)} runs: {count['done']} done, {count['failed']} failed, "
        f"{count['not run']} not run.",
        markdown_table(header, [_row(*one) for one in by_setting(states).items()]),
        "Probability: median over the seeds, and the least and greatest estimate. A seed whose "
        "rollouts held no violation counts as 0. Effective sample size: median; below "
        f"{SMALL_ESS:g}, do not quote an estimate. Sampling unreliable: runs whose interval is "
        "none at its level, so that nothing may be decided by them.",
    ]
    failed = [s for s in states if s.status == "failed"]
    if failed:
        lines = [
            f"- {markdown_text(s.planned.label)}: {markdown_text(s.message or '')}" for s in failed
        ]
        parts.append("## Failed\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _row(setting: Setting, states: Sequence[RunState]) -> tuple[str, ...]:
    estimates = [state.estimate for state in states if state.estimate is not None]
    probabilities = [e.probability for e in estimates]
    return (
        *(markdown_text(value_text(value)) for _, value in setting),
        f"{len(estimates)} of {len(states)}",
        _over(statistics.median, probabilities),
        _over(min, probabilities),
        _over(max, probabilities),
        str(sum(e.failures == 0 for e in estimates)),
        _over(statistics.median, [e.ess for e in estimates]),
        _over(max, [e.pareto_k for e in estimates]),
        f"{sum(bool(interval_caveats(e)) for e in estimates)} of {len(estimates)}",
    )


def _over(combine: Callable[[list[float]], float], values: Sequence[float | None]) -> str:
    defined = [value for value in values if value is not None]
    return f"{combine(defined):.3g}" if defined else NOTHING
