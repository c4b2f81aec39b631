"""Are a detector's misses compatible with independence, and what sample would tell?

The count of misses right after a miss is compared with what independence expects of it, given
P(missed | state): a score test, since that count is what a memory raises first.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, ndtri

from pemviz.arrays import FloatArray
from pemviz.pem.data.tracks import TrackTable
from pemviz.pem.fitting.memory import MemoryFit
from pemviz.pem.models.memory import persistence

FALSE_ALARM = 0.05
POWER = 0.8
FEWEST_EXPECTED = 5.0
"""Misses after a miss that a sample must promise before a normal approximation serves."""
ASKED_TAUS_S = (0.02, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class NeededSample:
    """What would tell a memory time from 0.

    Attributes:
        tau_s: The memory time [s].
        sequences: So many sequences like these, at 5 % false alarm and 80 % power.
    """

    tau_s: float
    sequences: int


@dataclass(frozen=True)
class IndependenceCheck:
    """The verdict.

    Attributes:
        misses_after_miss: How many were seen.
        expected: How many independence expects.
        excludes_zero: Whether the interval of tau lies above 0.
        tau_up_to_s: Memory times up to this one cannot be excluded [s].
        needed: What other samples would tell.
    """

    misses_after_miss: int
    expected: float
    excludes_zero: bool
    tau_up_to_s: float
    needed: tuple[NeededSample, ...]


def check_independence(
    tracks: TrackTable, logit: FloatArray, *, fit: MemoryFit
) -> IndependenceCheck:
    """Judge tracks by their fitted memory.

    Args:
        tracks: n observations.
        logit: Out-of-fold logits of P(detected | state), ``[n]``.
        fit: Their memory.
    """
    miss = expit(-logit)
    pairs = np.flatnonzero(tracks.follows)
    before, after = miss[pairs - 1], miss[pairs]
    expected = float(np.sum(before * after))
    seen = int(np.count_nonzero(tracks.missed_before & ~tracks.detected))
    since_s = tracks.since_s[pairs]
    return IndependenceCheck(
        misses_after_miss=seen,
        expected=expected,
        excludes_zero=fit.tau_interval_s[0] > 0.0,
        tau_up_to_s=fit.tau_interval_s[1],
        needed=tuple(
            _needed(before, after, since_s, tau_s=tau_s, sequences=fit.sequences)
            for tau_s in ASKED_TAUS_S
        ),
    )


def _needed(
    before: FloatArray, after: FloatArray, since_s: FloatArray, *, tau_s: float, sequences: int
) -> NeededSample:
    """Poisson counts lambda_0 and lambda_1, grown by k until the test has its power."""
    rho = persistence(since_s, tau_s)
    low = float(np.sum(before * after))
    high = float(np.sum(before * (after + (1.0 - after) * rho)))
    alarm, power = float(ndtri(1.0 - FALSE_ALARM)), float(ndtri(POWER))
    if high <= low:
        return NeededSample(tau_s, sequences=10**9)
    growth = ((alarm * math.sqrt(low) + power * math.sqrt(high)) / (high - low)) ** 2
    growth = max(growth, FEWEST_EXPECTED / high)
    return NeededSample(tau_s, sequences=max(2, math.ceil(growth * sequences)))
