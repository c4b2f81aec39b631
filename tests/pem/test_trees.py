"""Rows that no split parts are asked once; the answers are those of a walk down every tree."""

import math

import numpy as np
import pytest

from pemviz.pem import load_pem
from pemviz.pem.models import trees
from pemviz.pem.models.trees import tree_features
from tests.pem.helpers import braking_rows, random_rows

PEM = load_pem("gb-raw")


def walked(pem, row):
    """Logit of one row [11], node by node."""
    features = tree_features(row[None], feature_set=pem.feature_set)[:, 0]
    leaves = []
    for root in pem.root:
        node = int(root)
        while pem.feature[node] != trees.LEAF:
            goes_right = features[pem.feature[node]] > pem.number[node]
            node = int(pem.left[node]) + int(goes_right)
        leaves.append(float(pem.number[node]))
    return pem.calibration[0] * math.fsum(leaves) + pem.calibration[1]


@pytest.mark.parametrize("largest_cell", [trees.LARGEST_CELL, 100])
@pytest.mark.parametrize(
    "rows",
    [
        braking_rows(np.linspace(-5.0, 40.0, 3000)),
        random_rows(np.random.default_rng(3), 3000),
        braking_rows([]),
    ],
    ids=["along a gap", "anywhere", "none"],
)
def test_walking_down_every_tree(monkeypatch, rows, largest_cell):
    monkeypatch.setattr(trees, "LARGEST_CELL", largest_cell)
    every_75th = slice(None, None, 75)
    expected = [walked(PEM, row) for row in rows[every_75th]]
    np.testing.assert_array_equal(PEM.logit(rows)[every_75th], expected)


def test_rows_on_both_sides_of_a_threshold_are_told_apart():
    # left if feature <= threshold: the threshold itself and the next number above it part
    plan = PEM._plan
    depth = trees.FEATURES[PEM.feature_set].index("z_m")
    threshold = plan.thresholds[depth][plan.thresholds[depth].size // 2]
    features = np.zeros((len(plan.thresholds), 3))
    features[depth] = [np.nextafter(threshold, -np.inf), threshold, np.nextafter(threshold, np.inf)]
    first, place = plan.equal(features)
    np.testing.assert_array_equal(first, [0, 2])
    np.testing.assert_array_equal(place, [0, 0, 1])
