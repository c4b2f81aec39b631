"""How bright things are: the light on them, the air between, the glare, in one compiled loop.

Luminances are linear and relative: white paper under an overcast noon is 1. Air adds Koschmieder's
airlight: of a luminance L at distance z the camera gets t L + (1 - t) A with t = exp(-extinction z)
and A that of the air.
"""

import math
from typing import Any

from numba import njit

from studies.detector_in_the_loop.camera import FOCAL_PX, HORIZON_PX
from studies.detector_in_the_loop.scene import AT

kernel = njit(cache=True, nogil=True, fastmath=False)

_ILLUMINANCE, _EXTINCTION = AT["illuminance"], AT["extinction_per_m"]
_HEADLIGHTS, _SKY, _BACKLIGHT = AT["headlights"], AT["sky_r"], AT["backlight"]
_SUN_U, _SUN_V, _GLARE = AT["sun_u_px"], AT["sun_v_px"], AT["glare"]
BEAM = 2.0
"""Illuminance of low beams times the squared distance: 20 lux at 25 m against 10,000 of a day."""


@kernel
def headlight(scene: Any, z_m: float, x_m: float) -> float:
    """Illuminance from the ego's own headlights."""
    if scene[_HEADLIGHTS] == 0.0:
        return 0.0
    wide_m = 1.6 + 0.16 * z_m
    return BEAM / (z_m * z_m + 20.0) * math.exp(-(x_m * x_m) / (wide_m * wide_m))


@kernel
def clear(scene: Any, z_m: float) -> float:
    """Share of light that comes through the air."""
    return math.exp(-scene[_EXTINCTION] * z_m)


@kernel
def airlight(scene: Any, channel: int) -> float:
    """Luminance of the air, with what headlights scatter back."""
    scattered = 0.02 * scene[_EXTINCTION] * scene[_HEADLIGHTS]
    return 0.85 * scene[_ILLUMINANCE] * scene[_SKY + channel] + scattered


@kernel
def seen(scene: Any, luminance: float, z_m: float, channel: int) -> float:
    """A luminance as it arrives at the camera."""
    through = clear(scene, z_m)
    return through * luminance + (1.0 - through) * airlight(scene, channel)


@kernel
def rear_light(scene: Any, z_m: float, x_m: float) -> float:
    """Illuminance of a face that is turned to the camera."""
    return scene[_ILLUMINANCE] * scene[_BACKLIGHT] + headlight(scene, z_m, x_m)


@kernel
def add_glare(image: Any, scene: Any) -> None:
    """The sun, if it is ahead: a disk, a halo, and a veil over all of the image."""
    strength = scene[_GLARE] * scene[_ILLUMINANCE]
    if strength <= 0.0:
        return
    height, width, _ = image.shape
    for v in range(height):
        below = v + 0.5 - scene[_SUN_V]
        for u in range(width):
            aside = u + 0.5 - scene[_SUN_U]
            r_px = math.sqrt(aside * aside + below * below)
            light = strength * (0.35 + 2.2 * math.exp(-r_px / 32.0))
            if r_px < 8.0:
                light += 12.0 * strength * (1.0 - r_px / 8.0)
            # wet or worn asphalt reflects a low sun
            if v > HORIZON_PX:
                streak = aside / (0.05 * FOCAL_PX + 0.6 * (v - HORIZON_PX))
                light += 0.9 * strength * math.exp(-streak * streak)
            image[v, u, 0] += light
            image[v, u, 1] += 0.93 * light
            image[v, u, 2] += 0.78 * light
