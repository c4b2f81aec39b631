"""The paper's two baselines, as networks without hidden layers."""

import numpy as np
from sklearn.linear_model import LogisticRegression

from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.encoding import PAPER_INPUTS, paper_inputs, pose_statistics
from pemviz.pem.models.network import Layer, NetworkPem

GUESS_MU_RECIPE = "the same probability for every obstacle: the share detected in training"
LR_RECIPE = "scikit-learn LogisticRegression (L2, C = 1) on the paper's 14 inputs"


def fit_guess_mu(table: SalientTable, *, card: PemCard) -> NetworkPem:
    """A model that answers with the training data's share of detected obstacles.

    Raises:
        PemError: all obstacles have the same outcome, so that the logit is infinite.
    """
    require_both_outcomes(table)
    share = float(table.detected.mean())
    pose_mean, pose_std = pose_statistics(table.salient)
    layer = Layer(
        weight=np.zeros((1, len(PAPER_INPUTS))), bias=np.asarray([np.log(share / (1.0 - share))])
    )
    return NetworkPem(card, pose_mean, pose_std, (layer,))


def fit_logistic(table: SalientTable, *, card: PemCard) -> NetworkPem:
    """Logistic regression on the paper's inputs.

    Raises:
        PemError: all obstacles have the same outcome.
    """
    require_both_outcomes(table)
    pose_mean, pose_std = pose_statistics(table.salient)
    inputs = paper_inputs(table.salient, pose_mean=pose_mean, pose_std=pose_std).T
    regression = LogisticRegression(max_iter=10_000).fit(inputs, table.detected)
    layer = Layer(
        weight=np.asarray(regression.coef_, dtype=np.float64),
        bias=np.asarray(regression.intercept_, dtype=np.float64),
    )
    return NetworkPem(card, pose_mean, pose_std, (layer,))


def require_both_outcomes(table: SalientTable) -> None:
    """Refuse a table from which nothing can be learnt.

    Raises:
        PemError: every obstacle was detected, or none was.
    """
    if table.detected.all() or not table.detected.any():
        outcome = "detected" if table.detected.all() else "missed"
        raise PemError(f"{table.source}: all {len(table)} obstacles were {outcome}")
