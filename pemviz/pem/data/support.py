"""How many training obstacles lie near what a scenario visits, and what they alone would allow.

Training obstacles are counted in cells of class, occlusion, lateral offset, heading and distance.
The counts ship with the model, the data does not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pemviz.arrays import FloatArray, IntArray
from pemviz.errors import PemError
from pemviz.pem.data.table import SalientTable
from pemviz.pem.models.card import PemCard
from pemviz.pem.models.protocol import CLASS_NAMES, COLUMN, OCCLUSION_NAMES, Pem, as_rows

DISTANCE_EDGES_M = (0.0, 3.0, 5.0, 7.0, 13.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 80.0)
"""Between the distance bands; the first band lies behind the camera, the last beyond 80 m."""

LATERAL_EDGES_M = (1.5, 4.5, 10.0)
"""Between the bands of |x|."""

HEADING_TOLERANCE_RAD = 0.3
MOST_OBSTACLES = 10**12
"""Training obstacles in a cell; sums of them stay whole numbers."""
HEADING_NAMES = ("heading away", "oncoming", "across")
LATERAL_NAMES = ("straight ahead", "beside", "off the road", "far aside")

SHAPE = (
    len(CLASS_NAMES),
    len(OCCLUSION_NAMES),
    len(LATERAL_EDGES_M) + 1,
    len(HEADING_NAMES),
    len(DISTANCE_EDGES_M) + 1,
)
"""Cells: class, occlusion, lateral band, heading, distance band."""


@dataclass(frozen=True, eq=False)
class SupportSummary:
    """Counts of training obstacles and of the missed ones among them."""

    obstacles: IntArray
    """Shape SHAPE."""
    missed: IntArray
    """Shape SHAPE."""

    def to_json(self) -> dict[str, Any]:
        """The cells that are not empty, as plain numbers."""
        filled = np.argwhere(self.obstacles)
        counts = np.stack([self.obstacles[tuple(filled.T)], self.missed[tuple(filled.T)]], axis=1)
        return {
            "distance_edges_m": list(DISTANCE_EDGES_M),
            "lateral_edges_m": list(LATERAL_EDGES_M),
            "heading_tolerance_rad": HEADING_TOLERANCE_RAD,
            "cells": np.concatenate([filled, counts], axis=1).tolist(),
        }


def summarise_support(table: SalientTable) -> SupportSummary:
    """Count a training table's obstacles and misses by cell."""
    cells = cell_of(table.salient)
    obstacles = np.zeros(SHAPE, dtype=np.int64)
    missed = np.zeros(SHAPE, dtype=np.int64)
    np.add.at(obstacles, cells, 1)
    np.add.at(missed, cells, ~table.detected)
    return SupportSummary(obstacles, missed)


def support_from_json(values: Mapping[str, Any], *, where: str) -> SupportSummary | None:
    """Read back what to_json wrote; None from an empty mapping: the model carries no counts.

    Raises:
        PemError: the counts are malformed or were made with other bands.
    """
    if not values:
        return None
    edges = (values.get("distance_edges_m"), values.get("lateral_edges_m"))
    if edges != (list(DISTANCE_EDGES_M), list(LATERAL_EDGES_M)):
        raise PemError(f"{where}: its support counts use other bands than this version of pemviz")
    try:
        cells = np.asarray(values["cells"])
        if cells.size and cells.dtype != np.int64:
            raise PemError(f"{where}: its support counts must be whole numbers")
        cells = cells.astype(np.int64).reshape(-1, len(SHAPE) + 2)
        index = tuple(cells[:, : len(SHAPE)].T)
        summary = SupportSummary(np.zeros(SHAPE, dtype=np.int64), np.zeros(SHAPE, dtype=np.int64))
        summary.obstacles[index] = cells[:, -2]
        summary.missed[index] = cells[:, -1]
    except (KeyError, ValueError, IndexError, TypeError, OverflowError) as error:
        raise PemError(f"{where}: its support counts are malformed ({error})") from None
    if (cells < 0).any() or (cells > MOST_OBSTACLES).any():
        raise PemError(f"{where}: its support counts must lie between 0 and {MOST_OBSTACLES}")
    if (summary.missed > summary.obstacles).any():
        raise PemError(f"{where}: its support counts are contradictory")
    return summary


def support_of(pem: Pem) -> SupportSummary | None:
    """The counts of training obstacles that a model carries, if it does.

    Raises:
        PemError: the counts are malformed.
    """
    card: object = getattr(pem, "card", None)
    if not isinstance(card, PemCard):
        return None
    return support_from_json(card.support, where=pem.name)


def cell_of(salient: FloatArray) -> tuple[IntArray, ...]:
    """Index arrays [n] into SHAPE of salient variables [..., 11]."""
    rows, _ = as_rows(salient)
    rotation = rows[:, COLUMN["rotation_y_rad"]]
    heading = np.select([_near(rotation, -np.pi / 2), _near(rotation, np.pi / 2)], [0, 1], 2)
    return (
        rows[:, COLUMN["class_id"]].astype(np.int64),
        rows[:, COLUMN["occlusion"]].astype(np.int64),
        np.searchsorted(LATERAL_EDGES_M, np.abs(rows[:, COLUMN["x_m"]]), side="right"),
        heading,
        np.searchsorted(DISTANCE_EDGES_M, rows[:, COLUMN["z_m"]], side="right"),
    )


def _near(angle_rad: FloatArray, target_rad: float) -> Any:
    difference = np.angle(np.exp(1j * (angle_rad - target_rad)))
    return np.abs(difference) < HEADING_TOLERANCE_RAD


def cell_in_words(class_id: int, occlusion: int, lateral: int, heading: int) -> str:
    """For example: Car, occlusion none, straight ahead (|x| < 1.5 m), heading away."""
    edges = (0.0, *LATERAL_EDGES_M, np.inf)
    low, high = edges[lateral], edges[lateral + 1]
    offset = f"|x| < {high:g} m" if lateral == 0 else f"|x| from {low:g} to {high:g} m"
    return (
        f"{CLASS_NAMES[class_id]}, occlusion {OCCLUSION_NAMES[occlusion]}, "
        f"{LATERAL_NAMES[lateral]} ({offset}), {HEADING_NAMES[heading]}"
    )


def band_in_words(band: int) -> str:
    """For example: z from 7 to 13 m."""
    edges = (-np.inf, *DISTANCE_EDGES_M, np.inf)
    low, high = edges[band], edges[band + 1]
    if band == 0:
        return f"z < {high:g} m"
    return f"z from {low:g} to {high:g} m" if np.isfinite(high) else f"z > {low:g} m"
