"""Memory of misses: how an error model's P(missed) depends on the outcome before.

P(missed at t | state, outcome before) = p + (m - p) rho, with p the model's own P(missed) in
the state, m = 1 after a miss and 0 after a hit, and rho = exp(-h / tau) for h seconds between
the two. In a constant state P(missed) stays p, and outcomes h seconds apart have the correlation
exp(-h / tau), whatever the frame rate is: a binary Markov chain observed at times h apart.

Frailty: some obstacles are hard to see for as long as they are there. One standard normal u an
obstacle: P(missed | state, u) = Phi(Phi^-1(p) sqrt(1 + f^2) + f u). Its mean over u is p.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from pemviz.arrays import BoolArray, FloatArray
from pemviz.errors import PemError

TAU_MEANS = "outcomes h seconds apart have the correlation exp(-h / tau)"
"""What a memory time tau is, in a constant state."""
FRAILTY_MEANS = "how much obstacles differ in being missed beyond what the state tells"
"""What a frailty is; 0: not at all."""
LONGEST_TAU_S = 60.0
LARGEST_FRAILTY = 10.0


@dataclass(frozen=True)
class Memory:
    """How misses hang together.

    Attributes:
        tau_s: Memory time tau [s]; 0: outcomes are independent given the state.
        frailty: Spread f of obstacles' own visibility; 0: all are alike.
    """

    tau_s: float = 0.0
    frailty: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no memory.

        Raises:
            PemError: A value is out of range.
        """
        if not 0.0 <= self.tau_s <= LONGEST_TAU_S:
            raise PemError(f"memory_s is {self.tau_s:g}, allowed: 0 to {LONGEST_TAU_S:g} s")
        if not 0.0 <= self.frailty <= LARGEST_FRAILTY:
            raise PemError(f"frailty is {self.frailty:g}, allowed: 0 to {LARGEST_FRAILTY:g}")


def persistence(since_s: FloatArray | float, tau_s: float) -> FloatArray:
    """Rho = exp(-h / tau), elementwise ``[...]`` for h seconds between two outcomes."""
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
