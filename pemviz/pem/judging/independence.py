"""Are a detector's misses compatible with independence, and what sample would tell?

The test is the likelihood ratio of tau = 0, with the frailty free and sequences as what is
independent, see :mod:`pemviz.pem.fitting.memory`. What a sample would tell follows from
what an outcome is expected to add to that ratio (Kullback & Leibler 1951).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtri, stdtrit, xlogy

from pemviz.arrays import FloatArray
from pemviz.pem.data.table import TrackTable
from pemviz.pem.fitting.memory import MemoryFit
from pemviz.pem.models.memory import frail_logit, persistence

FALSE_ALARM = 0.05
POWER = 0.8
JUDGED_TAUS_S = (0.02, 0.05, 0.1, 0.2)
MOST_SEQUENCES = 10**9
LEAST = 1e-15
"""No probability of a miss or a hit counts as less."""
NODES = 15
"""Of Gauss and Hermite's rule for the mean over obstacles' own visibility."""


@dataclass(frozen=True)
class NeededSample:
    """What would tell a memory time from 0.

    Attributes:
        sequences: So many sequences like these, at 5 % false alarm at most and 80 % power.
        pairs: Pairs of neighbouring observations of one obstacle in them.
    """

    tau_s: float
    sequences: int
    pairs: int


@dataclass(frozen=True)
class IndependenceCheck:
    """The verdict.

    Attributes:
        misses_after_miss: How many were seen.
        expected: How many independence expects.
        p_value: One-sided, of tau = 0 with the frailty free.
        compatible: Whether independence is not refused at 5 %.
        tau_interval_s: Memory times that the sample does not refuse [s].
        needed: What other samples would tell.
    """

    misses_after_miss: int
    expected: float
    p_value: float
    compatible: bool
    tau_interval_s: tuple[float, float]
    needed: tuple[NeededSample, ...]


def check_independence(
    tracks: TrackTable, logit: FloatArray, *, fit: MemoryFit
) -> IndependenceCheck:
    """Judge tracks by their memory and what it was fitted with: out-of-fold logits ``[n]``."""
    miss = expit(-logit)
    pairs = np.flatnonzero(tracks.follows)
    return IndependenceCheck(
        misses_after_miss=int(np.count_nonzero(tracks.missed_before & ~tracks.detected)),
        expected=float(np.sum(miss[pairs - 1] * miss[pairs])),
        p_value=fit.p_value,
        compatible=fit.p_value >= FALSE_ALARM,
        tau_interval_s=fit.tau_interval_s,
        needed=tuple(needed_sample(tracks, logit, fit=fit, tau_s=tau_s) for tau_s in JUDGED_TAUS_S),
    )


def needed_sample(
    tracks: TrackTable, logit: FloatArray, *, fit: MemoryFit, tau_s: float
) -> NeededSample:
    """How many sequences like these tell a memory time from 0.

    The signed root of the ratio is about normal, with variance 1 and a mean whose square is twice
    the expected gain of log likelihood; what not knowing f takes away, and what sequences differ
    by, is taken from the fit. So is the frailty; ``logit [n]`` are those of P(detected | state).
    """
    gain = expected_gain(tracks, logit, frailty=fit.memory.frailty, tau_s=tau_s)
    each = 2.0 * gain * fit.efficiency / fit.inflation / fit.sequences
    sequences = _sequences(each)
    pairs = round(float(np.count_nonzero(tracks.follows)) / fit.sequences * sequences)
    return NeededSample(tau_s, sequences=sequences, pairs=pairs)


def expected_gain(tracks: TrackTable, logit: FloatArray, *, frailty: float, tau_s: float) -> float:
    """Expected log likelihood of tau over that of 0, if tau is true, summed over pairs [nats].

    Given logits of P(detected | state), ``[n]``, and a known frailty.
    """
    pairs = np.flatnonzero(tracks.follows)
    rho = persistence(tracks.since_s[pairs], tau_s)
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if frailty > 0.0 else 1)
    total = 0.0
    for node, weight in zip(nodes, weights / weights.sum(), strict=True):
        visibility = np.full(len(tracks), node)
        own = expit(-frail_logit(logit, visibility=visibility, frailty=frailty))
        own = np.clip(own, LEAST, 1.0 - LEAST)
        before, after = own[pairs - 1], own[pairs]
        gain = before * _divergence(after + (1.0 - after) * rho, after)
        gain += (1.0 - before) * _divergence(after * (1.0 - rho), after)
        total += float(weight) * float(gain.sum())
    return total


def _divergence(true: FloatArray, assumed: FloatArray) -> FloatArray:
    """Kullback and Leibler's divergence of Bernoulli probabilities ``[n]`` [nats]."""
    missed = xlogy(true, true / assumed)
    return missed + xlogy(1.0 - true, (1.0 - true) / (1.0 - assumed))


def _sequences(each: float) -> int:
    """Fewest S with S each >= (t + z)^2, t of S - 1 degrees of freedom."""
    power = float(ndtri(POWER))
    fewest, most = 1, 2

    def tells(sequences: int) -> bool:
        alarm = float(stdtrit(sequences - 1, 1.0 - FALSE_ALARM))
        return sequences * each >= (alarm + power) ** 2

    while not tells(most):
        fewest, most = most, 2 * most
        if most > MOST_SEQUENCES:
            return MOST_SEQUENCES
    while most - fewest > 1:
        middle = (fewest + most) // 2
        fewest, most = (fewest, middle) if tells(middle) else (middle, most)
    return most
