"""Mixing a proposal with the error model, outcome by outcome."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import FloatArray, namespace

LARGEST_SHARE = 0.1


def share_for(*, drawn_steps: float, steps: int) -> float:
    """The share with which ``drawn_steps`` of a rollout's ``steps`` come from the error model."""
    return min(drawn_steps / steps, LARGEST_SHARE)


@dataclass(frozen=True)
class Defence:
    """The share of the error model in mixtures with any number of proposals.

    Attributes:
        share: Of the error model, in (0, 1).
        detected: Log of the share times its probability of a detection, ``[...]``.
        missed: The same of a miss.
    """

    share: float
    detected: FloatArray
    missed: FloatArray

    @classmethod
    def of(cls, pem_logit: FloatArray, *, share: float) -> Self:
        """Of an error model's logits ``[...]``."""
        log_share = float(np.log(share))
        return cls(
            share, _log_expit(pem_logit) + log_share, _log_expit(-1.0 * pem_logit) + log_share
        )

    def of_proposal(self, logit: FloatArray) -> FloatArray:
        """The mixture with a proposal (weight 1 - share) of logits ``[...]``, as logits.

        Hesterberg's defensive mixture (1995), applied to every outcome: a single outcome's
        weight is at most 1 / share, whatever the proposal.
        """
        xp, log_rest = namespace(logit), float(np.log1p(-self.share))
        detected = xp.logaddexp(_log_expit(logit) + log_rest, self.detected)
        return detected - xp.logaddexp(_log_expit(-1.0 * logit) + log_rest, self.missed)


def defended(logit: FloatArray, pem_logit: FloatArray, *, share: float) -> FloatArray:
    """The mixture of a proposal and the error model, as logits; see :class:`Defence`."""
    return Defence.of(pem_logit, share=share).of_proposal(logit)


def _log_expit(logit: FloatArray) -> FloatArray:
    xp = namespace(logit)
    return -xp.logaddexp(-logit, xp.zeros_like(logit))
