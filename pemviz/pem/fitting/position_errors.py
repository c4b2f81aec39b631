"""Position errors fitted by maximum likelihood: mean and log scale by distance and bearing.

Heteroscedastic regression with Gaussian or Student's t errors (Lange, Little, Taylor 1989, JASA
84:881). Each kind of error is fitted on its own; coefficients other than the first of mean and log
scale have a weak prior, normal with deviation 1, so that a feature that the data hardly vary (the
bearing of a camera's obstacles) does not run away.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.special import digamma, gammaln, ndtri_exp, stdtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.position_errors import PositionErrorTable
from pemviz.pem.models.position_errors import (
    GAUSSIAN,
    MEAN_FEATURES,
    SCALE_FEATURES,
    ErrorAxis,
    features,
)

TailChoice = Literal["auto", "gaussian", "student-t"]
FEWEST_ROWS = 200
FOLDS = 5
ENDS = (0.002, 0.998)
"""Quantiles of distance and bearing beyond which the model is held constant."""
LOWEST_FREEDOM, HIGHEST_FREEDOM = 1.01, 1000.0
SMALLEST_SCALE = 1e-9


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
    """The likeliest mean, scale and tail of one kind of error.

    Args:
        explained: What explains it, n rows.
        error: ``[n]`` [m, or m/s].
        name: Kind of error.
        heavy: Whether its family is Student's t, else Gaussian.

    Raises:
        PemError: All errors are alike, or the fit does not settle.
    """
    spread = float(np.std(error))
    if not spread > SMALLEST_SCALE:
        raise PemError(f"{name}: all {len(error)} errors are {error[0]:g}, there is no spread")
    start = np.zeros(len(MEAN_FEATURES) + len(SCALE_FEATURES) + heavy)
    start[0] = np.median(error)
    start[len(MEAN_FEATURES)] = np.log(0.6 * spread if heavy else spread)
    bounds = [(None, None)] * (len(MEAN_FEATURES) + len(SCALE_FEATURES))
    if heavy:
        start[-1] = np.log(4.0)
        bounds += [(np.log(LOWEST_FREEDOM), np.log(HIGHEST_FREEDOM))]
    found = minimize(
        _mean_nats,
        start,
        args=(explained, error, heavy),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": 1000, "ftol": 1e-13},
    )
    if not np.isfinite(found.fun):
        raise PemError(f"{name}: the fit does not settle ({found.message})")
    return _axis(found.x, name=name, heavy=heavy)


def _axis(values: FloatArray, *, name: str, heavy: bool) -> ErrorAxis:
    edge = len(MEAN_FEATURES)
    freedom = float(np.exp(values[-1])) if heavy else GAUSSIAN
    return ErrorAxis(
        name=name,
        mean=values[:edge].copy(),
        log_scale=values[edge : edge + len(SCALE_FEATURES)].copy(),
        degrees_of_freedom=freedom,
    )


def _mean_nats(
    values: FloatArray, explained: ErrorFeatures, error: FloatArray, heavy: bool
) -> tuple[float, FloatArray]:
    """Negative log posterior an error [nats], and its gradient."""
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
        [
            -explained.of_mean.T @ (pull * inverse),
            explained.of_scale.T @ (1.0 - pull * standard),
        ]
    ) / len(error)
    prior = np.array(values[: edge + len(SCALE_FEATURES)])
    prior[[0, edge]] = 0.0
    gradient += prior / len(error)
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
    on_fit: Callable[[], None] | None = None,
) -> HeldOut:
    """Scores of every error by models of the other groups.

    Args:
        explained: What explains it, n rows.
        error: ``[n]`` [m, or m/s].
        groups: Which rows hang together ``[n]``, counted from 0.
        name: Kind of error.
        on_fit: Called after each of the 2 FOLDS fits.

    Raises:
        PemError: There are too few groups, or errors of too little spread.
    """
    fold = group_folds(groups)
    nats = {family: np.empty(len(error)) for family in ("constant", "gaussian", "student-t")}
    noise = {family: np.empty(len(error)) for family in ("gaussian", "student-t")}
    for each in range(FOLDS):
        held, seen = fold == each, fold != each
        mean, sd = float(np.mean(error[seen])), float(np.std(error[seen]))
        constant = -log_density(error[held], mean=mean, sd=max(sd, SMALLEST_SCALE))
        nats["constant"][held] = constant
        of_held = explained.take(held)
        for family, scores in noise.items():
            axis = fit_axis(
                explained.take(seen), error[seen], name=name, heavy=family != "gaussian"
            )
            nats[family][held] = error_nats(axis, of_held, error[held])
            scores[held] = normal_scores(axis, of_held, error[held])
            if on_fit is not None:
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


def log_density(values: FloatArray, *, mean: float, sd: float) -> FloatArray:
    """Log density of a Gaussian ``[n]`` [nats]."""
    return -0.5 * ((values - mean) / sd) ** 2 - np.log(sd) - 0.5 * np.log(2.0 * np.pi)
