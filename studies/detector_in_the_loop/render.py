# ruff: noqa: PLR0917  compiled loops take their arguments by place
"""From scenes and frames to images: what the camera gives, in one compiled loop.

An image depends on its own scene and frame alone, whatever else is rendered with it.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.detector_in_the_loop.bodies import OUTLINES, REARS, SIZES_M
from studies.detector_in_the_loop.camera import HEIGHT_PX, NEAREST_M, WIDTH_PX
from studies.detector_in_the_loop.cars import draw_rear, draw_shadow, draw_side, rear_colours
from studies.detector_in_the_loop.frames import OUT_OF_VIEW, Frames
from studies.detector_in_the_loop.ground import draw_road, draw_roadside, draw_sky
from studies.detector_in_the_loop.lens import (
    NORMALS,
    TONES,
    add_blur,
    add_drops,
    add_wiper,
    expose,
)
from studies.detector_in_the_loop.light import add_glare, kernel
from studies.detector_in_the_loop.scene import Scenes

Images = NDArray[np.uint8]
FARTHEST_M = 250.0


@kernel
def _draw_car(
    image: Any, scene: Any, car: Any, pose: Any, rears: Any, outlines: Any, sizes_m: Any
) -> None:
    body, size_m = int(car[0]), sizes_m[int(car[0])]
    x_m, near_m, heading_rad = pose[0], pose[1], pose[2]
    if near_m + size_m[2] <= NEAREST_M or near_m > FARTHEST_M:
        return
    draw_shadow(image, scene, x_m, near_m, heading_rad, size_m)
    draw_side(image, scene, x_m, near_m, heading_rad, size_m, outlines[body], car[1:4])
    if near_m > NEAREST_M:
        colours = np.empty((7, 3))
        rear_colours(scene, x_m, near_m, car[1:4], pose[4], pose[3], colours)
        draw_rear(image, rears[body], colours, x_m, near_m, size_m)


@kernel
def _render(
    scenes: Any,
    cars: Any,
    seeds: Any,
    frames: Any,
    poses: Any,
    noise_seeds: Any,
    drop_seeds: Any,
    rears: Any,
    outlines: Any,
    sizes_m: Any,
    normals: Any,
    tones: Any,
    out: Any,
) -> None:
    image = np.empty(out.shape[1:], dtype=np.float32)
    for row in range(len(out)):
        scene, frame = scenes[row], frames[row]
        draw_sky(image, scene, seeds[row])
        draw_road(image, scene, seeds[row], frame[4])
        draw_roadside(image, scene, seeds[row], frame[4])
        for car in np.argsort(-poses[row, :, 1]):
            _draw_car(image, scene, cars[row, car], poses[row, car], rears, outlines, sizes_m)
        add_glare(image, scene)
        if frame[3] > 0.0:
            add_drops(image, drop_seeds[row], frame[3])
        if frame[2] < OUT_OF_VIEW:
            add_wiper(image, scene, frame[2])
        add_blur(image, frame[1])
        expose(image, scene, frame[0], noise_seeds[row], normals, tones, out[row])


def render(scenes: Scenes, frames: Frames) -> Images:
    """Images ``[N, 64, 160, 3]`` of N scenes, each in its frame: red, green, blue, 0 to 255."""
    out = np.empty((scenes.count, HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
    _render(
        np.ascontiguousarray(scenes.values),
        np.ascontiguousarray(scenes.cars),
        scenes.seeds,
        np.ascontiguousarray(frames.values),
        np.ascontiguousarray(frames.poses),
        frames.noise_seeds,
        frames.drop_seeds,
        REARS,
        OUTLINES,
        SIZES_M,
        NORMALS,
        TONES,
        out,
    )
    return out
