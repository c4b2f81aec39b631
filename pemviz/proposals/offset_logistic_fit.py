"""Weighted logistic regression with an offset and a ridge: convex, a few Newton steps."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray

NEWTON_STEPS = 40
SHORTEST_STEP = 1e-9
SUFFICIENT_DECREASE = 1e-4
GOOD_ENOUGH = 1e-4


@dataclass(frozen=True)
class WeightedOutcomes:
    """Decisions to learn from.

    Attributes:
        basis: ``[M, B]``.
        missed: ``[M]``.
        offset: The error model's logit of a miss, ``[M]``.
        weight: ``[M]``, not negative.
    """

    basis: FloatArray
    missed: BoolArray
    offset: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class LogisticFit:
    """A fitted model.

    Attributes:
        coefficients: ``[B]``.
        loss: Mean loss, penalty included [nats a decision].
        curvature: Second derivatives of the loss's sum, ``[B, B]``.
    """

    coefficients: FloatArray
    loss: float
    curvature: FloatArray


def fit_offset_logistic(
    outcomes: WeightedOutcomes, *, ridge: FloatArray, start: FloatArray, steps: int = NEWTON_STEPS
) -> LogisticFit:
    """Minimise the weighted cross-entropy plus ``ridge . coefficients^2 / 2``.

    Newton's method with step halving (McCullagh & Nelder 1989, section 4.4).

    Args:
        outcomes: What is learned from.
        ridge: Penalty of each coefficient, above 0, ``[B]``.
        start: Coefficients to start from, ``[B]``.
        steps: At most so many of Newton's steps.
    """
    coefficients = start.copy()
    total = max(float(outcomes.weight.sum()), np.finfo(np.float64).tiny)
    loss = _loss(outcomes, coefficients, ridge)
    for _ in range(steps):
        miss = expit(outcomes.offset + outcomes.basis @ coefficients)
        gradient = outcomes.basis.T @ (outcomes.weight * (outcomes.missed - miss))
        gradient -= ridge * coefficients
        direction = np.linalg.solve(_curvature(outcomes, miss, ridge), gradient)
        decrease = float(gradient @ direction)
        if decrease < GOOD_ENOUGH:
            break
        length, tried = 1.0, np.inf
        while length > SHORTEST_STEP:
            tried = _loss(outcomes, coefficients + length * direction, ridge)
            if tried <= loss - SUFFICIENT_DECREASE * length * decrease:
                break
            length /= 2.0
        if tried >= loss:
            break
        coefficients, loss = coefficients + length * direction, tried
    miss = expit(outcomes.offset + outcomes.basis @ coefficients)
    return LogisticFit(coefficients, loss / total, _curvature(outcomes, miss, ridge))


def leave_one_out_loss(
    outcomes: WeightedOutcomes, fit: LogisticFit, *, group: IntArray, count: int
) -> FloatArray:
    """By how much each group's log likelihood falls if the model is fitted without it.

    To first order, weight * score' curvature^-1 score (infinitesimal jackknife: Cook &
    Weisberg 1982). A model likes what it was fitted to; importance weights must not.

    Args:
        outcomes: What was learned from.
        fit: The model.
        group: Which of ``count`` groups each outcome belongs to, ``[M]``; weights are equal
            within a group.
        count: Number of groups.

    Returns:
        ``[count]`` [nats]; 0 for groups that were not learned from.
    """
    miss = expit(outcomes.offset + outcomes.basis @ fit.coefficients)
    residual = outcomes.missed - miss
    score = np.stack(
        [
            np.bincount(group, weights=column * residual, minlength=count)
            for column in outcomes.basis.T
        ],
        axis=1,
    )
    weight = np.zeros(count)
    weight[group] = outcomes.weight
    return weight * np.einsum("nb,nb->n", score, np.linalg.solve(fit.curvature, score.T).T)


def _curvature(outcomes: WeightedOutcomes, miss: FloatArray, ridge: FloatArray) -> FloatArray:
    scaled = outcomes.basis * (outcomes.weight * miss * (1.0 - miss))[:, None]
    return scaled.T @ outcomes.basis + np.diag(ridge)


def _loss(outcomes: WeightedOutcomes, coefficients: FloatArray, ridge: FloatArray) -> float:
    logit = outcomes.offset + outcomes.basis @ coefficients
    entropy = np.logaddexp(0.0, np.where(outcomes.missed, -logit, logit))
    return float(outcomes.weight @ entropy + 0.5 * ridge @ coefficients**2)
