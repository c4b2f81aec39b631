"""What of a road views draw: its asphalt and what is painted on it, in the world's places."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.simulators.scene import Ramp, Road

DASH_M, DASH_SPACING_M = 3.0, 9.0
SAME_M = 1e-6
"""Edges nearer than that are one."""


@dataclass(frozen=True, eq=False)
class DrawnRoad:
    """A road from one place to another.

    Attributes:
        asphalt: Right and left edge of each strip of it, ``[2, N, 2]`` [m]; of the lanes first.
        solid: Lines ``[N, 2]`` [m].
        dashed: Both ends of every dash, ``[D, 2, 2]`` [m].
    """

    asphalt: tuple[FloatArray, ...]
    solid: tuple[FloatArray, ...]
    dashed: FloatArray


def drawn_road(road: Road, *, from_m: float, to_m: float) -> DrawnRoad:
    """The straight lanes from ``from_m`` to ``to_m``, and all of the ramps.

    Where a ramp is beside the lanes the line between both is dashed; where it ends there, a line
    closes it.
    """
    right_m, *between_m, left_m = road.lane_edges_m
    lanes = np.array([_straight(right_m, from_m, to_m), _straight(left_m, from_m, to_m)])
    dashed = [_dashes(y_m, from_m, to_m) for y_m in between_m]
    solid: list[FloatArray] = []
    asphalt = [lanes]
    for y_m in (right_m, left_m):
        free_m = from_m
        for start_m, end_m in sorted(
            stretch for ramp in road.ramps for stretch in _beside(ramp, y_m)
        ):
            solid.append(_straight(y_m, free_m, start_m))
            dashed.append(_dashes(y_m, start_m, end_m))
            free_m = end_m
        solid.append(_straight(y_m, free_m, to_m))
    for ramp in road.ramps:
        right, left = (np.stack([ramp.x_m, edge], axis=1) for edge in (ramp.right_m, ramp.left_m))
        edges = np.array([right, left])
        asphalt.append(edges)
        for edge in edges:
            solid.extend(_apart(edge, (right_m, left_m)))
        solid.extend(
            edges[:, end]
            for end in (0, -1)
            if np.isclose(edges[:, end, 1][:, None], (right_m, left_m), atol=SAME_M).any()
        )
    return DrawnRoad(tuple(asphalt), tuple(solid), np.concatenate([np.empty((0, 2, 2)), *dashed]))


def _straight(y_m: float, from_m: float, to_m: float) -> FloatArray:
    return np.array([(from_m, y_m), (to_m, y_m)])


def _dashes(y_m: float, from_m: float, to_m: float) -> FloatArray:
    """Dashes stand at the same places of a road, whatever part of it is drawn."""
    starts_m = DASH_SPACING_M * np.arange(
        np.ceil(from_m / DASH_SPACING_M), np.ceil((to_m - DASH_M) / DASH_SPACING_M)
    )
    ends = np.stack([starts_m, starts_m + DASH_M], axis=1)
    return np.stack([ends, np.full_like(ends, y_m)], axis=2)


def _beside(ramp: Ramp, y_m: float) -> Iterator[tuple[float, float]]:
    """From where to where an edge of a ramp is the road's."""
    for edge_m in (ramp.right_m, ramp.left_m):
        on = np.abs(np.array(edge_m) - y_m) < SAME_M
        for (start, end), (first, last) in zip(pairwise(ramp.x_m), pairwise(on), strict=True):
            if first and last:
                yield start, end


def _apart(edge: FloatArray, others_m: tuple[float, float]) -> Iterator[FloatArray]:
    """The parts of a ramp's edge ``[N, 2]`` that are not the road's."""
    on = np.logical_or(*(np.abs(edge[:, 1] - other_m) < SAME_M for other_m in others_m))
    kept = ~(on[:-1] & on[1:])
    turns = np.flatnonzero(np.diff(kept)) + 1
    for start, end in pairwise([0, *turns.tolist(), len(kept)]):
        if kept[start]:
            yield edge[start : end + 1]
