"""Weighted outcomes summed over equal gaps, some rollouts at a time."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray


@dataclass(frozen=True)
class OutcomeSums:
    """What outcomes so far weigh at each gap. A sum's terms are added in the outcomes' order.

    Attributes:
        gap_m: Distinct gaps, ascending ``[U]``.
        detected: Weight of 'detected' at each, ``[U]``.
        missed: Weight of 'missed' at each, ``[U]``.
    """

    gap_m: FloatArray
    detected: FloatArray
    missed: FloatArray

    @staticmethod
    def of_none() -> "OutcomeSums":
        """Before the first rollout."""
        return OutcomeSums(np.empty(0), np.empty(0), np.empty(0))

    def with_rollouts(
        self, *, gap_m: FloatArray, detected: BoolArray, rollout_weight: FloatArray
    ) -> Self:
        """With outcomes ``[N, T-1]`` of rollouts with weights ``[N]``: the same as all at once."""
        steps = detected.shape[1]
        weight = np.repeat(rollout_weight / steps, steps)
        some, index = np.unique(gap_m.ravel(), return_inverse=True)
        distinct = np.union1d(self.gap_m, some)
        before = np.searchsorted(distinct, self.gap_m)
        at = np.concatenate([before, np.searchsorted(distinct, some)[index]])
        hit = detected.ravel()
        return type(self)(
            gap_m=distinct,
            detected=_sum_by(at, (self.detected, weight * hit), distinct.size),
            missed=_sum_by(at, (self.missed, weight * ~hit), distinct.size),
        )


def _sum_by(index: AnyArray, weights: tuple[FloatArray, FloatArray], size: int) -> FloatArray:
    """Sums go on where they were: the first weights are those sums."""
    found = np.bincount(index, weights=np.concatenate(weights), minlength=size)
    return np.asarray(found, dtype=np.float64)
