"""Boosted decision trees as plain arrays, evaluated by numpy."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import ROWS, distinct, map_distinct
from pemviz.errors import PemError
from pemviz.pem.models.card import Carded, PemCard
from pemviz.pem.models.encoding import check_rows
from pemviz.pem.models.protocol import as_rows
from pemviz.pem.models.tensors import check_finite, tensors_digest
from pemviz.pem.models.tree_features import FEATURES, FeatureSet, tree_features

BLOCK_ROWS = 4 * ROWS
"""Rows that go down the trees together."""

LEAF = 255
"""Marks a leaf where a node's feature stands."""

LEAF_UNIT = 2.0**-40
"""Leaf values are multiples of this, so that their sums are exact in whatever order."""

LARGEST_SUM = 4096
"""Of absolute leaf values over all trees: with LEAF_UNIT, within the 53 bits of a float64."""

LARGEST_CALIBRATION = 1e100

LARGEST_CELL = 2**62
"""Numbers of cells between thresholds stay below it, within an int64."""


MOST_TREES = 10_000
DEEPEST = 200
"""Levels of a tree; boosted trees have about ten."""


@dataclass(frozen=True, eq=False)
class TreesPem(Carded):
    """A sum of trees, mapped to the logit of P(detected) by a calibration line."""

    kind: ClassVar[str] = "trees"

    card: PemCard
    feature_set: FeatureSet
    """Which features the trees look at."""
    feature: AnyArray
    """Per node, the index of the feature it splits on or LEAF; uint8, shape [nodes]."""
    number: FloatArray
    """Per node, the threshold (left if feature <= threshold) or a leaf's value; shape [nodes]."""
    left: AnyArray
    """Per node, its left child, next to which stands the right one; int32, shape [nodes]."""
    root: AnyArray
    """First node of each tree; int32, shape [trees]."""
    calibration: FloatArray
    """Slope and intercept from the sum of leaves to the logit; shape [2]."""

    def __post_init__(self) -> None:
        """Refuse arrays that do not form trees.

        Raises:
            PemError: what is wrong, in one line.
        """
        check_finite(self.tensors(), where=self.card.name)
        check_trees(self)

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors and the feature set."""
        return tensors_digest(f"{self.kind}:{self.feature_set}", self.tensors())

    def tensors(self) -> dict[str, AnyArray]:
        """Everything that decides the answers, by the names used in files."""
        return {
            "trees.feature": self.feature,
            "trees.number": self.number,
            "trees.left": self.left,
            "trees.root": self.root,
            "calibration": self.calibration,
        }

    def options(self) -> dict[str, Any]:
        """What a file must say beside the tensors: the inputs in order."""
        return {"feature_set": self.feature_set, "inputs": list(FEATURES[self.feature_set])}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11]."""
        rows, shape = as_rows(salient)
        check_rows(rows)
        sums = map_distinct(self._sums, rows)
        return (self.calibration[0] * sums + self.calibration[1]).reshape(shape)

    def _sums(self, rows: FloatArray) -> FloatArray:
        """Sum over trees of the leaf values, shape [n], of salient variables [n, 11]."""
        if not len(rows):
            return np.empty(0)
        features = self._features(rows)
        first, place = self._plan.alike(features)
        apart = features[:, first]
        sums = [
            self._leaf_sums(apart[:, start : start + BLOCK_ROWS])
            for start in range(0, first.size, BLOCK_ROWS)
        ]
        return np.concatenate(sums)[place]

    def _features(self, rows: FloatArray) -> FloatArray:
        """Features [features, n], computed in chunks of fixed size."""
        padded = np.zeros((-(-len(rows) // ROWS) * ROWS, rows.shape[1]))
        padded[: len(rows)] = rows
        chunks = [
            tree_features(padded[start : start + ROWS], feature_set=self.feature_set)
            for start in range(0, len(padded), ROWS)
        ]
        return np.concatenate(chunks, axis=1)[:, : len(rows)]

    def _leaf_sums(self, features: FloatArray) -> FloatArray:
        """Sum over trees of the leaf values, shape [n], of features [features, n]."""
        plan = self._plan
        jump = plan.shortcuts(features)
        columns = features.shape[1]
        node = np.repeat(jump[self.root], columns)
        row = np.tile(np.arange(columns), len(self.root))
        sums = np.zeros(columns)
        while len(node):
            at_leaf = plan.is_leaf[node]
            sums += np.bincount(row[at_leaf], weights=self.number[node[at_leaf]], minlength=columns)
            node, row = node[~at_leaf], row[~at_leaf]
            goes_right = features[plan.feature[node], row] > self.number[node]
            node = jump[plan.left[node] + goes_right]
        return sums

    @cached_property
    def _plan(self) -> "_Plan":
        inner = self.feature != LEAF
        return _Plan(
            thresholds=tuple(
                np.unique(self.number[inner & (self.feature == index)])
                for index in range(len(FEATURES[self.feature_set]))
            ),
            is_leaf=self.feature == LEAF,
            feature=np.where(self.feature == LEAF, 0, self.feature).astype(np.int64),
            number=self.number,
            left=self.left.astype(np.int64),
        )


@dataclass(frozen=True, eq=False)
class _Plan:
    """The nodes in the types that indexing wants, and by feature the ascending thresholds."""

    thresholds: tuple[FloatArray, ...]
    is_leaf: BoolArray
    feature: IntArray
    number: FloatArray
    left: IntArray

    def alike(self, features: FloatArray) -> tuple[IntArray, IntArray]:
        """Of rows [features, n], the first [m] of those that no split parts, and which each is [n].

        Along one variable trees are a staircase of few steps, however many rows there are.
        """
        cell, cells = np.zeros(features.shape[1], dtype=np.int64), 1
        for thresholds, values in zip(self.thresholds, features, strict=True):
            parting = thresholds[(thresholds >= values.min()) & (thresholds < values.max())]
            if cells * (parting.size + 1) > LARGEST_CELL:
                cell, cells = distinct(cell)[1].astype(np.int64), cell.size
            cell = cell * (parting.size + 1) + np.searchsorted(parting, values)
            cells *= parting.size + 1
        return distinct(cell)

    def shortcuts(self, features: FloatArray) -> IntArray:
        """For each node, the first node below it where rows [features, n] could part; [nodes].

        In a scenario most variables stand still, so most splits send all rows one way.
        """
        low, high = features.min(axis=1), features.max(axis=1)
        here = np.arange(len(self.left))
        all_left = ~self.is_leaf & (high[self.feature] <= self.number)
        all_right = ~self.is_leaf & (low[self.feature] > self.number)
        jump = np.where(all_left, self.left, np.where(all_right, self.left + 1, here))
        while True:
            further = jump[jump]
            if np.array_equal(further, jump):
                return jump
            jump = further


def check_trees(pem: TreesPem) -> None:
    """Refuse trees with dangling, backward or shared children, or unknown features.

    Children must come after their parent, so that going down a tree ends.

    Raises:
        PemError: what is wrong, in one line.
    """
    where, nodes = pem.card.name, len(pem.feature)
    if pem.feature_set not in FEATURES:
        raise PemError(f"{where}: feature set {pem.feature_set!r}, allowed: {', '.join(FEATURES)}")
    one_axis = (pem.feature, pem.number, pem.left, pem.root)
    if any(array.ndim != 1 for array in one_axis) or pem.calibration.shape != (2,):
        raise PemError(f"{where}: trees need arrays of one axis and two calibration numbers")
    if len(pem.number) != nodes or len(pem.left) != nodes:
        raise PemError(f"{where}: the trees' arrays differ in length")
    if pem.feature.dtype.kind != "u" or {pem.left.dtype.kind, pem.root.dtype.kind} != {"i"}:
        raise PemError(f"{where}: the trees' features and children must be integers")
    inner = pem.feature != LEAF
    if (pem.feature[inner] >= len(FEATURES[pem.feature_set])).any():
        raise PemError(f"{where}: a tree splits on an unknown feature")
    children = pem.left[inner].astype(np.int64)  # a narrower type would wrap around below
    if (children <= np.arange(nodes)[inner]).any() or (children >= nodes - 1).any():
        raise PemError(f"{where}: a tree's child lies outside its tree")
    if len(pem.root) == 0 or (pem.root < 0).any() or (pem.root >= nodes).any():
        raise PemError(f"{where}: a tree's root lies outside the nodes")
    if not pem.calibration[0] > 0.0:
        raise PemError(f"{where}: the calibration's slope must be above 0")
    _check_size(pem, inner=inner, where=where)


def _check_size(pem: TreesPem, *, inner: BoolArray, where: str) -> None:
    """Refuse sound trees that take too much memory or time, or whose sums are not exact.

    Raises:
        PemError: what is wrong, in one line.
    """
    if len(pem.root) > MOST_TREES:
        raise PemError(f"{where}: has {len(pem.root)} trees, allowed: at most {MOST_TREES}")
    level = pem.root.astype(np.int64)
    for _ in range(DEEPEST):
        level = level[inner[level]]
        if not len(level):
            break
        below = pem.left[level].astype(np.int64)
        level = np.unique(np.concatenate([below, below + 1]))
    else:
        raise PemError(f"{where}: a tree is deeper than {DEEPEST} levels")
    leaves = pem.number[~inner]
    largest = float(np.max(np.abs(leaves), initial=0.0))
    if largest * len(pem.root) > LARGEST_SUM or (leaves / LEAF_UNIT % 1.0 != 0.0).any():
        raise PemError(
            f"{where}: leaf values must be multiples of 2^-40 whose sums stay within {LARGEST_SUM}"
        )
    if not np.abs(pem.calibration).max() <= LARGEST_CALIBRATION:
        raise PemError(f"{where}: calibration numbers must be at most {LARGEST_CALIBRATION:g}")
