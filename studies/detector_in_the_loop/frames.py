"""What changes from one frame of a scene to the next, and where cars are in it.

All of it is a hash of the scene's two seeds and the step (:mod:`.hashing`): vibration (length of
the vertical blur, exponential), flicker of exposure (normal, 3 %), lamps that beat with the frame
rate, where the wiper is, how many drops have gathered since it passed, the seed of the noise. The
wiper's blade sweeps up and down in 0.7 s of its period, as a real one does; drops lie where they
are until it has passed.
"""

from dataclasses import dataclass

import numpy as np

from pemviz.arrays import Batch, FloatArray
from studies.detector_in_the_loop.hashing import Seeds, hashed, normals, uniforms
from studies.detector_in_the_loop.scene import CAR_COLUMNS, Scenes

FRAME_COLUMNS = ("gain", "blur_px", "wiper_rad", "drops", "travelled_m")
"""Names of a frame's numbers; ``wiper_rad`` is from the vertical, 9 where no blade is in view."""
POSE_COLUMNS = ("x_m", "near_m", "heading_rad", "brakes", "lamp")
"""Of each car: ``near_m`` is its rear, ahead of the camera; ``lamp`` how bright its lamps are."""
SWEEP_S = 0.35
WIDEST_RAD = 1.1
OUT_OF_VIEW = 9.0
BLUR, GAIN, NOISE, DROPS, LAMP = range(5)
"""Purposes of random numbers."""


@dataclass(frozen=True)
class Frames(Batch):
    """N frames.

    Attributes:
        values: By :data:`FRAME_COLUMNS`, ``[N, F]``.
        poses: By :data:`POSE_COLUMNS`, ``[N, K + 1, P]``.
        noise_seeds: ``[N]``.
        drop_seeds: The same until the wiper passes, ``[N]``.
    """

    values: FloatArray
    poses: FloatArray
    noise_seeds: Seeds
    drop_seeds: Seeds


def frames_at(
    scenes: Scenes,
    *,
    step: FloatArray,
    dt_s: float,
    poses: FloatArray,
    travelled_m: FloatArray,
) -> Frames:
    """The frames of N scenes at one step each.

    Args:
        scenes: N scenes.
        step: Frames since the start ``[N]``.
        dt_s: Time between two frames [s].
        poses: x, near, heading and whether it brakes, of K + 1 cars ``[N, K + 1, 4]``.
        travelled_m: How far the ego has come since the start ``[N]``.
    """
    seeds, time_s = scenes.seeds, step * dt_s
    values = np.empty((scenes.count, len(FRAME_COLUMNS)))
    values[:, 0] = 1.0 + 0.03 * normals(scenes.frame_seeds, step, GAIN)
    values[:, 1] = -scenes.column("vibration_px") * np.log(uniforms(scenes.frame_seeds, step, BLUR))
    period_s, drops = scenes.column("wiper_period_s"), scenes.column("drops")
    wipes = period_s > 0.0
    turns = time_s / np.where(wipes, period_s, 1.0) + scenes.column("wiper_phase")
    since_s = (turns % 1.0) * period_s
    sweep = since_s / SWEEP_S
    up = sweep < 1.0
    angle = WIDEST_RAD * np.where(up, 2.0 * sweep - 1.0, 3.0 - 2.0 * sweep)
    values[:, 2] = np.where(wipes & (sweep < 2.0), angle, OUT_OF_VIEW)
    values[:, 3] = drops * np.where(wipes, since_s / np.where(wipes, period_s, 1.0), 0.0)
    values[:, 4] = travelled_m
    lamps, hertz = (scenes.cars[..., CAR_COLUMNS.index(name)] for name in ("lamps", "flicker_hz"))
    places = np.arange(lamps.shape[1])
    phase = np.stack([uniforms(seeds, 0.0, LAMP + int(place)) for place in places], axis=-1)
    beat = np.cos(2.0 * np.pi * (hertz * time_s[:, None] + phase)) > 0.0
    lit = lamps * np.where((hertz > 0.0) & ~beat, 0.0, 1.0)
    return Frames(
        values=values,
        poses=np.concatenate([poses, lit[..., None]], axis=-1),
        noise_seeds=hashed(scenes.frame_seeds, step, NOISE),
        drop_seeds=hashed(seeds, np.floor(turns), DROPS),
    )
