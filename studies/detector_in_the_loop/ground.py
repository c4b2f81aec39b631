# ruff: noqa: PLR0917  compiled loops take their arguments by place
"""Sky, skyline, road and roadside, rasterised with exact areas where shapes are rectangles."""

import math
from typing import Any

import numpy as np

from studies.detector_in_the_loop.camera import (
    CAMERA_HEIGHT_M,
    CENTRE_X_PX,
    FOCAL_PX,
    HORIZON_PX,
)
from studies.detector_in_the_loop.light import airlight, clear, headlight, kernel, seen
from studies.detector_in_the_loop.scene import AT

_ILLUMINANCE, _SKY, _ROAD, _VERGE = AT["illuminance"], AT["sky_r"], AT["road"], AT["verge_r"]
_MARK, _TEXTURE, _SHADE, _ROADSIDE = AT["mark"], AT["texture"], AT["shade"], AT["roadside"]
_SKYLINE, _TONE = AT["skyline_px"], AT["skyline_tone"]
ROAD_HALF_M = 5.6
LINES_M = (-5.25, -1.75, 1.75, 5.25)
LINE_HALF_M = 0.08
DASH_M, DASH_PERIOD_M = 4.0, 12.0
SPACING_M = 14.0
"""Along the road, between what stands beside it."""
FARTHEST_M = 130.0
SKYLINE_M = 250.0


@kernel
def overlap(low: float, high: float, other_low: float, other_high: float) -> float:
    """Length that two intervals have in common."""
    return max(0.0, min(high, other_high) - max(low, other_low))


@kernel
def random_of(seed: Any, first: int, second: int) -> float:
    """A uniform that belongs to a seed and two numbers: SplitMix64's finaliser."""
    mixed = np.uint64(seed) ^ (np.uint64(first + 1048576) * np.uint64(0x9E3779B97F4A7C15))
    mixed = mixed + np.uint64(second + 1048576) * np.uint64(0xD1342543DE82EF95)
    mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    mixed = mixed ^ (mixed >> np.uint64(31))
    return float(mixed >> np.uint64(11)) * 2.0**-53


@kernel
def dashes(z_m: float) -> float:
    """How much of the road from 0 to ``z_m`` is marked by a broken line [m]."""
    periods = math.floor(z_m / DASH_PERIOD_M)
    return periods * DASH_M + min(z_m - periods * DASH_PERIOD_M, DASH_M)


@kernel
def draw_sky(image: Any, scene: Any, seed: Any) -> None:
    """Sky, and what stands far away before it."""
    width, top, far = image.shape[1], int(HORIZON_PX), np.empty(3)
    for c in range(3):
        far[c] = seen(scene, scene[_TONE] * scene[_ILLUMINANCE], SKYLINE_M, c)
    for u in range(width):
        turn = 2.0 * math.pi * u / width
        height_px = 0.55
        for wave in range(3):
            phase = 2.0 * math.pi * random_of(seed, wave, 1)
            height_px += 0.28 * math.sin((2 + 5 * wave) * turn + phase)
        height_px = max(0.0, height_px) * scene[_SKYLINE]
        for v in range(top):
            covered = overlap(v, v + 1.0, HORIZON_PX - height_px, HORIZON_PX)
            bright = scene[_ILLUMINANCE] * (0.8 + 0.2 * v / HORIZON_PX)
            for c in range(3):
                sky = bright * scene[_SKY + c]
                image[v, u, c] = covered * far[c] + (1.0 - covered) * sky


@kernel
def draw_road(image: Any, scene: Any, seed: Any, travelled_m: float) -> None:
    """Asphalt with its marks, texture and shadows across it, and the verges."""
    height, width, _ = image.shape
    air = np.array([airlight(scene, c) for c in range(3)])
    for v in range(int(HORIZON_PX), height):
        below = v + 0.5 - HORIZON_PX
        z_m = FOCAL_PX * CAMERA_HEIGHT_M / below
        through = clear(scene, z_m)
        near_m = FOCAL_PX * CAMERA_HEIGHT_M / (below + 0.5)
        far_m = FOCAL_PX * CAMERA_HEIGHT_M / max(below - 0.5, 0.1)
        deep_m, pixel_m = far_m - near_m, z_m / FOCAL_PX
        dashed = (dashes(far_m + travelled_m) - dashes(near_m + travelled_m)) / deep_m
        along_m = z_m + travelled_m
        fine = scene[_TEXTURE] * min(1.0, 1.2 / deep_m)
        row, patch = math.floor(along_m / 1.2), math.floor(along_m / 7.0)
        shaded = 0.0
        if random_of(seed, patch, 2) < 0.35:
            shaded = 0.75 * scene[_SHADE] * min(1.0, 7.0 / deep_m)
        edge_m = 14.0 * random_of(seed, patch, 3) - 7.0
        for u in range(width):
            x_m = (u + 0.5 - CENTRE_X_PX) * pixel_m
            left_m, right_m = x_m - 0.5 * pixel_m, x_m + 0.5 * pixel_m
            on_road = overlap(left_m, right_m, -ROAD_HALF_M, ROAD_HALF_M) / pixel_m
            marked = 0.0
            for line in range(4):
                middle = LINES_M[line]
                if abs(x_m - middle) < LINE_HALF_M + pixel_m:
                    own = overlap(left_m, right_m, middle - LINE_HALF_M, middle + LINE_HALF_M)
                    marked += own / pixel_m * (dashed if 0 < line < 3 else 1.0)
            column = math.floor(x_m / 0.45)
            rough = 1.0 + fine * (2.0 * random_of(seed, 4 + row * 64, column) - 1.0)
            light = scene[_ILLUMINANCE]
            if x_m < edge_m:
                light *= 1.0 - shaded
            light += headlight(scene, z_m, x_m)
            for c in range(3):
                asphalt = (1.0 - marked) * scene[_ROAD] * rough + marked * scene[_MARK]
                albedo = on_road * asphalt + (1.0 - on_road) * scene[_VERGE + c] * rough
                image[v, u, c] = through * albedo * light + (1.0 - through) * air[c]


@kernel
def draw_rectangle(
    image: Any, x_m: float, z_m: float, half_m: float, low_m: float, high_m: float, rgb: Any
) -> None:
    """An upright rectangle across the road, from ``low_m`` to ``high_m`` above it."""
    height, width, _ = image.shape
    scale = FOCAL_PX / z_m
    left, right = CENTRE_X_PX + (x_m - half_m) * scale, CENTRE_X_PX + (x_m + half_m) * scale
    top = HORIZON_PX + (CAMERA_HEIGHT_M - high_m) * scale
    bottom = HORIZON_PX + (CAMERA_HEIGHT_M - low_m) * scale
    for v in range(max(0, math.floor(top)), min(height, math.ceil(bottom))):
        down = overlap(v, v + 1.0, top, bottom)
        for u in range(max(0, math.floor(left)), min(width, math.ceil(right))):
            covered = down * overlap(u, u + 1.0, left, right)
            for c in range(3):
                image[v, u, c] += covered * (rgb[c] - image[v, u, c])


@kernel
def draw_roadside(image: Any, scene: Any, seed: Any, travelled_m: float) -> None:
    """Poles, trees, signs, bushes, boxes and houses beside the road, the farthest first."""
    rgb, last = np.empty(3), int((travelled_m + FARTHEST_M) / SPACING_M)
    for place in range(last, int(travelled_m / SPACING_M), -1):
        for side in range(2):
            if random_of(seed, place, 10 + side) > scene[_ROADSIDE]:
                continue
            kind = int(6.0 * random_of(seed, place, 12 + side))
            tone = 0.04 + 0.5 * random_of(seed, place, 14 + side) ** 2
            z_m = (place + 0.6 * random_of(seed, place, 16 + side)) * SPACING_M - travelled_m
            if z_m < 3.0:
                continue
            x_m = (2 * side - 1) * (7.0 + 5.0 * random_of(seed, place, 18 + side))
            light = scene[_ILLUMINANCE] * 0.8 + headlight(scene, z_m, x_m)
            green = 1.5 if kind in {1, 3} else 1.0
            for c in range(3):
                rgb[c] = seen(scene, tone * light * (green if c == 1 else 1.0), z_m, c)
            if kind == 0:  # pole
                draw_rectangle(image, x_m, z_m, 0.08, 0.0, 6.0, rgb)
            elif kind == 1:  # tree
                draw_rectangle(image, x_m, z_m, 0.15, 0.0, 2.2, rgb)
                draw_rectangle(image, x_m, z_m, 1.6, 1.8, 6.0, rgb)
            elif kind == 2:  # sign
                draw_rectangle(image, x_m, z_m, 0.05, 0.0, 2.2, rgb)
                draw_rectangle(image, x_m, z_m, 0.45, 2.0, 2.9, rgb)
            elif kind == 3:  # bush
                draw_rectangle(image, x_m, z_m, 1.1, 0.0, 1.2, rgb)
            elif kind == 4:  # box, as high as a car
                draw_rectangle(image, x_m, z_m, 0.8, 0.1, 1.4, rgb)
            else:  # house
                x_m += (2 * side - 1) * 5.0
                draw_rectangle(image, x_m, z_m, 4.5, 0.0, 5.5, rgb)
                for c in range(3):
                    rgb[c] *= 0.4
                draw_rectangle(image, x_m - 1.5, z_m, 0.7, 1.0, 2.3, rgb)
                draw_rectangle(image, x_m + 1.5, z_m, 0.7, 1.0, 2.3, rgb)
