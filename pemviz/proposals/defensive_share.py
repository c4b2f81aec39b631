"""Mixing a proposal with the error model, outcome by outcome."""

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.types import outcome_log_likelihood

LARGEST_SHARE = 0.1


def share_for(*, drawn_steps: float, steps: int) -> float:
    """The share with which ``drawn_steps`` of a rollout's ``steps`` come from the error model."""
    return min(drawn_steps / steps, LARGEST_SHARE)


def defended(logit: FloatArray, pem_logit: FloatArray, *, share: float) -> FloatArray:
    """The mixture of a proposal (weight 1 - share) and the error model (share), as logits.

    Hesterberg's defensive mixture (1995), applied to every outcome: a single outcome's
    weight is at most 1 / share, whatever the proposal. ``share`` lies in (0, 1).
    """
    sides: list[FloatArray] = []
    for hit in (True, False):
        detected = np.full(logit.shape, hit)
        sides.append(
            np.logaddexp(
                np.log1p(-share) + outcome_log_likelihood(logit, detected),
                np.log(share) + outcome_log_likelihood(pem_logit, detected),
            )
        )
    return sides[0] - sides[1]
