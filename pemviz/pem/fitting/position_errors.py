"""Position errors fitted by maximum likelihood: mean and log scale by distance and bearing.

Heteroscedastic regression with Gaussian or Student's t errors (Lange, Little, Taylor 1989, JASA
84:881). Each kind of error is fitted on its own; coefficients other than the first of mean and log
scale have a weak prior, normal with deviation 1, so that a feature that the data hardly vary (the
bearing of a camera's obstacles) does not run away. How the noise of one obstacle hangs together
over time is fitted to tracks.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import digamma, gammaln, ndtri_exp, stdtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.models.position_errors import (
    GAUSSIAN,
    MEAN_FEATURES,
    SCALE_FEATURES,
    ErrorAxis,
    NoiseMemory,
    features,
)

TailChoice = Literal["auto", "gaussian", "student-t"]
FEWEST_ROWS = 200
FOLDS = 5
ENDS = (0.002, 0.998)
"""Quantiles of distance and bearing beyond which the model is held constant."""
LOWEST_FREEDOM, HIGHEST_FREEDOM = 1.01, 1000.0
SMALLEST_SCALE = 1e-9
FARTHEST_LOG_SCALE, FARTHEST_COEFFICIENT = 20.0, 10.0
"""How far a fit's search goes from the errors' spread, and in coefficients with the prior of
deviation 1: no optimum lies there, but a line search's trial steps did, where squares overflow."""
LAG_FRAMES = (1, 2, 5, 10, 20, 30)
FEWEST_PAIRS = 100
FEWEST_LAGS = 3
LONGEST_TAU_S = 60.0
SHORTEST_TAU_S = 1e-3
RESAMPLES = 200
CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class ErrorFeatures:
    """What the errors of a table are explained by.

    Attributes:
        of_mean: ``[n, 4]``.
        of_scale: ``[n, 6]``.
        distance_m: Least and greatest distance [m].
        bearing_rad: Least and greatest bearing [rad].
    """

    of_mean: FloatArray
    of_scale: FloatArray
    distance_m: tuple[float, float]
    bearing_rad: tuple[float, float]

    def take(self, rows: BoolArray) -> "ErrorFeatures":
        """Those of some rows."""
        return replace(self, of_mean=self.of_mean[rows], of_scale=self.of_scale[rows])


@dataclass(frozen=True, eq=False)
class HeldOut:
    """How well errors of one kind are told by models that have not seen them.

    Attributes:
        nats: Negative log-likelihood of an error by family: constant, gaussian, student-t.
        noise: Normal scores ``[n]`` by family, gaussian and student-t: standard normal if it holds.
    """

    nats: dict[str, float]
    noise: dict[str, FloatArray]

    @property
    def best(self) -> Literal["gaussian", "student-t"]:
        """The family with the higher likelihood."""
        return "student-t" if self.nats["student-t"] < self.nats["gaussian"] else "gaussian"


def error_features(table: PositionErrorTable) -> ErrorFeatures:
    """Features of a table's rows, held at the ends of distance and bearing.

    Raises:
        PemError: There are too few rows.
    """
    if len(table) < FEWEST_ROWS:
        raise PemError(f"{table.source}: {len(table)} errors, need {FEWEST_ROWS} or more")
    bearing = np.arctan2(table.x_m, table.z_m)
    near, far = _ends(table.distance_m)
    left, right = _ends(bearing)
    of_mean, of_scale = features(
        distance_m=table.distance_m.clip(near, far),
        bearing_rad=bearing.clip(left, right),
        alpha_rad=table.alpha_rad,
    )
    return ErrorFeatures(of_mean, of_scale, (near, far), (left, right))


def _ends(values: FloatArray) -> tuple[float, float]:
    low, high = np.quantile(values, ENDS)
    return float(low), float(max(high, low + 1e-6))


def fit_axis(explained: ErrorFeatures, error: FloatArray, *, name: str, heavy: bool) -> ErrorAxis:
    """The likeliest mean, scale and tail of one kind of error ``[n]`` [m, or m/s].

    Its family is Student's t if ``heavy``, else Gaussian.

    Raises:
        PemError: All errors are equal, or the fit does not settle.
    """
    spread = float(np.std(error))
    if not spread > SMALLEST_SCALE:
        raise PemError(f"{name}: all {len(error)} errors are {error[0]:g}, there is no spread")
    # in units of the spread: in metres, errors of a millimetre bend the sum a million times as
    # sharply along a mean as along a scale, and the search stops before the optimum
    standard = error / spread
    edge = len(MEAN_FEATURES)
    start = np.zeros(edge + len(SCALE_FEATURES) + heavy)
    start[0] = np.median(standard)
    start[edge] = np.log(0.6) if heavy else 0.0
    of_scale = np.full(len(SCALE_FEATURES), FARTHEST_COEFFICIENT)
    of_scale[0] = FARTHEST_LOG_SCALE
    bounds = [(None, None)] * edge + list(zip(-of_scale, of_scale, strict=True))
    if heavy:
        start[-1] = np.log(4.0)
        bounds += [(np.log(LOWEST_FREEDOM), np.log(HIGHEST_FREEDOM))]
    from scipy.optimize import minimize  # noqa: PLC0415  slow to import

    found = minimize(
        _mean_nats,
        start,
        args=(explained, standard, spread, heavy),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 1000, "ftol": 1e-13},
    )
    if not np.isfinite(found.fun):
        raise PemError(f"{name}: the fit does not settle ({found.message})")
    log_scale = found.x[edge : edge + len(SCALE_FEATURES)].copy()
    log_scale[0] += np.log(spread)
    return ErrorAxis(
        name=name,
        mean=spread * found.x[:edge],
        log_scale=log_scale,
        degrees_of_freedom=float(np.exp(found.x[-1])) if heavy else GAUSSIAN,
    )


def _mean_nats(
    values: FloatArray, explained: ErrorFeatures, error: FloatArray, spread: float, heavy: bool
) -> tuple[float, FloatArray]:
    """Negative log posterior an error [nats], and its gradient, of errors in units of spread."""
    edge = len(MEAN_FEATURES)
    log_scale = explained.of_scale @ values[edge : edge + len(SCALE_FEATURES)]
    inverse = np.exp(-log_scale)
    standard = (error - explained.of_mean @ values[:edge]) * inverse
    if heavy:
        nu = float(np.exp(values[-1]))
        pull = (nu + 1.0) * standard / (nu + standard**2)
        bent = np.log1p(standard**2 / nu)
        nats = 0.5 * (nu + 1.0) * bent + log_scale - _log_constant(nu)
        of_nu = (
            0.5 * digamma(0.5 * nu) - 0.5 * digamma(0.5 * (nu + 1.0)) + 0.5 / nu
            + np.mean(0.5 * bent - 0.5 * pull * standard / nu)
        )  # fmt: skip
        tail = [nu * of_nu]
    else:
        pull = standard
        nats = 0.5 * standard**2 + log_scale + 0.5 * np.log(2.0 * np.pi)
        tail = []
    gradient = np.concatenate(
        [-explained.of_mean.T @ (pull * inverse), explained.of_scale.T @ (1.0 - pull * standard)]
    ) / len(error)
    unit = np.concatenate([np.full(edge, spread), np.ones(len(SCALE_FEATURES))])
    unit[[0, edge]] = 0.0  # the first of mean and log scale have no prior
    prior = unit * values[: len(unit)]
    gradient += unit * prior / len(error)
    return float(np.mean(nats) + 0.5 * (prior @ prior) / len(error)), np.append(gradient, tail)


def _log_constant(nu: float) -> float:
    return float(gammaln(0.5 * (nu + 1.0)) - gammaln(0.5 * nu) - 0.5 * np.log(nu * np.pi))


def error_nats(axis: ErrorAxis, explained: ErrorFeatures, error: FloatArray) -> FloatArray:
    """Negative log-likelihood of errors ``[n]`` [nats]."""
    log_scale = explained.of_scale @ axis.log_scale
    standard = (error - explained.of_mean @ axis.mean) * np.exp(-log_scale)
    nu = axis.degrees_of_freedom
    if np.isinf(nu):
        return 0.5 * standard**2 + log_scale + 0.5 * np.log(2.0 * np.pi)
    return 0.5 * (nu + 1.0) * np.log1p(standard**2 / nu) + log_scale - _log_constant(nu)


def normal_scores(axis: ErrorAxis, explained: ErrorFeatures, error: FloatArray) -> FloatArray:
    """The noise u ``[n]`` that gives the errors: Phi^-1(F((error - mean) / scale))."""
    scale = np.exp(explained.of_scale @ axis.log_scale)
    standard = (error - explained.of_mean @ axis.mean) / scale
    if np.isinf(axis.degrees_of_freedom):
        return standard
    lower = stdtr(axis.degrees_of_freedom, -np.abs(standard))
    return -np.sign(standard) * ndtri_exp(np.log(lower))


def cross_fit_axis(
    explained: ErrorFeatures,
    error: FloatArray,
    *,
    groups: IntArray,
    name: str,
    on_fit: Callable[[], None],
) -> HeldOut:
    """Scores of every error ``[n]`` [m, or m/s] by models of the other groups ``[n]`` of rows.

    ``on_fit`` is called after each of the 2 FOLDS fits.

    Raises:
        PemError: There are too few groups, or errors of too little spread.
    """
    fold = group_folds(groups)
    nats = {family: np.empty(len(error)) for family in ("constant", "gaussian", "student-t")}
    noise = {family: np.empty(len(error)) for family in ("gaussian", "student-t")}
    for each in range(FOLDS):
        held, seen = fold == each, fold != each
        mean, sd = np.mean(error[seen]), max(float(np.std(error[seen])), SMALLEST_SCALE)
        apart = (error[held] - mean) / sd
        nats["constant"][held] = 0.5 * apart**2 + np.log(sd) + 0.5 * np.log(2.0 * np.pi)
        of_held = explained.take(held)
        for family, scores in noise.items():
            axis = fit_axis(
                explained.take(seen), error[seen], name=name, heavy=family != "gaussian"
            )
            nats[family][held] = error_nats(axis, of_held, error[held])
            scores[held] = normal_scores(axis, of_held, error[held])
            on_fit()
    return HeldOut({family: float(np.mean(each)) for family, each in nats.items()}, noise)


def group_folds(groups: IntArray) -> IntArray:
    """Which fold each row is of ``[n]``: groups stay together, folds have about equally many rows.

    Raises:
        PemError: There are fewer groups than folds.
    """
    sizes = np.bincount(groups)
    present = np.flatnonzero(sizes)
    if present.size < FOLDS:
        raise PemError(f"{present.size} drives or obstacles, need {FOLDS} or more to hold some out")
    fold_of, filled = np.zeros(sizes.size, dtype=np.int64), np.zeros(FOLDS)
    for group in present[np.argsort(-sizes[present], kind="stable")]:
        fold_of[group] = np.argmin(filled)
        filled[fold_of[group]] += sizes[group]
    return fold_of[groups]


@dataclass(frozen=True, eq=False)
class LagPairs:
    """Pairs of one obstacle's errors, so many seconds apart.

    Attributes:
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
    resampled: list[tuple[float, float]] = []
    for _ in range(RESAMPLES):
        chosen = random.choice(present, present.size)
        memory = _nearest_memory(_correlations(sums[:, :, chosen].sum(axis=2)), lag_s, weight)
        resampled.append((memory.lasting_share, memory.tau_s))
    edge = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(resampled, (edge, 100.0 - edge), axis=0)
    return FittedNoiseMemory(
        memory=_nearest_memory(measured, lag_s, weight),
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


def _nearest_memory(measured: FloatArray, lag_s: FloatArray, weight: FloatArray) -> NoiseMemory:
    """The memory whose curve is nearest to correlations ``[L]``."""
    from scipy.optimize import least_squares  # noqa: PLC0415  slow to import

    def misfit(values: FloatArray) -> FloatArray:
        share, log_tau = values
        return weight * (NoiseMemory(share, np.exp(log_tau)).correlation(lag_s) - measured)

    low, high = np.log(SHORTEST_TAU_S), np.log(LONGEST_TAU_S)
    start = np.array([np.clip(measured[-1], 0.01, 0.9), np.log(2.0 * lag_s[0])])
    found = least_squares(misfit, start, bounds=([0.0, low], [0.999, high]))
    return NoiseMemory(lasting_share=float(found.x[0]), tau_s=float(np.exp(found.x[1])))
