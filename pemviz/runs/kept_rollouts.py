"""Which rollouts a run folder keeps: all, or those that anyone will look at.

A million rollouts of a hundred states take 4 GB, of which an answer rests on the violations alone,
and views show those and the least robust. A stage that is learned from is kept whole, or as far as
it is held at all.
"""

import numpy as np

from pemviz.arrays import IntArray
from pemviz.config import KeepName
from pemviz.runs.result import rank_rollouts
from pemviz.types import StageResult


def kept_rows(stage: StageResult, keep: KeepName) -> IntArray | None:
    """Rows of a stage's rollouts that its file holds, ascending; ``None``: all, unnumbered.

    Every rollout that a result may list is among them: the least robust, by each rule too.
    """
    if keep == "all":
        return None
    scored = stage.scored
    if stage.kind != "final":
        return np.arange(scored.rollouts.count, dtype=np.int64)
    chosen = scored.violated.copy()
    for rule in (None, *scored.rule_robustness):
        chosen[[one.rollout for one in rank_rollouts(stage, rule=rule)]] = True
    return np.flatnonzero(chosen).astype(np.int64)
