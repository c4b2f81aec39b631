"""Memory of misses: how an error model's P(missed) depends on the outcomes before.

P(missed at t | state, outcome before) = p + (m - p) rho, with p the model's own P(missed) in
the state, m = 1 after a miss and 0 after a hit, and rho = exp(-h / tau) for h seconds between
the two. In a constant state P(missed) stays p, and outcomes h seconds apart have the correlation
exp(-h / tau), whatever the frame rate is: a binary Markov chain observed at times h apart.

Frailty: some obstacles are hard to see for as long as they are there. One standard normal u an
obstacle: P(missed | state, u) = Phi(Phi^-1(p) sqrt(1 + f^2) + f u). Its mean over u is p.

u is never sampled. The trapezoid rule turns the integral over it into a sum over nodes u_j with
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
from scipy.special import log_ndtr, ndtri_exp

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import PemError

TAU_MEANS = "outcomes h seconds apart have the correlation exp(-h / tau)"
"""What a memory time tau is, in a constant state."""
FRAILTY_MEANS = "how much objects differ in being missed beyond what the state explains"
"""What a frailty is; 0: not at all."""
LONGEST_TAU_S = 60.0
LARGEST_FRAILTY = 10.0
FARTHEST_NODE = 12.0
"""Nodes lie within +-12 standard deviations: beyond, a normal has 4e-33 of its probability."""
NODE_SPACING = 0.25
"""Distance of the nodes, for frailties up to 1; above, that over the frailty, since P(missed | u)
then changes within 1 / frailty."""


@dataclass(frozen=True)
class Memory:
    """How misses hang together.

    Attributes:
        tau_s: Memory time tau [s]; 0: outcomes are independent given the state.
        frailty: Spread f of obstacles' own visibility; 0: all are equal.

    Raises:
        PemError: A value is out of range.
    """

    tau_s: float = 0.0
    frailty: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.tau_s <= LONGEST_TAU_S:
            raise PemError(f"memory_s is {self.tau_s:g}, allowed: 0 to {LONGEST_TAU_S:g} s")
        if not 0.0 <= self.frailty <= LARGEST_FRAILTY:
            raise PemError(f"frailty is {self.frailty:g}, allowed: 0 to {LARGEST_FRAILTY:g}")


def persistence(since_s: FloatArray | float, tau_s: float) -> FloatArray:
    """Rho = exp(-h / tau), elementwise ``[...]`` for h seconds between two outcomes.

    Example:
        >>> from pemviz.pem.models.memory import persistence
        >>> print(persistence(0.1, 0.25).round(3))  # frames 0.1 s apart, a memory time of 0.25 s
        0.67
    """
    if tau_s == 0.0:
        return np.zeros(np.shape(since_s))
    return np.exp(-np.asarray(since_s, dtype=np.float64) / tau_s)


def remembering_logit(
    logit: FloatArray, *, missed_before: BoolArray, rho: FloatArray | float
) -> FloatArray:
    """Logit of P(detected | state, outcome before), elementwise ``[...]``.

    Args:
        logit: The error model's own logit of P(detected) ``[...]``.
        missed_before: Whether the outcome before was a miss ``[...]``.
        rho: Correlation with the outcome before, from 0 to below 1; 0 gives ``logit`` itself.

    Example:
        >>> import numpy as np
        >>> from scipy.special import expit, logit
        >>> from pemviz.pem.models.memory import remembering_logit
        >>> own, before = logit(np.array([0.9, 0.9])), np.array([True, False])
        >>> after = remembering_logit(own, missed_before=before, rho=0.67)
        >>> print(expit(-after).round(3))  # P(missed) after a miss, and after a hit; alone 0.1
        [0.703 0.033]
    """
    zero = np.zeros_like(logit)
    with np.errstate(divide="ignore"):
        log_rho, log_rest = zero + np.log(rho), np.log1p(np.negative(rho))
    # logaddexp is most of the time: once for -log P of both fresh outcomes, once for the one that
    # is remembered as well; the other stays what it is
    rest = np.logaddexp(zero, -np.abs(logit))
    fresh_hit = log_rest - np.where(logit > 0.0, rest, rest - logit)
    fresh_miss = log_rest - np.where(logit < 0.0, rest, rest + logit)
    kept = np.logaddexp(np.where(missed_before, fresh_miss, fresh_hit), log_rho)
    remembered = np.where(missed_before, fresh_hit - kept, kept - fresh_miss)
    return np.where(zero + rho == 0.0, logit, remembered)


def frail_logit(logit: FloatArray, *, visibility: FloatArray, frailty: float) -> FloatArray:
    """Logit of P(detected | state, u), elementwise ``[...]``.

    Args:
        logit: The error model's own logit of P(detected) ``[...]``.
        visibility: The obstacle's u ``[...]``, standard normal; the larger, the harder to see.
        frailty: f; 0 gives ``logit`` itself.

    Example:
        >>> import numpy as np
        >>> from scipy.special import expit, logit
        >>> from pemviz.pem.models.memory import frail_logit
        >>> u = np.array([-1.0, 0.0, 1.0])  # easy, ordinary and hard to see
        >>> print(expit(-frail_logit(np.full(3, logit(0.9)), visibility=u, frailty=0.7)).round(3))
        [0.012 0.059 0.194]
    """
    if frailty == 0.0:
        return logit + 0.0 * visibility
    moved = miss_quantile(logit) * np.sqrt(1.0 + frailty**2) + frailty * visibility
    return log_ndtr(-moved) - log_ndtr(moved)


def miss_quantile(logit: FloatArray) -> FloatArray:
    """Phi^-1(P(missed)) of logits of P(detected), elementwise ``[...]``.

    The smaller of P(missed) and P(detected) gives it without loss of digits.
    """
    log_miss, log_hit = -np.logaddexp(0.0, logit), -np.logaddexp(0.0, -logit)
    return np.where(log_miss < log_hit, ndtri_exp(log_miss), -ndtri_exp(log_hit))


@dataclass(frozen=True)
class VisibilityNodes:
    """Nodes of the integral over u for a frailty above 0."""

    frailty: float

    @cached_property
    def u(self) -> FloatArray:
        """Nodes ``[J]``, ascending, symmetric about 0."""
        distance = NODE_SPACING / max(1.0, self.frailty)
        half = round(FARTHEST_NODE / distance)
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
