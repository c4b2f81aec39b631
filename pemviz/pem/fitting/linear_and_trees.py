"""The paper's two baselines, as networks without hidden layers, and gradient-boosted trees.

Boosting minimises the cross-entropy of its training data, so its logits are a little off on
new data. Their slope and intercept are corrected by a logistic regression of the outcomes on
logits that cross-fitted trees gave for obstacles they had not seen (Platt 1999).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GroupKFold, StratifiedKFold
from threadpoolctl import threadpool_limits

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.cards import PemCard
from pemviz.pem.models.network import Layer, NetworkPem, input_names, inputs_of, statistics_of
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.trees import LEAF, LEAF_UNIT, FeatureSet, OwnSet, TreesPem, seen_features

GUESS_MU_RECIPE = "the same probability for every obstacle: the share detected in training"
LR_RECIPE = "scikit-learn LogisticRegression (L2, C = 1) on the paper's 14 inputs"

ROUNDS = 300
LEARNING_RATE = 0.03
LEAVES = 63
LEAF_ROWS = 30
RIDGE = 5.0
CROSS_FITS = 3
BOTH_OUTCOMES = 2
MOST_UNEVEN = 30
"""Obstacles of the rarer outcome below which the logits are left uncalibrated."""


def fit_guess_mu(table: SalientTable, *, card: PemCard) -> NetworkPem:
    """A model that answers with the training data's share of detected obstacles."""
    share = float(table.detected.mean())
    pose_mean, pose_std = statistics_of(table.salient, table.features)
    layer = Layer(
        weight=np.zeros((1, len(input_names(table.features)))),
        bias=np.asarray([np.log(share / (1.0 - share))]),
    )
    return NetworkPem(card, pose_mean, pose_std, (layer,), table.features)


def fit_logistic(table: SalientTable, *, card: PemCard) -> NetworkPem:
    """Logistic regression on the paper's inputs, or on features of one's own."""
    pose_mean, pose_std = statistics_of(table.salient, table.features)
    inputs = inputs_of(table.salient, table.features, pose_mean=pose_mean, pose_std=pose_std).T
    regression = LogisticRegression(max_iter=10_000).fit(inputs, table.detected)
    layer = Layer(
        weight=np.asarray(regression.coef_, dtype=np.float64),
        bias=np.asarray(regression.intercept_, dtype=np.float64),
    )
    return NetworkPem(card, pose_mean, pose_std, (layer,), table.features)


def trees_recipe(seen: Sequence[str], *, by_sequence: bool, calibrated: bool) -> str:
    """How trees that see these features are fitted, for the model card."""
    boosted = (
        f"scikit-learn HistGradientBoostingClassifier on {', '.join(seen)}; "
        f"{ROUNDS} rounds, learning rate {LEARNING_RATE:g}, at most {LEAVES} leaves of at least "
        f"{LEAF_ROWS} obstacles, L2 penalty {RIDGE:g}"
    )
    if not calibrated:
        return f"{boosted}; not calibrated"
    return (
        f"{boosted}; then Platt scaling of the logit, fitted "
        f"to {CROSS_FITS}-fold cross-fitted logits{' of sequences' if by_sequence else ''}"
    )


def fit_trees(
    table: SalientTable,
    *,
    card: PemCard,
    feature_set: FeatureSet | OwnSet,
    seed: int,
    calibrate: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
) -> TreesPem:
    """Train, and calibrate if told to; the same table and seed give the same arrays.

    Folds of the calibration are of sequences if the table has enough; ``on_progress`` is called
    with fits done and fits in all.
    """
    features = seen_features(table.salient, feature_set=feature_set, own=table.features).T
    steps = CROSS_FITS + 1 if calibrate else 1

    def tell(done: int) -> None:
        if on_progress is not None:
            on_progress(done, steps)

    calibration = (1.0, 0.0)
    if calibrate:
        calibration = _calibrate(features, table, seed=seed, tell=tell)
    booster = _boost(features, table.detected, seed=seed)
    tell(steps)
    return _to_arrays(
        booster, card=card, feature_set=feature_set, own=table.features, calibration=calibration
    )


def _boost(
    features: FloatArray, detected: BoolArray, *, seed: int
) -> HistGradientBoostingClassifier:
    # scikit-learn's types take the defaults of these two, which are words, for all there is.
    numbers_only: dict[str, Any] = {"early_stopping": False, "categorical_features": None}
    booster = HistGradientBoostingClassifier(
        max_iter=ROUNDS,
        learning_rate=LEARNING_RATE,
        max_leaf_nodes=LEAVES,
        min_samples_leaf=LEAF_ROWS,
        l2_regularization=RIDGE,
        random_state=seed,
        **numbers_only,
    )
    # One thread: the same sums everywhere, and threads that wait for each other cost more than
    # they bring at this size.
    with threadpool_limits(1):
        return booster.fit(features, detected)


def _calibrate(
    features: FloatArray, table: SalientTable, *, seed: int, tell: Callable[[int], None]
) -> tuple[float, float]:
    """Slope and intercept, (1, 0) where there are too few of one outcome to cross-fit."""
    detected, sequence = table.detected, table.sequence
    if min(detected.sum(), (~detected).sum()) < MOST_UNEVEN:
        return 1.0, 0.0
    logits = np.empty(len(detected))
    fold = _folds(features, detected, sequence, seed=seed)
    for index in range(CROSS_FITS):
        train, held_out = fold != index, fold == index
        if np.unique(detected[train]).size < BOTH_OUTCOMES:
            return 1.0, 0.0
        booster = _boost(features[train], detected[train], seed=seed)
        logits[held_out] = booster.decision_function(features[held_out])
        tell(index + 1)
    return platt_scaling(logits, detected)


def platt_scaling(logit: FloatArray, detected: BoolArray) -> tuple[float, float]:
    """Slope and intercept that calibrate logits ``[n]`` of models that did not see ``detected``.

    (1, 0) where there are too few of one outcome, or where no rising line explains them (Platt,
    'Probabilistic outputs for support vector machines', 1999).
    """
    if min(detected.sum(), (~detected).sum()) < MOST_UNEVEN:
        return 1.0, 0.0
    line = LogisticRegression(C=1e6).fit(logit[:, None], detected)
    slope = float(np.asarray(line.coef_)[0, 0])
    return (slope, float(np.asarray(line.intercept_)[0])) if slope > 0.0 else (1.0, 0.0)


def _folds(
    features: FloatArray, detected: BoolArray, sequence: IntArray | None, *, seed: int
) -> IntArray:
    """Fold of each row, shape [n].

    Sequences stay whole if there are enough; else equal rows, as a bootstrap sample has, do.
    """
    if sequence is None or np.unique(sequence).size < CROSS_FITS:
        _, first, group = np.unique(features, axis=0, return_index=True, return_inverse=True)
        splitter = StratifiedKFold(CROSS_FITS, shuffle=True, random_state=seed)
        parts = splitter.split(first, detected[first])
    else:
        group = np.arange(len(sequence))
        parts = GroupKFold(CROSS_FITS).split(sequence, groups=sequence)
    fold_of_group = np.empty(int(np.max(group)) + 1, dtype=np.int64)
    for index, (_, held_out) in enumerate(parts):
        fold_of_group[held_out] = index
    return fold_of_group[np.ravel(group)]


def _to_arrays(
    booster: Any,
    *,
    card: PemCard,
    feature_set: FeatureSet | OwnSet,
    own: OwnFeatures | None,
    calibration: tuple[float, float],
) -> TreesPem:
    """Take the trees out of scikit-learn, which has no public way to store them but pickle."""
    parts: list[dict[str, AnyArray]] = []
    roots: list[int] = []
    start = 0
    for (tree,) in booster._predictors:
        roots.append(start)
        parts.append(_renumbered(tree.nodes, first=start))
        start += len(tree.nodes)
    joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    slope, intercept = calibration
    baseline = float(np.ravel(booster._baseline_prediction)[0])
    return TreesPem(
        card=card,
        feature_set=feature_set,
        **joined,
        root=np.asarray(roots, dtype=np.int32),
        calibration=np.asarray([slope, intercept + slope * baseline]),
        own=own,
    )


def _renumbered(nodes: AnyArray, *, first: int) -> dict[str, AnyArray]:
    """One tree's nodes, breadth first from index ``first``, siblings next to each other."""
    order = [0]
    left = np.zeros(len(nodes), dtype=np.int32)
    position = 0
    while position < len(order):
        node = nodes[order[position]]
        if not node["is_leaf"]:
            left[position] = first + len(order)
            order.extend((int(node["left"]), int(node["right"])))
        position += 1
    sorted_nodes = nodes[order]
    is_leaf = sorted_nodes["is_leaf"].astype(bool)
    leaf_value = np.round(sorted_nodes["value"] / LEAF_UNIT) * LEAF_UNIT
    return {
        "feature": np.where(is_leaf, LEAF, sorted_nodes["feature_idx"]).astype(np.uint8),
        "number": np.where(is_leaf, leaf_value, sorted_nodes["num_threshold"]),
        "left": left,
    }
