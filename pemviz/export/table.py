"""A rollout as a table, a row a state: CSV for people, Parquet for programs.

Columns: which rollout it is (``run_id`` to ``violated``, and ``broken.NAME`` for each rule), the
same in all rows, so that tables of several rollouts can be put below each other; ``step``;
``time_s`` of the shipped scenario (a run folder does not tell the time step of other
simulators); each signal under its key; the outcome at that step, ``detected``, with its log
likelihoods ``log_p`` under the error model and ``log_q`` under what it was drawn from [nats]. Of
several slots each has these three, ``detected.NAME``. Of a scenario with latents each one,
``latents.start.0``, and the mean that it was drawn with, ``latents.start_mean.0``; those at the
start are the same in all rows; of noise also how likely it was to be moved,
``latents.noise_share``, and its spread then. At the last state perception does not act: what
belongs to a step is empty there.
"""

import csv
import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from pemviz.arrays import AnyArray
from pemviz.export.rollout import PER_OUTCOME, RankedRollout

SHARE = "noise_share"
Column = list[Any]
METADATA = b"pemviz"
"""Key of a Parquet file's metadata under which the run's settings stand as JSON."""


def columns(rollout: RankedRollout) -> dict[str, Column]:
    """The table's columns, ``T`` values each; ``None`` where there is none."""
    states = rollout.states
    same: dict[str, Any] = {
        "run_id": rollout.result.run_id,
        "rank": rollout.rank,
        "repetition": rollout.repetition,
        "stage": rollout.stage,
        "rollout": rollout.rollout,
        "robustness": rollout.robustness,
        "violated": rollout.violated,
        **{f"broken.{name}": broken for name, broken in rollout.broken.items()},
    }
    table: dict[str, Column] = {name: [value] * states for name, value in same.items()}
    table["step"] = list(range(states))
    if rollout.scenario is not None:
        table["time_s"] = (np.arange(states) * rollout.scenario.dt_s).tolist()
    table |= {name: values.tolist() for name, values in rollout.signals.items()}
    for slot in rollout.detected:
        for name in PER_OUTCOME:
            values: Mapping[str, AnyArray] = getattr(rollout, name)
            table[f"{name}.{slot}" if slot else name] = [*values[slot].tolist(), None]
    for name, latents in rollout.latents.items():
        if name == SHARE:  # one for all latents of a step
            table[f"latents.{name}"] = [*latents.tolist(), None]
            continue
        for place in range(latents.shape[-1]):
            drawn: Any = latents[..., place].tolist()
            cells = [drawn] * states if latents.ndim == 1 else [*drawn, None]
            table[f"latents.{name}.{place}"] = cells
    return table


def csv_bytes(rollout: RankedRollout) -> bytes:
    """The table as CSV in UTF-8 with a header; numbers with all their digits."""
    table = columns(rollout)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table)
    writer.writerows([_cell(value) for value in row] for row in zip(*table.values(), strict=True))
    return stream.getvalue().encode("utf-8")


def _cell(value: str | int | float | bool | None) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def parquet_bytes(rollout: RankedRollout) -> bytes:
    """The table as a Parquet file, beside it the run's settings as JSON."""
    import pyarrow as pa  # noqa: PLC0415  slow to import
    from pyarrow import parquet  # noqa: PLC0415

    table = pa.table(columns(rollout))
    settings = json.dumps(_settings(rollout), ensure_ascii=False).encode("utf-8")
    stream = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({METADATA: settings}), stream)
    return stream.getvalue()


def _settings(rollout: RankedRollout) -> dict[str, Any]:
    """What the run asked, as far as the rollout's figures hang on it."""
    config, pem = rollout.result.config, rollout.result.pem
    return {
        "simulator": config.simulator,
        "spec": config.spec,
        "rules": {rule.name: rule.formula for rule in config.rules},
        "metric": config.metric,
        "method": config.method,
        "pem": pem.name,
        "pem_digest": pem.digest,
        "memory_s": config.memory_s,
        "frailty": config.frailty,
        "seed": config.seed,
    }
