"""Which detection belongs to which obstacle, by how near their centres are."""

import numpy as np

from pemviz.arrays import FloatArray, IntArray

PAPER_IOU = 0.01
"""Overlap above which the paper's authors counted a pair as a detection."""


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
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  slow to import

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
