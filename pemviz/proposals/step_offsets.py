"""Proposals that look at the step alone: each has a number of its own that raises a miss's logit.

Failures that need misses at certain steps, whatever else happens, are drawn by these and by hardly
any polynomial of the state: between the steps that a few violations tell of it leads anywhere. They
are what the cross-entropy method fits to independent outcomes (Rubinstein, Kroese 2004, chapter 3),
at the steps alone where outcomes clearly are others than the error model's.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import FloatArray, IntArray, softplus
from pemviz.proposals.offset_logistic import LARGEST_SHIFT
from pemviz.proposals.offset_logistic_fit import LARGEST_LEVERAGE, WeightedOutcomes

RIDGE = 0.3
"""Penalty of an offset a is ``RIDGE * a^2 / 2`` [nats]."""
NEWTON_STEPS, LARGEST_STEP, SMALL = 30, 2.0, 1e-6


@dataclass(frozen=True)
class StepOffsets:
    """Offsets, and how well they tell the outcomes that they are fitted to.

    Attributes:
        offsets: By how much a miss's logit is raised at each step, ``[T-1]``; 0 at most of them.
        miss: Probability of a miss in each of M outcomes, ``[M]``.
        log_likelihood: Of the outcomes by their weights, each rollout left out of the fit once
            [nats].
        optimism: By how much the fit overstates the log likelihood of each of N rollouts, ``[N]``
            [nats].
        loss: Mean loss, penalty included [nats a decision].
    """

    offsets: FloatArray
    miss: FloatArray
    log_likelihood: float
    optimism: FloatArray
    loss: float


def fit_step_offsets(
    outcomes: WeightedOutcomes, *, step: IntArray, steps: int, group: IntArray, count: int
) -> StepOffsets:
    """The offsets that outcomes ask for: at a step only where they win 2 log (T - 1) nats.

    By chance fewer than one in T - 1 fits have such a step, so that what it flatters, more than
    leaving rollouts out one by one tells, counts for nothing. With half as many nats estimates were
    3 % low.

    Args:
        outcomes: What is learned from.
        step: Which of its rollout's outcomes each is, ``[M]``.
        steps: Outcomes of a rollout, T - 1.
        group: Which of ``count`` rollouts each belongs to, ``[M]``; weights are equal within one.
        count: N.
    """

    def summed(values: FloatArray) -> FloatArray:
        return np.bincount(step, weights=values, minlength=steps).astype(np.float64)

    def cross_entropy(logit: FloatArray) -> FloatArray:
        return softplus(np.where(outcomes.missed, -logit, logit))

    weight, offset, offsets = outcomes.weight, outcomes.offset, np.zeros(steps)
    for _ in range(NEWTON_STEPS):
        miss = expit(offset + offsets[step])
        pull = summed(weight * (outcomes.missed - miss)) - RIDGE * offsets
        change = pull / (summed(weight * miss * (1.0 - miss)) + RIDGE)
        offsets += change.clip(-LARGEST_STEP, LARGEST_STEP)
        offsets = offsets.clip(-LARGEST_SHIFT, LARGEST_SHIFT)
        if np.abs(change).max(initial=0.0) < SMALL:
            break
    gain = summed(weight * (cross_entropy(offset) - cross_entropy(offset + offsets[step])))
    offsets = np.where(gain > 2.0 * math.log(max(steps, 2)), offsets, 0.0)
    miss, entropy = expit(offset + offsets[step]), cross_entropy(offset + offsets[step])
    by_outcome = weight * miss * (1.0 - miss)
    curvature = summed(by_outcome) + RIDGE
    # as leave_one_out_loss has it, of models of one coefficient
    leverage = (by_outcome / curvature[step]).clip(0.0, LARGEST_LEVERAGE)
    lost = weight * (outcomes.missed - miss) ** 2 / curvature[step]
    lost *= (offsets != 0.0)[step] * (1.0 - 0.5 * leverage) / (1.0 - leverage) ** 2
    optimism = np.bincount(group, weights=lost, minlength=count).astype(np.float64)
    of_each = np.zeros(count)
    of_each[group] = weight
    loss = float(weight @ entropy)
    return StepOffsets(
        offsets=offsets,
        miss=miss,
        log_likelihood=-loss - float(of_each @ optimism),
        optimism=optimism,
        loss=(loss + 0.5 * RIDGE * float(offsets @ offsets)) / max(float(weight.sum()), 1e-300),
    )
