"""Which rollouts a stage learns from, how much each counts, and the proposal fitted to them."""

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.optimize import brentq

from pemviz.arrays import BoolArray, FloatArray
from pemviz.proposals.offset_logistic import PolynomialBasis
from pemviz.proposals.offset_logistic_fit import (
    WeightedOutcomes,
    fit_offset_logistic,
    leave_one_out_loss,
)
from pemviz.sampling.adaptive.elite_threshold import VIOLATION_THRESHOLD
from pemviz.sampling.estimates.importance_weights import effective_sample_size, smoothed_weights
from pemviz.sampling.mixture.balance_heuristic import Pool

NEGLIGIBLE_SHARE = 1e-4


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """How proposals are fitted.

    Attributes:
        elites: Fewer violating rollouts than this, and the level is raised until there are.
        ess_share: Weights are smoothed until their effective sample size is this share of
            the elites', at least ``elites``.
        ridge: Penalty of the coefficients of degree 1; each further degree doubles it.
    """

    elites: int = 40
    ess_share: float = 0.1
    ridge: float = 0.3


@dataclass(frozen=True)
class Fit:
    """A fitted proposal.

    Attributes:
        coefficients: ``[B]``.
        optimism: By how much it overstates the log likelihood of each rollout of the pool it
            was fitted to, ``[N]`` [nats].
        threshold: The level of robustness below which rollouts were learned from.
        elites: How many.
        exponent: Of the weights.
        loss: [nats a decision].
    """

    coefficients: FloatArray
    optimism: FloatArray
    threshold: float
    elites: int
    exponent: float
    loss: float


def fit_next(pool: Pool, basis: PolynomialBasis, settings: FitSettings) -> Fit:
    """The proposal nearest to the elites' distribution under the error model."""
    threshold, chosen = _elites(pool, settings.elites)
    log_weight = pool.log_weight[chosen]
    aim = min(max(settings.elites, settings.ess_share * chosen.sum()), chosen.sum() / 2)
    exponent = smoothing_exponent(log_weight, least_ess=float(aim))
    share = smoothed_weights(log_weight, alpha=exponent)
    weight = np.zeros(pool.count)
    weight[chosen] = share * effective_sample_size(exponent * log_weight)
    weight[weight < NEGLIGIBLE_SHARE * weight.max()] = 0.0
    decisions = pool.decisions
    kept = weight[decisions.rollout] > 0.0
    outcomes = WeightedOutcomes(
        basis=decisions.basis[kept],
        missed=decisions.missed[kept],
        offset=decisions.offset[kept],
        weight=weight[decisions.rollout[kept]],
    )
    fitted = fit_offset_logistic(
        outcomes, ridge=ridge_by_degree(basis, settings.ridge), start=pool.coefficients[-1]
    )
    return Fit(
        coefficients=fitted.coefficients,
        optimism=leave_one_out_loss(
            outcomes, fitted, group=decisions.rollout[kept], count=pool.count
        ),
        threshold=threshold,
        elites=int(chosen.sum()),
        exponent=exponent,
        loss=fitted.loss,
    )


def smoothing_exponent(log_weight: FloatArray, *, least_ess: float) -> float:
    """Largest exponent in [0, 1] that leaves weights ``[M]`` the effective sample size asked."""

    def excess(exponent: float) -> float:
        return effective_sample_size(exponent * log_weight) - least_ess

    if excess(1.0) >= 0.0:
        return 1.0
    if excess(0.0) <= 0.0:
        return 0.0
    return float(cast(float, brentq(excess, 0.0, 1.0, xtol=1e-6)))


def ridge_by_degree(basis: PolynomialBasis, ridge: float) -> FloatArray:
    """Penalties ``[B]``: the constant's a tenth, each degree beyond the first twice as much."""
    degrees = np.array([len(chosen) for chosen in basis.exponents])
    return ridge * np.where(degrees == 0, 0.1, 2.0 ** (degrees - 1.0))


def _elites(pool: Pool, least: int) -> tuple[float, BoolArray]:
    """The level, and the rollouts that violate or lie at or below it."""
    least = min(least, max(1, pool.count // 3))
    if int(pool.violated.sum()) >= least:
        return VIOLATION_THRESHOLD, pool.violated
    level = float(np.partition(pool.robustness, least - 1)[least - 1])
    level = max(level, VIOLATION_THRESHOLD)
    return level, pool.violated | (pool.robustness <= level)
