"""What the boosted trees see: salient columns and what the geometry of a camera makes of them.

A tree splits one number at a time, so ratios such as the angle under which an obstacle appears
are given to it ready-made.
"""

from typing import Literal

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.pem.models.protocol import COLUMN, SALIENT_COLUMNS

FeatureSet = Literal["paper", "raw"]

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


def tree_features(rows: FloatArray, *, feature_set: FeatureSet) -> FloatArray:
    """Features [features, n] of salient variables [n, 11].

    Args:
        rows: salient variables.
        feature_set: ``paper`` uses only what the paper's 14 inputs hold, ``raw`` all columns.
    """
    columns = {name: np.ascontiguousarray(rows[:, index]) for name, index in COLUMN.items()}
    named = {**columns, **_from_pose(columns)}
    if feature_set == "raw":
        named |= _from_size(columns, sin_view=named["sin_view"], cos_view=named["cos_view"])
    return np.stack([named[name] for name in FEATURES[feature_set]])


def _depth(columns: dict[str, FloatArray]) -> FloatArray:
    return np.maximum(columns["z_m"], NEAREST_DEPTH_M)


def _from_pose(columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Bearing, range, and the obstacle's heading relative to the line of sight."""
    depth = _depth(columns)
    view = columns["rotation_y_rad"] - np.arctan2(columns["x_m"], columns["z_m"])
    return {
        "x_over_z": columns["x_m"] / depth,
        "y_over_z": columns["y_m"] / depth,
        "range_m": np.sqrt(columns["x_m"] ** 2 + columns["z_m"] ** 2),
        "sin_view": np.sin(view),
        "cos_view": np.cos(view),
    }


def _from_size(
    columns: dict[str, FloatArray], *, sin_view: FloatArray, cos_view: FloatArray
) -> dict[str, FloatArray]:
    """Apparent height, apparent width and the upper edge, as tangents of angles."""
    depth = _depth(columns)
    extent = np.abs(columns["length_m"] * sin_view) + np.abs(columns["width_m"] * cos_view)
    return {
        "top_over_z": (columns["y_m"] - columns["height_m"]) / depth,
        "height_over_z": columns["height_m"] / depth,
        "extent_over_z": extent / depth,
    }
