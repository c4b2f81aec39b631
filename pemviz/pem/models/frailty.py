"""Frailty integrated out: what outcomes so far tell of an obstacle's visibility u.

:mod:`pemviz.pem.models.memory` gives P(missed | state, outcome before, u), with u standard normal.
u is never drawn. The trapezoid rule turns the integral over it into a sum over nodes u_j with
weights w_j, and with o_1 .. o_t the outcomes so far::

    posterior   pi_j(t)           = w_j prod_s P(o_s | s, o_{s-1}, u_j) / the same summed over j
    next        P(o | history)    = sum_j pi_j(t) P(o | s, o_t, u_j)

The product of these over a rollout is the likelihood of its outcomes with u integrated out. For
integrands as smooth as these the rule converges faster than any power of the distance of the nodes
(Trefethen, Weideman 2014, SIAM Review 56:385).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from pemviz.arrays import FloatArray
from pemviz.pem.models.memory import miss_quantile

FARTHEST = 12.0
"""Nodes lie within +-12 standard deviations: beyond, a normal has 4e-33 of its probability."""
SPACING = 0.25
"""Distance of the nodes, for frailties up to 1; above, that over the frailty, since P(missed | u)
then changes within 1 / frailty."""


@dataclass(frozen=True)
class VisibilityNodes:
    """Nodes of the integral over u for a frailty above 0."""

    frailty: float
    spacing: float = SPACING
    farthest: float = FARTHEST

    @cached_property
    def u(self) -> FloatArray:
        """Nodes ``[J]``, ascending, symmetric about 0."""
        distance = self.spacing / max(1.0, self.frailty)
        half = round(self.farthest / distance)
        return np.arange(-half, half + 1, dtype=np.float64) * distance

    @cached_property
    def log_weight(self) -> FloatArray:
        """Log of the weights ``[J]``, which sum to 1."""
        log_weight = -0.5 * self.u**2
        return log_weight - np.log(np.exp(log_weight).sum())

    def log_outcomes(self, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log P(missed | state, u_j) and log P(detected | state, u_j), ``[N, J]``.

        Args:
            own: Logit of 'detected' of the model of single outcomes, ``[N]``.
        """
        moved = self.moved(own)
        rarer = log_ndtr(-np.abs(moved))
        other = np.log1p(-np.exp(rarer))
        likely = moved > 0.0
        return np.where(likely, other, rarer), np.where(likely, rarer, other)

    def moved(self, own: FloatArray) -> FloatArray:
        """Phi^-1(P(missed | state, u_j)) ``[N, J]``, for logits ``[N]`` as above."""
        quantile = miss_quantile(own) * math.sqrt(1.0 + self.frailty**2)
        return quantile[:, None] + self.frailty * self.u


def remembered_outcomes(
    log_outcomes: tuple[FloatArray, FloatArray], *, last: FloatArray, rho: float
) -> tuple[FloatArray, FloatArray]:
    """Log P(missed) and log P(detected) given the outcome before too, ``[N, J]``.

    Args:
        log_outcomes: The same without it.
        last: The outcome before: missed (-1), detected (1), none (0), ``[N]``.
        rho: Correlation with it, from 0 to below 1.
    """
    if rho == 0.0:
        return log_outcomes
    fresh = np.where(last == 0.0, 0.0, np.log1p(-rho))[:, None]
    miss, hit = (each + fresh for each in log_outcomes)
    kept = np.log(rho)
    missed, detected = last < 0.0, last > 0.0
    miss[missed] = np.logaddexp(miss[missed], kept)
    hit[detected] = np.logaddexp(hit[detected], kept)
    return miss, hit


def log_sums(log_values: FloatArray) -> FloatArray:
    """Log of the sums ``[N]`` of exp of ``log_values [N, J]``; each is the same in any batch."""
    values = np.ascontiguousarray(log_values)
    largest = values.max(axis=1)
    return np.log(np.exp(values - largest[:, None]).sum(axis=1)) + largest
