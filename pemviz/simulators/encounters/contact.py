"""Where within a step the ego touches another car: two rectangles moved along straight lines.

Arrays have a row for each other car, ``[K, N]``.
"""

import numpy as np

from pemviz.arrays import FloatArray


def first_touch(
    before_m: tuple[FloatArray, FloatArray],
    after_m: tuple[FloatArray, FloatArray],
    *,
    reach_m: tuple[float, float],
) -> FloatArray:
    """The least share f of a step, from 0 to 1, at which centres are within reach; else infinity.

    Args:
        before_m: Distances between centres along the road and across, ``[...]`` each [m].
        after_m: The same at the end of the step.
        reach_m: How far apart centres of cars that touch are, along the road and across [m].
    """
    enters, leaves = np.zeros_like(before_m[0]), np.ones_like(before_m[0])
    for first, last, reach in zip(before_m, after_m, reach_m, strict=True):
        moved = last - first
        still = moved == 0.0
        speed = np.where(still, 1.0, moved)
        with np.errstate(over="ignore"):  # hardly moved: an end is infinitely far
            ends = np.stack([(-reach - first) / speed, (reach - first) / speed])
        inside = np.abs(first) <= reach
        enters = np.maximum(enters, np.where(still, np.where(inside, 0.0, np.inf), ends.min(0)))
        leaves = np.minimum(leaves, np.where(still, np.where(inside, 1.0, -np.inf), ends.max(0)))
    return np.where(enters <= leaves, enters, np.inf)
