"""Which rollouts carry an estimate, and how much of it each contributes."""

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.sampling.estimates.importance_weights import log_sum

CARRIED = 0.99
"""The part of an estimate that its carrying rollouts make up together."""


def contributions(log_weight: FloatArray, *, violated: BoolArray) -> FloatArray:
    """The share ``[N]`` of the estimate that each rollout contributes.

    Args:
        log_weight: Log importance weights ``[N]`` [nats]; up to a constant that all share.
        violated: Which rollouts violate, ``[N]``; the others contribute nothing.

    Returns:
        Shares that sum to 1, or to 0 if nothing violates.
    """
    share = np.zeros(violated.shape)
    if violated.any():
        failing = log_weight[violated]
        share[violated] = np.exp(failing - log_sum(failing))
    return share


def carrying(share: FloatArray, *, part: float = CARRIED) -> BoolArray:
    """The rollouts ``[N]`` of largest share that together contribute ``part`` of the estimate.

    Rollouts of equal share are all among them or none is.

    A violation that hardly ever happens, such as a pile-up of misses that an early proposal
    drew, violates most but is not among them.
    """
    descending = np.sort(share)[::-1]
    before = np.concatenate([[0.0], np.cumsum(descending)[:-1]])
    needed = descending[(before < part) & (descending > 0.0)]
    return share >= needed[-1] if needed.size else np.zeros(share.shape, dtype=np.bool_)
