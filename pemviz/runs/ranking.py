"""All rollouts of a kept run in the order in which its result ranks them."""

from collections.abc import Mapping, Sequence

import numpy as np

from pemviz.analysis.causes import carrying, contributions
from pemviz.arrays import AnyArray, BoolArray, IntArray
from pemviz.runs.result import StageSummary, weighty_stages
from pemviz.runs.rollout_files import log_weights


def ranked_rows(table: Mapping[str, AnyArray], stages: Sequence[StageSummary]) -> IntArray:
    """Rows ``[N]`` of a table of rollouts, first ranks first.

    Those that carry the estimate come before the others, each by robustness: the first are
    :attr:`pemviz.runs.result.RunResult.least_robust`.

    Args:
        table: Under the keys of ``rollouts.npz``, stages in order.
        stages: The run's.

    Raises:
        ValueError: Latents do not fit together.
    """
    robustness = np.asarray(table["robustness"], dtype=np.float64)
    return np.lexsort((robustness, ~_carries(table, stages))).astype(np.int64)


def _carries(table: Mapping[str, AnyArray], stages: Sequence[StageSummary]) -> BoolArray:
    """Which rollouts ``[N]`` are among those that carry the estimate of a stage that counts."""
    carries = np.zeros(table["violated"].shape, dtype=np.bool_)
    log_weight = log_weights(table)
    for repetition, stage in weighty_stages(stages):
        rows = np.flatnonzero((table["repetition"] == repetition) & (table["stage"] == stage))
        if rows.size == 0:
            continue
        violated = np.asarray(table["violated"][rows], dtype=np.bool_)
        carries[rows] = carrying(contributions(log_weight[rows], violated=violated))
    return carries
