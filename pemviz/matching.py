"""Which detection belongs to which obstacle: by overlap of boxes, by nearness of centres."""

from collections.abc import Sequence

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray

Box = tuple[float, float, float, float]
"""Left, top, right, bottom [px]."""
PAPER_IOU = 0.01
"""Overlap above which the paper's authors counted a pair as a detection."""


def iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Intersection over union of boxes ``[..., A, 4]`` and ``[..., B, 4]``, ``[..., A, B]``.

    0 where a side is NaN.
    """
    one, other = first[..., :, None, :], second[..., None, :, :]
    wide = np.minimum(one[..., 2], other[..., 2]) - np.maximum(one[..., 0], other[..., 0])
    tall = np.minimum(one[..., 3], other[..., 3]) - np.maximum(one[..., 1], other[..., 1])
    both = wide.clip(0.0) * tall.clip(0.0)
    areas = [(b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1]) for b in (one, other)]
    union = areas[0] + areas[1] - both
    return np.divide(both, union, out=np.zeros_like(both), where=union > 0.0)


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
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  slow to import

    overlap = iou(np.asarray(obstacles, dtype=np.float64), np.asarray(detections, dtype=np.float64))
    if types is not None:
        overlap *= np.asarray(types[0])[:, None] == np.asarray(types[1])[None, :]
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    result[rows] = overlap[rows, columns]
    partner[rows] = columns
    return result, partner


def matched(
    obstacles: FloatArray,
    detections: FloatArray,
    *,
    obstacle_counts: BoolArray,
    detection_counts: BoolArray,
    above: float,
) -> BoolArray:
    """Which obstacles are detected ``[N, K]`` in N images, as ``pemviz pem collect`` says.

    Each detection belongs to one obstacle at most, and the sum of overlaps is as large as it can
    be. Where every obstacle's best detection is another one, that is it; the few others are
    assigned by :func:`assign_boxes`.

    Args:
        obstacles: Boxes ``[N, K, 4]`` [px].
        detections: Boxes ``[N, D, 4]`` [px].
        obstacle_counts: Which obstacles are there ``[N, K]``.
        detection_counts: Which detections are there, such as those of a high score, ``[N, D]``.
        above: A pair counts with an overlap above this.
    """
    overlaps = iou(obstacles, detections)
    if not overlaps.shape[2]:
        return np.zeros(overlaps.shape[:2], dtype=np.bool_)
    overlaps *= obstacle_counts[..., None] & detection_counts[:, None, :]
    best, partner = overlaps.max(axis=2), overlaps.argmax(axis=2)
    hits = best > above
    wanted = np.where(best > 0.0, partner, -1 - np.arange(partner.shape[1]))
    ordered = np.sort(wanted, axis=1)
    for row in np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1)):
        here, kept = np.flatnonzero(obstacle_counts[row]), detection_counts[row]
        boxes = [tuple(box) for box in obstacles[row, here]]
        others = [tuple(box) for box in detections[row, kept]]
        assigned, _ = assign_boxes(boxes, others)
        hits[row, here] = assigned > above
    return hits


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
