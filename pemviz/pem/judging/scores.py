"""Scores of predicted detection probabilities, from logits and outcomes."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from pemviz.arrays import BoolArray, FloatArray, IntArray

RELIABILITY_BINS = 15


@dataclass(frozen=True)
class ReliabilityBin:
    """Obstacles of similar predicted probability."""

    obstacles: int
    """How many."""
    predicted: float
    """Their mean predicted P(detected)."""
    observed: float
    """Share of them that was detected."""


@dataclass(frozen=True)
class Scores:
    """Scores of one model on one set of obstacles."""

    obstacles: int
    """How many."""
    missed: int
    """How many of them the detector missed."""
    bce: float
    """Binary cross-entropy [nats per obstacle]."""
    roc_auc: float | None
    """Area under the ROC curve; None if only one outcome occurs."""
    brier: float
    """Mean squared error of the probability."""
    mean_miss: float
    """Mean predicted P(missed)."""


def binary_cross_entropy(logit: FloatArray, detected: BoolArray) -> float:
    """Mean of -log of the probability given to what happened [nats]; arrays [n]."""
    return float(np.mean(np.logaddexp(0.0, np.where(detected, -logit, logit))))


def roc_auc(logit: FloatArray, detected: BoolArray) -> float | None:
    """Area under the ROC curve by ranks (Mann and Whitney), ties counting half; arrays [n]."""
    positives = int(detected.sum())
    negatives = len(detected) - positives
    if positives == 0 or negatives == 0:
        return None
    from scipy.stats import rankdata  # noqa: PLC0415  slow to import

    rank_sum = float(rankdata(logit)[detected].sum())
    return (rank_sum - positives * (positives + 1) / 2.0) / (positives * negatives)


def score(logit: FloatArray, detected: BoolArray) -> Scores:
    """All scores of logits [n] against outcomes [n]."""
    probability = expit(logit)
    return Scores(
        obstacles=len(detected),
        missed=int((~detected).sum()),
        bce=binary_cross_entropy(logit, detected),
        roc_auc=roc_auc(logit, detected),
        brier=float(np.mean((probability - detected) ** 2)),
        mean_miss=float(np.mean(expit(-logit))),
    )


def reliability(
    logit: FloatArray, detected: BoolArray, *, bins: int = RELIABILITY_BINS
) -> tuple[ReliabilityBin, ...]:
    """Bins of equal numbers of obstacles, in order of predicted probability; arrays [n]."""
    order: IntArray = np.argsort(logit, kind="stable")
    probability = expit(logit)
    return tuple(
        ReliabilityBin(
            obstacles=len(rows),
            predicted=float(probability[rows].mean()),
            observed=float(detected[rows].mean()),
        )
        for rows in np.array_split(order, bins)
        if len(rows)
    )


def calibration_error(bins: tuple[ReliabilityBin, ...]) -> float:
    """Expected calibration error: mean gap of predicted and observed, weighted by obstacles."""
    total = sum(each.obstacles for each in bins)
    gaps = sum(each.obstacles * abs(each.predicted - each.observed) for each in bins)
    return gaps / total
