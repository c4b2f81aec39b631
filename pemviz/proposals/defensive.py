"""Defensive mixtures: a share of a proposal stays with the error model (Hesterberg 1995)."""

import numpy as np

from pemviz.arrays import FloatArray

LARGEST_SHARE = 0.1


def share_for(*, drawn_steps: float, steps: int) -> float:
    """The share with which ``drawn_steps`` of a rollout's ``steps`` come from the error model."""
    return min(drawn_steps / steps, LARGEST_SHARE)


def defended(logit: FloatArray, pem_logit: FloatArray, *, share: float | FloatArray) -> FloatArray:
    """The mixture of a proposal (weight 1 - share) and the error model, as logits ``[...]``.

    A single outcome's weight is at most 1 / share, whatever the proposal; share is in (0, 1),
    one for all or ``[...]``.
    """
    log_share, log_rest = np.log(share), np.log1p(-share)
    with np.errstate(invalid="ignore"):  # what is no number is told of its rollout, later
        detected = np.logaddexp(
            log_rest - np.logaddexp(0.0, -logit), log_share - np.logaddexp(0.0, -pem_logit)
        )
        missed = np.logaddexp(
            log_rest - np.logaddexp(0.0, logit), log_share - np.logaddexp(0.0, pem_logit)
        )
    return detected - missed
