"""Mixing a proposal with the error model, outcome by outcome."""

import numpy as np

from pemviz.arrays import FloatArray, namespace

LARGEST_SHARE = 0.1


def share_for(*, drawn_steps: float, steps: int) -> float:
    """The share with which ``drawn_steps`` of a rollout's ``steps`` come from the error model."""
    return min(drawn_steps / steps, LARGEST_SHARE)


def defended(logit: FloatArray, pem_logit: FloatArray, *, share: float) -> FloatArray:
    """The mixture of a proposal (weight 1 - share) and the error model (share), as logits.

    Hesterberg's defensive mixture (1995), applied to every outcome: a single outcome's
    weight is at most 1 / share, whatever the proposal. ``share`` lies in (0, 1).
    """
    xp = namespace(logit)
    detected, missed = (
        xp.logaddexp(
            _log_expit(sign * logit) + float(np.log1p(-share)),
            _log_expit(sign * pem_logit) + float(np.log(share)),
        )
        for sign in (1.0, -1.0)
    )
    return detected - missed


def _log_expit(logit: FloatArray) -> FloatArray:
    xp = namespace(logit)
    return -xp.logaddexp(-logit, xp.zeros_like(logit))
