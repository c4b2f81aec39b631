"""Mixing a proposal with the error model, outcome by outcome."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from pemviz.arrays import BoolArray, FloatArray

LARGEST_SHARE = 0.1


def share_for(*, drawn_steps: float, steps: int) -> float:
    """The share with which ``drawn_steps`` of a rollout's ``steps`` come from the error model."""
    return min(drawn_steps / steps, LARGEST_SHARE)


def defended(logit: FloatArray, pem_logit: FloatArray, *, share: float) -> FloatArray:
    """The mixture of a proposal (weight 1 - share) and the error model, as logits ``[...]``.

    Hesterberg's defensive mixture (1995), applied to every outcome: a single outcome's weight is
    at most 1 / share, whatever the proposal.

    Args:
        logit: The proposal's.
        pem_logit: The error model's.
        share: Of the error model, in (0, 1).
    """
    log_share, log_rest = float(np.log(share)), float(np.log1p(-share))
    detected = np.logaddexp(_log_hit(logit) + log_rest, _log_hit(pem_logit) + log_share)
    missed = np.logaddexp(_log_miss(logit) + log_rest, _log_miss(pem_logit) + log_share)
    return detected - missed


@dataclass(frozen=True)
class AgainstModel:
    """How much likelier outcomes ``[M]`` are under mixtures with proposals than by the error model.

    An outcome of logit a under the model and a + d under a proposal is (1 + e^-a) / (1 + e^-(a+d))
    times as likely under the latter. With E = e^-|a| that is (1 + E) / (1 + E e^-d) where a > 0,
    else (1 + E) / (E + e^-d): nothing overflows.

    Attributes:
        sign: 1 for a miss, -1 for a detection.
        fixed: The denominator's term without the proposal.
        moved: What e^-d is multiplied by there.
        scale: 1 - share times the numerator.
        share: Of the error model, in (0, 1).
    """

    sign: FloatArray
    fixed: FloatArray
    moved: FloatArray
    scale: FloatArray
    share: float

    @classmethod
    def of(cls, miss_logit: FloatArray, missed: BoolArray, *, share: float) -> Self:
        """Of outcomes ``[M]`` and the error model's logits of a miss there."""
        sign = np.where(missed, 1.0, -1.0)
        model = sign * miss_logit
        small = np.exp(-np.abs(model))
        likely = model > 0.0
        return cls(
            sign=sign,
            fixed=np.where(likely, 1.0, small),
            moved=np.where(likely, small, 1.0),
            scale=(1.0 - share) * (1.0 + small),
            share=share,
        )

    def log_ratio(self, raised: FloatArray) -> FloatArray:
        """Log q / p of each outcome, ``[M]``, under proposals that raise misses' logits ``[M]``."""
        denominator = np.exp(-self.sign * raised)
        denominator *= self.moved
        denominator += self.fixed
        ratio = np.divide(self.scale, denominator, out=denominator)
        ratio += self.share
        return np.log(ratio, out=ratio)


def _log_hit(logit: FloatArray) -> FloatArray:
    """Log of the probability of a detection, for logits of any shape."""
    return _log_miss(-logit)


def _log_miss(logit: FloatArray) -> FloatArray:
    """Log of the probability of a miss."""
    return -np.logaddexp(0.0, logit)
