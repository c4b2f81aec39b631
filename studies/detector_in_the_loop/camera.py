"""The camera: where points of the road lie in the image, and the boxes that labels have.

A pinhole behind the windscreen, looking ahead along the road: x to the right, y down, z forward, a
point lies at u = cx + f x / z, v = cy + f y / z. Pixel (row i, column j) covers [i, i + 1) x
[j, j + 1). Its half angle is a whole number of degrees so that an encounter's ``camera_half_angle``
can say the same.
"""

import math

import numpy as np

from pemviz.arrays import FloatArray

WIDTH_PX = 160
HEIGHT_PX = 64
HALF_ANGLE_DEG = 32.0
FOCAL_PX = WIDTH_PX / 2 / math.tan(math.radians(HALF_ANGLE_DEG))
CENTRE_X_PX = WIDTH_PX / 2
HORIZON_PX = 24.0
CAMERA_HEIGHT_M = 1.65
NEAREST_M = 0.5
"""What is nearer to the camera's plane is taken to be here."""


def projected(points_m: FloatArray) -> FloatArray:
    """Points ``[..., 3]`` (x right, y down, z forward) in the image ``[..., 2]``."""
    z_m = points_m[..., 2].clip(NEAREST_M)
    u_px = CENTRE_X_PX + FOCAL_PX * points_m[..., 0] / z_m
    v_px = HORIZON_PX + FOCAL_PX * points_m[..., 1] / z_m
    return np.stack([u_px, v_px], axis=-1)


def corners(
    *, x_m: FloatArray, near_m: FloatArray, heading_rad: FloatArray, size_m: FloatArray
) -> FloatArray:
    """The eight corners ``[..., 8, 3]`` of cars that stand on the road [m].

    Args:
        x_m: Middle of the rear, to the right ``[...]``.
        near_m: The rear, ahead of the camera ``[...]``.
        heading_rad: Counterclockwise from straight ahead ``[...]``.
        size_m: Height, width, length ``[..., 3]``.
    """
    height, width, length = (size_m[..., axis] for axis in range(3))
    found = np.empty((*np.shape(x_m), 8, 3))
    for place in range(8):
        side, top, far = place & 1, (place >> 1) & 1, place >> 2
        along, across = far * length, (side - 0.5) * width
        found[..., place, 0] = x_m + across - along * np.tan(heading_rad)
        found[..., place, 1] = CAMERA_HEIGHT_M - top * height
        found[..., place, 2] = near_m + along
    return found


def boxes(
    *, x_m: FloatArray, near_m: FloatArray, heading_rad: FloatArray, size_m: FloatArray
) -> FloatArray:
    """Boxes around cars, cut at the image's sides: left, top, right, bottom ``[..., 4]`` [px]."""
    points = projected(corners(x_m=x_m, near_m=near_m, heading_rad=heading_rad, size_m=size_m))
    low, high = points.min(axis=-2), points.max(axis=-2)
    found = np.concatenate([low, high], axis=-1)
    sides = np.array([WIDTH_PX, HEIGHT_PX, WIDTH_PX, HEIGHT_PX], dtype=np.float64)
    return found.clip(0.0, sides)
