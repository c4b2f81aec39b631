"""Which detection belongs to which obstacle: Hungarian on the overlap (IoU) of boxes."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from pemviz.arrays import FloatArray, IntArray
from pemviz.pem.data.kitti_labels import (
    Box,
)

PAPER_IOU = 0.01
"""Overlap above which the paper's authors counted a pair as a detection."""


def assign_boxes(
    obstacles: Sequence[Box],
    detections: Sequence[Box],
    *,
    types: tuple[Sequence[str], Sequence[str]] | None = None,
) -> tuple[FloatArray, IntArray]:
    """IoU of each obstacle with the detection assigned to it or 0, and which one it is or -1.

    Each box has at most one partner; the assignment maximises the sum of overlaps (Kuhn's
    Hungarian method, by scipy). With the classes of both only boxes of the same class may be
    partners.
    """
    result = np.zeros(len(obstacles))
    partner = np.full(len(obstacles), -1, dtype=np.int64)
    if not obstacles or not detections:
        return result, partner
    overlap = iou(np.asarray(obstacles, dtype=np.float64), np.asarray(detections, dtype=np.float64))
    if types is not None:
        overlap *= np.asarray(types[0])[:, None] == np.asarray(types[1])[None, :]
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    result[rows] = overlap[rows, columns]
    partner[rows] = columns
    return result, partner


def assign_centres(
    obstacles: FloatArray, detections: FloatArray, *, below_m: float
) -> tuple[FloatArray, IntArray]:
    """Distance of each obstacle to the detection assigned to it [m] or infinity, and which or -1.

    Places are ``[n, 2]`` and ``[m, 2]`` [m]. Each has at most one partner, nearer than ``below_m``;
    the assignment maximises the sum of :func:`nearness`.
    """
    apart = np.full(len(obstacles), np.inf)
    partner = np.full(len(obstacles), -1, dtype=np.int64)
    if not len(obstacles) or not len(detections):
        return apart, partner
    near = nearness(obstacles, detections, below_m=below_m)
    rows, columns = linear_sum_assignment(near, maximize=True)
    paired = near[rows, columns] > 0.0
    partner[rows[paired]] = columns[paired]
    apart[rows[paired]] = below_m * (1.0 - near[rows, columns][paired])
    return apart, partner


def nearness(first: FloatArray, second: FloatArray, *, below_m: float) -> FloatArray:
    """1 for equal places, falling to 0 at ``below_m`` and beyond: [n, 2] and [m, 2], [n, m]."""
    apart = np.hypot(*np.moveaxis(first[:, None, :] - second[None, :, :], -1, 0))
    return np.maximum(1.0 - apart / below_m, 0.0)


def iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Intersection over union of boxes [n, 4] and [m, 4] (left, top, right, bottom), [n, m]."""
    upper_left = np.maximum(first[:, None, :2], second[None, :, :2])
    lower_right = np.minimum(first[:, None, 2:], second[None, :, 2:])
    intersection = np.prod(np.maximum(lower_right - upper_left, 0.0), axis=-1)
    area, other = (np.prod(boxes[:, 2:] - boxes[:, :2], axis=-1) for boxes in (first, second))
    union = area[:, None] + other[None, :] - intersection
    return np.divide(intersection, union, out=np.zeros_like(intersection), where=union > 0.0)
