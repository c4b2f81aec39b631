"""All rollouts of a kept run as one table, for data frames of any library."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pemviz.arrays import AnyArray, FloatArray, IntArray
from pemviz.files.array_files import map_arrays
from pemviz.runs.reading import read_whole_run
from pemviz.runs.result import RunResult
from pemviz.runs.risk_budget import LOG_WEIGHT
from pemviz.runs.rollout_files import ROLLOUT, ROLLOUTS_FILE, load_rollouts, log_weights
from pemviz.sampling.registry import by_name

if TYPE_CHECKING:
    import pyarrow as pa

FIRST = ("repetition", "stage", ROLLOUT, "robustness", "violated")


def read_rollouts(folder: Path | str) -> "pa.Table":
    """A row for each rollout that a run folder keeps: a ``pyarrow.Table``.

    Its ``to_pandas()`` and ``polars.from_arrow`` make data frames of it. Columns are
    ``repetition``, ``stage``, ``rollout`` (its index in the stage), ``robustness``, ``violated``,
    ``broken.RULE`` of each rule, ``log_weight`` [nats], and lists over a rollout's steps: signals
    by their keys (``gap_m``), outcomes ``detected``, latents, log likelihoods ``log_p`` under the
    error model and ``log_q`` under what it was sampled from [nats].

    The answer is the sum of ``exp(log_weight)`` over the rollouts that violate. NaN are those that
    it does not rest on, and some that hold. The column is absent where the answer is no such sum,
    and of a run that is not done.

    Raises:
        InputError: The folder's run cannot be read, or has no rollouts.

    Example:
        >>> import pemviz
        >>> from pemviz.files.shipped import sample_run
        >>> table = pemviz.read_rollouts(sample_run())
        >>> table.num_rows, table.column_names[:5]
        (177, ['repetition', 'stage', 'rollout', 'robustness', 'violated'])
    """
    import pyarrow as pa  # noqa: PLC0415  slow to import

    folder = Path(folder)
    result, kept = read_whole_run(folder), load_rollouts(folder)
    arrays: dict[str, AnyArray] = {**kept, ROLLOUT: kept.get(ROLLOUT, _numbers(kept))}
    log_weight = _log_weight(folder, result, kept)
    if log_weight is not None:
        arrays["log_weight"] = log_weight
    single = [name for name, values in arrays.items() if values.ndim == 1 and name not in FIRST]
    lists = [name for name, values in arrays.items() if values.ndim > 1]
    return pa.table({name: _column(arrays[name]) for name in (*FIRST, *single, *lists)})


def _numbers(kept: Mapping[str, AnyArray]) -> IntArray:
    """Each rollout's index in its stage, where all are kept."""
    stages = np.stack([kept["repetition"], kept["stage"]], axis=1)
    begins = np.r_[True, (np.diff(stages, axis=0) != 0).any(axis=1)]
    row = np.arange(len(stages))
    return row - np.maximum.accumulate(np.where(begins, row, 0))


def _log_weight(folder: Path, result: RunResult, kept: Mapping[str, AnyArray]) -> FloatArray | None:
    """What each rollout adds to the estimate if it violates, ``[N]`` [nats]."""
    if result.status != "done" or result.estimate is None:
        return None
    if by_name(result.estimate.method).interval_basis == "runs":
        return None
    found = map_arrays(folder / ROLLOUTS_FILE).get(LOG_WEIGHT)
    if found is None:  # the last stage alone is averaged
        final = {(s.repetition, s.stage) for s in result.stages if s.kind == "final"}
        places = zip(kept["repetition"].tolist(), kept["stage"].tolist(), strict=True)
        averaged = np.array([place in final for place in places], dtype=np.bool_)
        found = np.where(averaged, log_weights(kept), np.nan)
    counts = np.array([each.rollouts_in_estimate for each in result.repetitions])
    return np.asarray(found) - np.log(len(counts) * counts)[kept["repetition"]]


def _column(values: AnyArray) -> Any:
    """An array ``[N, ...]`` as a column of numbers, or of lists, of lists of lists."""
    import pyarrow as pa  # noqa: PLC0415  slow to import

    column = pa.array(np.ascontiguousarray(values).ravel())
    for size in reversed(values.shape[1:]):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column
