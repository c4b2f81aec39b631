# ruff: noqa: PLR0917  compiled loops take their arguments by place
"""What windscreen, lens and sensor do to an image: drops, wiper, blur, exposure, noise, 8 bits."""

import math
from typing import Any

import numpy as np
from scipy.special import ndtri

from studies.detector_in_the_loop.camera import CENTRE_X_PX
from studies.detector_in_the_loop.ground import random_of
from studies.detector_in_the_loop.light import kernel
from studies.detector_in_the_loop.scene import AT

_ILLUMINANCE, _EXPOSURE, _NOISE = AT["illuminance"], AT["exposure"], AT["noise"]
PIVOT_PX = 120.0
"""How far below the image's top the wiper turns."""
BLADE_PX = 5.0
METERED = 0.30
"""Mean that exposure aims at."""
LARGEST_GAIN = 60.0
SHOT, READ = 6e-5, 6e-4
"""Variance of shot noise for each luminance, and standard deviation of read noise, at gain 1."""

NORMALS = ndtri((np.arange(4096) + 0.5) / 4096.0).astype(np.float32)
"""Standard normals of equal probability."""
TONES = np.round(255.0 * np.sqrt(np.linspace(0.0, 1.0, 16384))).astype(np.uint8)
"""Bytes of luminances from 0 to 1: the square root of each."""


@kernel
def add_drops(image: Any, seed: Any, drops: float) -> None:
    """Drops on the windscreen, each a lens that shows its surroundings upside down."""
    height, width, _ = image.shape
    behind = image.copy()
    for drop in range(math.ceil(drops)):
        middle_u, middle_v = (
            width * random_of(seed, drop, 20),
            height * random_of(seed, drop, 21),
        )
        r_px = (2.0 + 5.0 * random_of(seed, drop, 22)) * min(1.0, drops - drop)
        for v in range(max(0, int(middle_v - r_px)), min(height, int(middle_v + r_px) + 1)):
            for u in range(max(0, int(middle_u - r_px)), min(width, int(middle_u + r_px) + 1)):
                aside, down = (u + 0.5 - middle_u) / r_px, (v + 0.5 - middle_v) / r_px
                inside = 1.0 - aside * aside - down * down
                if inside <= 0.0:
                    continue
                share = min(1.0, 1.6 * inside)
                other_u = min(max(int(middle_u - 14.0 * aside), 0), width - 1)
                other_v = min(max(int(middle_v - 14.0 * down), 0), height - 1)
                for c in range(3):
                    lens = behind[other_v, other_u, c]
                    image[v, u, c] += share * (lens - image[v, u, c])


@kernel
def add_wiper(image: Any, scene: Any, angle_rad: float) -> None:
    """The blade, out of focus."""
    height, width, _ = image.shape
    across, along = math.cos(angle_rad), math.sin(angle_rad)
    for v in range(height):
        for u in range(width):
            off = (u + 0.5 - CENTRE_X_PX) * across + (v + 0.5 - PIVOT_PX) * along
            share = 0.9 * (1.0 - abs(off) / BLADE_PX)
            if share > 0.0:
                for c in range(3):
                    image[v, u, c] += share * (0.02 * scene[_ILLUMINANCE] - image[v, u, c])


@kernel
def add_blur(image: Any, length_px: float) -> None:
    """Vertical motion while the shutter is open: a box of 1 + ``length_px``, at most 3 px."""
    rows = image.reshape(image.shape[0], -1)
    side = np.float32(min(length_px, 2.0) / (2.0 * (1.0 + min(length_px, 2.0))))
    if side < 0.02:
        return
    middle, last = np.float32(1.0) - 2 * side, len(rows) - 1
    before, here = rows[0].copy(), rows[0].copy()
    for v in range(len(rows)):
        row, below = rows[v], rows[min(v + 1, last)]
        for place in range(row.size):
            here[place] = row[place]
            row[place] = middle * row[place] + side * (before[place] + below[place])
        before, here = here, before


@kernel
def expose(
    image: Any, scene: Any, flicker: float, seed: Any, normals: Any, tones: Any, out: Any
) -> None:
    """Exposure by the frame's mean, noise, and 8 bits by a square root.

    One step of xorshift64* (Vigna 2016) gives five of the ``normals``; ``tones`` are the bytes of
    luminances from 0 to 1.
    """
    bright, found = image.reshape(-1), out.reshape(-1)
    mean = max(bright.mean(), 1e-9)
    gain = min(METERED / mean, LARGEST_GAIN) * scene[_EXPOSURE] * flicker
    state, bits = np.uint64(seed) | np.uint64(1), np.uint64(0)
    shot, read = np.float32(SHOT * gain), np.float32((READ * gain) ** 2)
    spread, scale = np.float32(scene[_NOISE]), np.float32(gain)
    for place in range(bright.size):
        if place % 5 == 0:
            state ^= state >> np.uint64(12)
            state ^= state << np.uint64(25)
            state ^= state >> np.uint64(27)
            bits = (state * np.uint64(0x2545F4914F6CDD1D)) >> np.uint64(4)
        value = scale * bright[place]
        noise = spread * normals[bits & np.uint64(NORMALS.size - 1)]
        bits >>= np.uint64(12)
        value += noise * np.sqrt(shot * value + read)
        found[place] = tones[int(np.float32(TONES.size - 1) * min(max(value, 0.0), 1.0))]
