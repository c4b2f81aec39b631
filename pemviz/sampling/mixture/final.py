"""A large final batch: of its violations the weights, as all its proposals are known before."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray, log_sum_exp
from pemviz.sampling.mixture.aims import Rule
from pemviz.sampling.mixture.draws import PILOTS

ROWS_AT_ONCE = 1 << 14
"""Of ratios, whose exponentials take several times their own memory."""
MORE_THAN_HALF = 0.5


@dataclass(frozen=True)
class Planned:
    """Logs of the shares of rollouts that are drawn from each component, once all are.

    Attributes:
        of_all: ``[1 + K]``.
        of_final: Of the final batch alone, ``[1 + K]``.
    """

    of_all: FloatArray
    of_final: FloatArray

    @staticmethod
    def of(
        sizes: Sequence[int],
        components: Callable[[int], IntArray],
        *,
        before: IntArray,
        proposals: int,
    ) -> "Planned":
        """Before any of the parts is drawn, or between two.

        Args:
            sizes: Of the final batch's parts.
            components: What each rollout of a part is drawn from, by its size.
            before: Likewise of each rollout before the final batch.
            proposals: K.
        """
        columns = 1 + proposals
        final = np.zeros(columns, dtype=np.int64)
        for size, times in Counter(sizes).items():
            final += times * np.bincount(components(size), minlength=columns)
        return Planned(
            of_all=log_shares(final + np.bincount(before, minlength=columns)),
            of_final=log_shares(final),
        )


@dataclass(frozen=True)
class FailingWeights:
    """Weights of violating final rollouts until each rule is broken, and until any is (``None``).

    Attributes:
        rollout: Index of each in the pool, ascending, ``[F]``.
        log_weight: As draws from the mixture of all stages, ``[F]``.
        among_final: As draws from the final batch's own, ``[F]``.
        by_pilots: Whether pilots are most of what could draw it, ``[F]``.
    """

    rollout: IntArray
    log_weight: Mapping[Rule, FloatArray]
    among_final: Mapping[Rule, FloatArray]
    by_pilots: Mapping[Rule, BoolArray]

    @staticmethod
    def of(
        rollout: IntArray, log_ratio: Mapping[Rule, FloatArray], planned: Planned
    ) -> "FailingWeights":
        """From the log ratios ``[F, 1 + K]`` under each rule."""
        ratios = log_ratio.items()
        return FailingWeights(
            rollout=rollout,
            log_weight={rule: weights(ratio, planned.of_all) for rule, ratio in ratios},
            among_final={rule: weights(ratio, planned.of_final) for rule, ratio in ratios},
            by_pilots={rule: mostly_by_pilots(ratio, planned.of_all) for rule, ratio in ratios},
        )


def log_shares(counts: IntArray) -> FloatArray:
    """Log of the share n_k / N of rollouts drawn from each of K components, ``[K]``."""
    with np.errstate(divide="ignore"):  # a proposal that nothing was drawn from does not count
        return np.log(counts / counts.sum())


def weights(log_ratio: FloatArray, shares: FloatArray) -> FloatArray:
    """-log sum_k exp(share_k + log_ratio_k) for ratios ``[H, K]`` and log shares ``[K]``."""
    found = np.empty(len(log_ratio))
    for first in range(0, len(log_ratio), ROWS_AT_ONCE):
        rows = slice(first, first + ROWS_AT_ONCE)
        found[rows] = -np.asarray(log_sum_exp(log_ratio[rows] + shares, axis=1))
    return found


def mostly_by_pilots(log_ratio: FloatArray, shares: FloatArray) -> BoolArray:
    """Whether pilots are most of what could draw each of ``[H]`` rollouts."""
    log_joint = log_ratio + shares
    by_pilots = np.exp(log_joint[:, PILOTS] - np.asarray(log_sum_exp(log_joint, axis=1)))
    return by_pilots > MORE_THAN_HALF
