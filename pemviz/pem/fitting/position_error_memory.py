"""How the noise of one obstacle's position errors hangs together over time, fitted to tracks."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.models.position_errors import NoiseMemory

LAG_FRAMES = (1, 2, 5, 10, 20, 30)
FEWEST_PAIRS = 100
FEWEST_LAGS = 3
LONGEST_TAU_S = 60.0
SHORTEST_TAU_S = 1e-3
RESAMPLES = 200
CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class LagPairs:
    """Pairs of one obstacle's errors, so many seconds apart.

    Attributes:
        lag_s: Time between the two [s].
        first: Rows of the earlier ``[m]``.
        second: Rows of the later ``[m]``.
    """

    lag_s: float
    first: IntArray
    second: IntArray


@dataclass(frozen=True)
class FittedNoiseMemory:
    """A memory of noise with its intervals.

    Attributes:
        memory: As fitted.
        share_interval: Of the lasting share.
        tau_interval_s: Of the memory time [s].
        correlations: Measured, by lag; in the order of the pairs.
    """

    memory: NoiseMemory
    share_interval: tuple[float, float]
    tau_interval_s: tuple[float, float]
    correlations: tuple[float, ...]


def lag_pairs(table: PositionErrorTable) -> tuple[LagPairs, ...]:
    """Pairs at 1 to 30 frames apart, where there are enough; none without tracks.

    A frame is the most common time between two sightings of an obstacle.
    """
    if table.track is None or table.time_s is None:
        return ()
    order = np.lexsort((table.time_s, table.track))
    steps = np.diff(table.time_s[order])[np.diff(table.track[order]) == 0]
    if steps.size == 0:
        return ()
    lengths, counts = np.unique(np.round(steps, 6), return_counts=True)
    frame_s = float(lengths[np.argmax(counts)])
    frame = np.round(table.time_s / frame_s).astype(np.int64)
    frame -= frame.min()
    key = table.track * (int(frame.max()) + LAG_FRAMES[-1] + 1) + frame
    sorting = np.argsort(key, kind="stable")
    pairs: list[LagPairs] = []
    for lag in LAG_FRAMES:
        place = np.minimum(np.searchsorted(key[sorting], key + lag), len(key) - 1)
        second = sorting[place]
        first = np.flatnonzero(key[second] == key + lag)
        if first.size >= FEWEST_PAIRS:
            pairs.append(LagPairs(lag * frame_s, first, second[first]))
    return tuple(pairs)


def fit_noise_memory(
    noise: FloatArray, pairs: tuple[LagPairs, ...], *, groups: IntArray, seed: int
) -> FittedNoiseMemory | None:
    """Lasting share and memory time by least squares on correlations; ``None``: too few lags.

    Intervals are percentiles over resampled groups (Efron, Tibshirani 1993, chapter 13).

    Args:
        noise: Held-out normal scores ``[n]``.
        pairs: Rows of the same obstacle.
        groups: What is taken as independent ``[n]``, counted from 0.
        seed: Of the resampling.
    """
    if len(pairs) < FEWEST_LAGS:
        return None
    lag_s = np.array([each.lag_s for each in pairs])
    weight = np.sqrt([each.first.size for each in pairs])
    sums = np.stack([_sums(noise, each, groups) for each in pairs])
    measured = _correlations(sums.sum(axis=2))
    random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    present = np.flatnonzero(np.bincount(groups))
    drawn = []
    for _ in range(RESAMPLES):
        chosen = random.choice(present, present.size)
        drawn.append(_fit(_correlations(sums[:, :, chosen].sum(axis=2)), lag_s, weight))
    edge = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(drawn, (edge, 100.0 - edge), axis=0)
    share, tau_s = _fit(measured, lag_s, weight)
    return FittedNoiseMemory(
        memory=NoiseMemory(lasting_share=share, tau_s=tau_s),
        share_interval=(float(low[0]), float(high[0])),
        tau_interval_s=(float(low[1]), float(high[1])),
        correlations=tuple(measured.tolist()),
    )


def _sums(noise: FloatArray, pairs: LagPairs, groups: IntArray) -> FloatArray:
    """Sums of products and squares by group ``[3, G]``."""
    one, other, of = noise[pairs.first], noise[pairs.second], groups[pairs.first]
    size = int(groups.max()) + 1
    totals = [np.bincount(of, weights, size) for weights in (one * other, one**2, other**2)]
    return np.stack(totals).astype(np.float64)


def _correlations(sums: FloatArray) -> FloatArray:
    """Of summed products and squares ``[L, 3]``: ``[L]``."""
    return sums[:, 0] / np.sqrt(np.maximum(sums[:, 1] * sums[:, 2], np.finfo(float).tiny))


def _fit(measured: FloatArray, lag_s: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Share and memory time [s] whose curve is nearest."""

    def misfit(values: FloatArray) -> FloatArray:
        share, log_tau = values
        return weight * (share + (1.0 - share) * np.exp(-lag_s / np.exp(log_tau)) - measured)

    low, high = np.log(SHORTEST_TAU_S), np.log(LONGEST_TAU_S)
    start = np.array([np.clip(measured[-1], 0.01, 0.9), np.log(2.0 * lag_s[0])])
    found = least_squares(misfit, start, bounds=([0.0, low], [0.999, high]))
    return float(found.x[0]), float(np.exp(found.x[1]))
