"""What the ego's camera sees of the other cars: truncation, occlusion, presence.

Arrays have a row for each car, ``[K, ...]``.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig

NEAREST_M = 0.5
"""Ahead of the camera: what is nearer is taken for as near as that, or not seen at all."""
PARTLY, LARGELY, HIDDEN = 0.1, 0.5, 0.9
"""Occluded shares from which a car is partly occluded, largely occluded, and not to be seen."""
CAR_CLASS = 0.0
HEADING_AWAY_RAD = -np.pi / 2


@dataclass(frozen=True)
class Sight:
    """Cars in the camera's frame: x to the right, z ahead.

    Attributes:
        x_m: Centre, ``[K, ...]`` [m].
        z_m: Likewise.
        truncated: Share of its width in the image that lies beyond the image, ``[K, ...]``.
        occluded: Share of the rest that nearer cars cover, ``[K, ...]``.
        present: Whether there is anything of it to be seen, ``[K, ...]``.
    """

    x_m: FloatArray
    z_m: FloatArray
    truncated: FloatArray
    occluded: FloatArray
    present: BoolArray


def seen(config: EncounterConfig, gap_m: FloatArray, aside_m: FloatArray) -> Sight:
    """Other cars as the camera sees them.

    Args:
        config: The encounter.
        gap_m: Bumper to bumper, ``[K, ...]`` [m].
        aside_m: To the left, ``[K, ...]`` [m].
    """
    near_m = gap_m + config.camera_to_bumper_m
    z_m = near_m + config.car_length_m / 2
    left, right = _image(config, near_m, aside_m)
    edge = image_edge(config)
    low, high = np.maximum(left, -edge), np.minimum(right, edge)
    width = (high - low).clip(0.0)
    in_front = z_m > NEAREST_M
    covered = np.zeros_like(width)
    for car in range(len(gap_m)):
        covers = [
            (np.maximum(low[car], left[other]), np.minimum(high[car], right[other]), hides)
            for other in range(len(gap_m))
            if other != car
            for hides in [in_front[other] & _is_nearer(near_m, other, car)]
        ]
        covered[car] = _length_of_union(covers)
    in_image = width > 0.0
    occluded = np.where(in_image, covered / np.where(in_image, width, 1.0), 0.0)
    return Sight(
        x_m=-aside_m,
        z_m=z_m,
        truncated=1.0 - width / (right - left),
        occluded=occluded,
        present=in_front & (z_m <= config.farthest_m) & in_image & (occluded < HIDDEN),
    )


def image_edge(config: EncounterConfig) -> float:
    """How far the image reaches to either side, x / z."""
    return float(np.tan(np.deg2rad(config.camera_half_angle_deg)))


def salient(config: EncounterConfig, sight: Sight, heading_rad: FloatArray) -> FloatArray:
    """Cars as KITTI would label them, ``[K, ..., 11]``, ordered as ``pemviz.pem.SALIENT_COLUMNS``.

    Args:
        config: The encounter.
        sight: Of the cars.
        heading_rad: ``[K, ...]``, counterclockwise from the road.
    """
    rotation = HEADING_AWAY_RAD - heading_rad
    columns = (
        CAR_CLASS,
        sight.truncated,
        (sight.occluded >= PARTLY) * 1.0 + (sight.occluded >= LARGELY),
        rotation - np.arctan2(sight.x_m, sight.z_m),
        config.car_height_m,
        config.car_width_m,
        config.car_length_m,
        sight.x_m,
        config.camera_height_m,
        sight.z_m,
        rotation,
    )
    result = np.empty((*np.shape(heading_rad), len(columns)))
    for place, column in enumerate(columns):
        result[..., place] = column
    return result


def _image(
    config: EncounterConfig, near_m: FloatArray, aside_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where cars begin and end from left to right in the image, x / z, ``[K, ...]`` each."""
    near, far = near_m.clip(NEAREST_M), (near_m + config.car_length_m).clip(NEAREST_M)
    left_m, right_m = -aside_m - config.car_width_m / 2, -aside_m + config.car_width_m / 2
    left = np.minimum(left_m / near, left_m / far)
    return left, np.maximum(right_m / near, right_m / far)


def _is_nearer(near_m: FloatArray, other: int, car: int) -> BoolArray:
    if other < car:
        return near_m[other] <= near_m[car]
    return near_m[other] < near_m[car]


def _length_of_union(covers: list[tuple[FloatArray, FloatArray, BoolArray]]) -> FloatArray | float:
    """What at most two intervals ``(low, high, counts)`` cover together, ``[...]``."""
    lengths = [np.where(counts, (high - low).clip(0.0), 0.0) for low, high, counts in covers]
    if len(covers) < 2:
        return sum(lengths, 0.0)
    (low, high, counts), (other_low, other_high, others) = covers
    both = (np.minimum(high, other_high) - np.maximum(low, other_low)).clip(0.0)
    alike = counts & others & (lengths[0] > 0.0) & (lengths[1] > 0.0)
    return lengths[0] + lengths[1] - np.where(alike, both, 0.0)
