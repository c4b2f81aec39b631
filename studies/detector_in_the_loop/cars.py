# ruff: noqa: PLR0917, PLR0912  compiled loops take their arguments by place
"""A car in the image: its shadow, the side that is turned to the camera, and its rear.

The rear is a grid of materials across the road, of which each pixel gets exact areas. The side is a
plane along the road (or turned by the heading): to each column of the image belongs one depth, and
with it how high belt, windows, roof and wheels are there.
"""

import math
from typing import Any

import numpy as np

from studies.detector_in_the_loop.bodies import (
    DARK,
    GLASS,
    GRID,
    LAMP,
    NOTHING,
    PAINT,
    PLATE,
    TYRE,
)
from studies.detector_in_the_loop.camera import (
    CAMERA_HEIGHT_M,
    CENTRE_X_PX,
    FOCAL_PX,
    HORIZON_PX,
    NEAREST_M,
)
from studies.detector_in_the_loop.ground import overlap
from studies.detector_in_the_loop.light import headlight, kernel, rear_light, seen
from studies.detector_in_the_loop.scene import AT

_ILLUMINANCE, _SKY = AT["illuminance"], AT["sky_r"]
MATERIALS = 7
RETROREFLECTING = 4.0
"""How much more of a headlight's light number plates send back than white paint."""
TAIL, BRAKE = 0.04, 0.40
"""Luminance of rear lamps and of brake lamps."""


@kernel
def draw_shadow(
    image: Any, scene: Any, x_m: float, near_m: float, heading_rad: float, size_m: Any
) -> None:
    """What is under a car is dark."""
    height, width, _ = image.shape
    half_m, deep = 0.5 * size_m[1] + 0.15, 0.75
    for v in range(int(HORIZON_PX), height):
        z_m = FOCAL_PX * CAMERA_HEIGHT_M / (v + 0.5 - HORIZON_PX)
        low_m = FOCAL_PX * CAMERA_HEIGHT_M / (v + 1.0 - HORIZON_PX)
        high_m = FOCAL_PX * CAMERA_HEIGHT_M / max(v - HORIZON_PX, 0.1)
        along = overlap(low_m, high_m, near_m - 0.1, near_m + size_m[2]) / (high_m - low_m)
        if along <= 0.0:
            continue
        pixel_m = z_m / FOCAL_PX
        middle_m = x_m - math.tan(heading_rad) * (z_m - near_m)
        left = math.floor(CENTRE_X_PX + (middle_m - half_m) / pixel_m)
        right = math.ceil(CENTRE_X_PX + (middle_m + half_m) / pixel_m)
        for u in range(max(0, left), min(width, right)):
            there_m = (u + 0.5 - CENTRE_X_PX) * pixel_m - middle_m
            across = (
                overlap(there_m - 0.5 * pixel_m, there_m + 0.5 * pixel_m, -half_m, half_m) / pixel_m
            )
            for c in range(3):
                dark = seen(scene, 0.02 * scene[_ILLUMINANCE], z_m, c)
                image[v, u, c] += deep * along * across * (dark - image[v, u, c])


@kernel
def side_stripes(outline: Any, share: float, stripes: Any) -> None:
    """How high sill, belt, and the window's and the roof's top are, as shares of the height.

    ``stripes`` gets them for a place at a ``share`` of the length from the rear on, and in the
    last place 1 where a wheel is.
    """
    belt, first, last, back, front = outline
    bonnet = belt * (1.0 - 0.08 * max(0.0, share - last - front))
    if share < first - back or share > last + front:
        roof = bonnet
    elif share < first:
        roof = belt + (1.0 - belt) * (share - first + back) / back
    elif share > last:
        roof = belt + (1.0 - belt) * (last + front - share) / front
    else:
        roof = 1.0
    stripes[0], stripes[1] = 0.14, min(belt, bonnet)
    stripes[2], stripes[3] = max(stripes[1], roof - 0.06), roof
    stripes[4] = 1.0 if abs(share - 0.19) < 0.075 or abs(share - 0.80) < 0.075 else 0.0


@kernel
def draw_side(
    image: Any,
    scene: Any,
    x_m: float,
    near_m: float,
    heading_rad: float,
    size_m: Any,
    outline: Any,
    paint: Any,
) -> None:
    """The side that faces the camera's line of sight, if any does."""
    height, width, _ = image.shape
    turn = math.tan(heading_rad)
    if x_m - 0.5 * size_m[1] > 0.0:
        side_m = x_m - 0.5 * size_m[1]
    elif x_m + 0.5 * size_m[1] < 0.0:
        side_m = x_m + 0.5 * size_m[1]
    else:
        return
    first_m, last_m = max(near_m, NEAREST_M), near_m + size_m[2]
    ends = (
        CENTRE_X_PX + FOCAL_PX * (side_m - turn * (first_m - near_m)) / first_m,
        CENTRE_X_PX + FOCAL_PX * (side_m - turn * (last_m - near_m)) / last_m,
    )
    left, right = min(ends[0], ends[1]), max(ends[0], ends[1])
    stripes = np.empty(5)
    light = rear_light(scene, max(near_m, 2.0), x_m)
    for u in range(max(0, math.floor(left)), min(width, math.ceil(right))):
        across = overlap(u, u + 1.0, left, right)
        slope = (u + 0.5 - CENTRE_X_PX) / FOCAL_PX
        z_m = (side_m + turn * near_m) / (slope + turn)
        z_m = min(max(z_m, first_m), last_m)
        side_stripes(outline, (z_m - near_m) / size_m[2], stripes)
        scale = FOCAL_PX / z_m
        bottom = HORIZON_PX + CAMERA_HEIGHT_M * scale
        tall = size_m[0] * scale
        for stripe in range(4):
            low = 0.0 if stripe == 0 else stripes[stripe - 1]
            if stripe == 0 and stripes[4] == 0.0:
                continue
            top_px, bottom_px = bottom - stripes[stripe] * tall, bottom - low * tall
            if stripe == 0:
                top_px = bottom - 0.36 * tall
            first, last = max(0, math.floor(top_px)), min(height, math.ceil(bottom_px))
            for v in range(first, last):
                share = across * overlap(v, v + 1.0, top_px, bottom_px)
                for c in range(3):
                    bright = paint[c] * 0.85 * light
                    if stripe == 0:
                        bright = 0.02 * light
                    elif stripe == 2:
                        bright = 0.03 * light + 0.10 * scene[_ILLUMINANCE] * scene[_SKY + c]
                    image[v, u, c] += share * (seen(scene, bright, z_m, c) - image[v, u, c])
        if stripes[4] > 0.0:  # the wheel covers the lower body
            for v in range(
                max(0, math.floor(bottom - 0.36 * tall)),
                min(height, math.ceil(bottom)),
            ):
                share = across * overlap(v, v + 1.0, bottom - 0.36 * tall, bottom)
                for c in range(3):
                    dark = seen(scene, 0.02 * light, z_m, c)
                    image[v, u, c] += share * (dark - image[v, u, c])


@kernel
def rear_colours(
    scene: Any, x_m: float, z_m: float, paint: Any, lamp: float, brakes: float, colours: Any
) -> None:
    """What the materials of a rear look like from the camera, into ``colours [7, 3]``."""
    light, beam = rear_light(scene, z_m, x_m), headlight(scene, z_m, x_m)
    for c in range(3):
        red = 1.0 if c == 0 else 0.06
        glow = (TAIL * lamp + BRAKE * brakes) * red
        sky = scene[_ILLUMINANCE] * scene[_SKY + c]
        colours[PAINT, c] = paint[c] * light
        colours[GLASS, c] = 0.025 * light + 0.06 * sky
        colours[LAMP, c] = 0.35 * red * (light + RETROREFLECTING * beam) + glow
        colours[DARK, c] = 0.035 * light
        colours[PLATE, c] = 0.6 * (light + RETROREFLECTING * beam)
        colours[TYRE, c] = 0.02 * light
        for material in range(1, MATERIALS):
            colours[material, c] = seen(scene, colours[material, c], z_m, c)
        colours[NOTHING, c] = 0.0


@kernel
def draw_rear(image: Any, cells: Any, colours: Any, x_m: float, z_m: float, size_m: Any) -> None:
    """A rear of materials ``cells [GRID, GRID]`` that look like ``colours [7, 3]``."""
    height, width, _ = image.shape
    scale = FOCAL_PX / z_m
    wide, tall = size_m[1] * scale, size_m[0] * scale
    left = CENTRE_X_PX + x_m * scale - 0.5 * wide
    top = HORIZON_PX + CAMERA_HEIGHT_M * scale - tall
    sums = np.empty(3)
    for v in range(max(0, math.floor(top)), min(height, math.ceil(top + tall))):
        low = max(0.0, (v - top) / tall * GRID)
        high = min(float(GRID), (v + 1.0 - top) / tall * GRID)
        for u in range(max(0, math.floor(left)), min(width, math.ceil(left + wide))):
            first = max(0.0, (u - left) / wide * GRID)
            last = min(float(GRID), (u + 1.0 - left) / wide * GRID)
            sums[:] = 0.0
            covered = 0.0
            for row in range(int(low), min(GRID, math.ceil(high))):
                down = overlap(row, row + 1.0, low, high)
                for column in range(int(first), min(GRID, math.ceil(last))):
                    material = cells[row, column]
                    if material != NOTHING:
                        area = down * overlap(column, column + 1.0, first, last)
                        covered += area
                        for c in range(3):
                            sums[c] += area * colours[material, c]
            cell_px = (wide / GRID) * (tall / GRID)
            for c in range(3):
                rest = (1.0 - covered * cell_px) * image[v, u, c]
                image[v, u, c] = rest + sums[c] * cell_px
