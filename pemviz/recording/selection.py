"""Which rollouts of a stage a recording keeps."""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.types import RolloutBatch

ROLLOUT_LIMIT = 3000
SMALLEST_STAGE = 10
LEAST_ROBUST_SHARE = 4


@dataclass(frozen=True)
class Quota:
    """How many rollouts of a run are kept.

    Attributes:
        per_stage: At most this many of each stage; ``None`` keeps all.
    """

    per_stage: int | None

    def describe(self) -> str:
        """One sentence for the recording."""
        if self.per_stage is None:
            return "Every rollout is recorded."
        return (
            f"There are too many rollouts to record them all: of a stage with more than "
            f"{self.per_stage}, the {self.per_stage // LEAST_ROBUST_SHARE} least robust and an "
            f"even sample of {self.per_stage - self.per_stage // LEAST_ROBUST_SHARE} others "
            f"are recorded. Figures and texts count all of them."
        )


def unvaried(rollouts: RolloutBatch) -> frozenset[str]:
    """Signals that are the same in all rollouts, if others differ: what is missed does not matter.

    Where all signals are the same, as without a miss, nothing is known of any.
    """
    same = {name for name, values in rollouts.signals.items() if not np.any(values != values[:1])}
    return frozenset() if len(same) == len(rollouts.signals) else frozenset(same)


def quota(*, rollouts: int, stages: int, limit: int = ROLLOUT_LIMIT) -> Quota:
    """The quota of a repetition with so many rollouts in so many stages."""
    if rollouts <= limit:
        return Quota(per_stage=None)
    return Quota(per_stage=max(SMALLEST_STAGE, limit // max(stages, 1)))


def choose(robustness: FloatArray, kept: Quota, *, even: BoolArray | None = None) -> IntArray:
    """Indices of the kept rollouts ``[M]`` among ``[N]``, most robust first.

    A viewer draws in this order, so that the least robust end up on top.

    Args:
        robustness: ``[N]``.
        kept: How many.
        even: Which of the N are an even sample of more, ``[N]``, where the others are not.
    """
    order = np.argsort(-robustness, kind="stable").astype(np.int64)
    limit = kept.per_stage
    if limit is None or order.size <= limit:
        return order
    least = limit // LEAST_ROBUST_SHARE
    others = np.sort(order[: order.size - least])
    if even is not None:
        others = others[even[others]]
    places = np.linspace(0, others.size - 1, limit - least).round().astype(np.int64)
    chosen = np.zeros(order.size, dtype=np.bool_)
    chosen[others[places]] = True
    chosen[order[order.size - least :]] = True
    return order[chosen[order]]
