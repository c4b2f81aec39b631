"""Boosted decision trees as plain arrays, evaluated by numpy.

A tree splits one number at a time, so ratios such as the angle under which an obstacle appears are
given to it ready-made.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.chunks import ROWS, distinct, map_distinct
from pemviz.errors import PemError
from pemviz.pem.models.cards import Carded, PemCard
from pemviz.pem.models.network import sound_rows
from pemviz.pem.models.own_features import OwnFeatures
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS, check_finite, tensors_digest

FeatureSet = Literal["paper", "raw"]
OwnSet = Literal["own"]
"""What trees see of features of one's own."""
OWN: Final[OwnSet] = "own"

NEAREST_DEPTH_M = 0.5
"""Depth below which an obstacle's apparent size no longer grows."""

PAPER_COLUMNS = ("class_id", "occlusion", "x_m", "y_m", "z_m", "rotation_y_rad")
_FROM_POSE = ("x_over_z", "y_over_z", "range_m", "sin_view", "cos_view")
_FROM_SIZE = ("top_over_z", "height_over_z", "extent_over_z")

FEATURES: dict[FeatureSet, tuple[str, ...]] = {
    "paper": (*PAPER_COLUMNS, *_FROM_POSE),
    "raw": (*SALIENT_COLUMNS, *_FROM_POSE, *_FROM_SIZE),
}
"""Names of the features of each set, in order."""

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


def tree_features(rows: FloatArray, *, feature_set: FeatureSet) -> FloatArray:
    """Features [features, n] of salient variables [n, 11].

    Args:
        rows: salient variables.
        feature_set: ``paper`` uses only what the paper's 14 inputs hold, ``raw`` all columns.
    """
    named = {name: np.ascontiguousarray(rows[:, index]) for name, index in COLUMN.items()}
    x_m, y_m, z_m = named["x_m"], named["y_m"], named["z_m"]
    depth = np.maximum(z_m, NEAREST_DEPTH_M)
    # the obstacle's heading relative to the line of sight
    view = named["rotation_y_rad"] - np.arctan2(x_m, z_m)
    named["x_over_z"], named["y_over_z"] = x_m / depth, y_m / depth
    named["range_m"] = np.sqrt(x_m**2 + z_m**2)
    named["sin_view"], named["cos_view"] = np.sin(view), np.cos(view)
    if feature_set == "raw":
        # the upper edge, apparent height and apparent width, as tangents of angles
        extent = np.abs(named["length_m"] * named["sin_view"])
        extent = extent + np.abs(named["width_m"] * named["cos_view"])
        named["top_over_z"] = (y_m - named["height_m"]) / depth
        named["height_over_z"] = named["height_m"] / depth
        named["extent_over_z"] = extent / depth
    return np.stack([named[name] for name in FEATURES[feature_set]])


def seen_names(feature_set: FeatureSet | OwnSet, own: OwnFeatures | None) -> tuple[str, ...]:
    """Names of what trees split on, in order."""
    if own is not None:
        return own.input_names
    return () if feature_set == OWN else FEATURES[feature_set]


def seen_features(
    rows: FloatArray, *, feature_set: FeatureSet | OwnSet, own: OwnFeatures | None
) -> FloatArray:
    """What trees see ``[features, n]`` of rows ``[n, D]``."""
    if own is not None:
        count = len(own.numeric)
        return own.inputs(rows, mean=np.zeros(count), std=np.ones(count))
    assert feature_set != OWN  # noqa: S101  refused where a model is made
    return tree_features(rows, feature_set=feature_set)


@dataclass(frozen=True, eq=False)
class TreesPem(Carded):
    """A sum of trees, mapped to the logit of P(detected) by a calibration line.

    Raises:
        PemError: the arrays do not form trees, or such that take too much memory or time.
    """

    kind: ClassVar[str] = "trees"

    card: PemCard
    feature_set: FeatureSet | OwnSet
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
    own: OwnFeatures | None = None
    """With the feature set ``own``: what they see in place of a road user's salient variables."""

    def __post_init__(self) -> None:
        check_finite(self.tensors(), where=self.card.name)
        _check_trees(self)
        _check_size(self)

    @property
    def digest(self) -> str:
        """SHA-256 of the tensors and the feature set."""
        seen = self.feature_set if self.own is None else self.own.to_json()
        return tensors_digest(f"{self.kind}:{seen}", self.tensors())

    @property
    def seen(self) -> tuple[str, ...]:
        """Names of what its trees split on, in order."""
        return seen_names(self.feature_set, self.own)

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
        named = {"feature_set": self.feature_set, "inputs": list(self.seen)}
        return named if self.own is None else {**named, "features": self.own.to_json()}

    def logit(self, salient: ArrayLike) -> FloatArray:
        """Logit of P(detected), shape [...], of salient variables [..., 11], or of its own."""
        rows, shape = sound_rows(salient, self.own)
        sums = map_distinct(self._sums, rows)
        return (self.calibration[0] * sums + self.calibration[1]).reshape(shape)

    def _sums(self, rows: FloatArray) -> FloatArray:
        if not len(rows):
            return np.empty(0)
        # in chunks of fixed size, so that a row's last digits do not depend on how many there are
        padded = np.zeros((-(-len(rows) // ROWS) * ROWS, rows.shape[1]))
        padded[: len(rows)] = rows
        chunks = [
            seen_features(padded[start : start + ROWS], feature_set=self.feature_set, own=self.own)
            for start in range(0, len(padded), ROWS)
        ]
        features = np.concatenate(chunks, axis=1)[:, : len(rows)]
        first, place = self._plan.equal(features)
        apart = features[:, first]
        sums = [
            self._leaf_sums(apart[:, start : start + BLOCK_ROWS])
            for start in range(0, first.size, BLOCK_ROWS)
        ]
        return np.concatenate(sums)[place]

    def _leaf_sums(self, features: FloatArray) -> FloatArray:
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
                for index in range(len(self.seen))
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

    def equal(self, features: FloatArray) -> tuple[IntArray, IntArray]:
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


def _check_trees(pem: TreesPem) -> None:
    """Refuse trees with dangling, backward or shared children, or unknown features.

    Children must come after their parent, so that going down a tree ends.
    """
    where, nodes = pem.card.name, len(pem.feature)
    if (pem.feature_set == OWN) != (pem.own is not None):
        raise PemError(f"{where}: feature set {pem.feature_set!r} does not go with its features")
    if pem.own is None and pem.feature_set not in FEATURES:
        raise PemError(f"{where}: feature set {pem.feature_set!r}, allowed: {', '.join(FEATURES)}")
    one_axis = (pem.feature, pem.number, pem.left, pem.root)
    if any(array.ndim != 1 for array in one_axis) or pem.calibration.shape != (2,):
        raise PemError(f"{where}: trees need arrays of one axis and two calibration numbers")
    if len(pem.number) != nodes or len(pem.left) != nodes:
        raise PemError(f"{where}: the trees' arrays differ in length")
    if pem.feature.dtype.kind != "u" or {pem.left.dtype.kind, pem.root.dtype.kind} != {"i"}:
        raise PemError(f"{where}: the trees' features and children must be integers")
    inner = pem.feature != LEAF
    if (pem.feature[inner] >= len(pem.seen)).any():
        raise PemError(f"{where}: a tree splits on an unknown feature")
    children = pem.left[inner].astype(np.int64)  # a narrower type would wrap around below
    if (children <= np.arange(nodes)[inner]).any() or (children >= nodes - 1).any():
        raise PemError(f"{where}: a tree's child lies outside its tree")
    if len(pem.root) == 0 or (pem.root < 0).any() or (pem.root >= nodes).any():
        raise PemError(f"{where}: a tree's root lies outside the nodes")
    if not pem.calibration[0] > 0.0:
        raise PemError(f"{where}: the calibration's slope must be above 0")


def _check_size(pem: TreesPem) -> None:
    """Refuse sound trees that take too much memory or time, or whose sums are not exact."""
    where, inner = pem.card.name, pem.feature != LEAF
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
