"""What the camera sees of the cars of one encounter; written from the specification alone."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from pemviz.config import EncounterConfig

NEAREST_M = 0.5
FULLY_OCCLUDED, PARTLY, LARGELY = 0.9, 0.1, 0.5


class Sight(NamedTuple):
    """What the camera sees of a car.

    Attributes:
        truncated: Share beyond the image's sides.
        occluded: Share of the rest that other cars cover.
        present: Whether it can be detected.
        salient: Its salient variables, in KITTI's order.
    """

    truncated: float
    occluded: float
    present: bool
    salient: tuple[float, ...]


class _Outline(NamedTuple):
    near_m: float
    centre_m: float
    left: float
    right: float


def sights(
    config: EncounterConfig, offsets: Sequence[tuple[float, float]], headings: Sequence[float]
) -> list[Sight]:
    """Of each car, given gaps and offsets to the left [m] and headings [rad]."""
    outlines = [_outline(config, gap_m, aside_m) for gap_m, aside_m in offsets]
    return [
        _sight(config, number, outlines, offsets[number][1], heading)
        for number, heading in enumerate(headings)
    ]


def measured_place(
    config: EncounterConfig, gap_m: float, aside_m: float, along_m: float, across_m: float
) -> tuple[float, float]:
    """Gap and offset to the left [m] of a car whose centre is measured off.

    Args:
        config: The encounter.
        gap_m: Its gap [m].
        aside_m: Its offset to the left [m].
        along_m: Error along the line of sight from the camera, away from it [m].
        across_m: Error across it, to the right [m].
    """
    ahead_m = gap_m + config.camera_to_bumper_m + config.car_length_m / 2
    bearing_rad = math.atan2(-aside_m, ahead_m)
    farther_m = along_m * math.cos(bearing_rad) - across_m * math.sin(bearing_rad)
    to_the_right_m = along_m * math.sin(bearing_rad) + across_m * math.cos(bearing_rad)
    return gap_m + farther_m, aside_m - to_the_right_m


def _outline(config: EncounterConfig, gap_m: float, aside_m: float) -> _Outline:
    near_m = gap_m + config.camera_to_bumper_m
    corners = [
        (side * config.car_width_m / 2 - aside_m) / max(end_m, NEAREST_M)
        for side in (-1.0, 1.0)
        for end_m in (near_m, near_m + config.car_length_m)
    ]
    return _Outline(near_m, near_m + config.car_length_m / 2, min(corners), max(corners))


def _sight(
    config: EncounterConfig,
    number: int,
    outlines: Sequence[_Outline],
    aside_m: float,
    heading_rad: float,
) -> Sight:
    own = outlines[number]
    edge = math.tan(math.radians(config.camera_half_angle_deg))
    left, right = max(own.left, -edge), min(own.right, edge)
    shown = max(right - left, 0.0)
    truncated = 1.0 - shown / (own.right - own.left)
    covering = [
        (max(other.left, left), min(other.right, right))
        for place, other in enumerate(outlines)
        if (other.near_m, place) < (own.near_m, number) and other.centre_m > NEAREST_M
    ]
    occluded = _covered(covering) / shown if shown > 0.0 else 0.0
    present = (
        NEAREST_M < own.centre_m <= config.farthest_m
        and truncated < 1.0
        and occluded < FULLY_OCCLUDED
    )
    level = float(occluded >= PARTLY) + float(occluded >= LARGELY)
    rotation_rad = -math.pi / 2 - heading_rad
    salient = (
        *(0.0, truncated, level, rotation_rad - math.atan2(-aside_m, own.centre_m)),
        *(config.car_height_m, config.car_width_m, config.car_length_m),
        *(-aside_m, config.camera_height_m, own.centre_m, rotation_rad),
    )
    return Sight(truncated, occluded, present, salient)


def _covered(pieces: Sequence[tuple[float, float]]) -> float:
    """Length of the union of intervals."""
    covered, reached = 0.0, -math.inf
    for left, right in sorted(pieces):
        begin = max(left, reached)
        if right > begin:
            covered, reached = covered + right - begin, right
    return covered
