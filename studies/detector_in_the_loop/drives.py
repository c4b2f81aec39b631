"""Labelled drives: sequences as somebody who labels video would have them.

A sequence is six seconds at 10 Hz of a scene with up to three cars: one ahead in the lane, one to
the right, which in half of the sequences changes into the ego's lane, and traffic to the left. Gap
to the car ahead: log-uniform from 3 to 70 m at the start, closing speed normal(0, 3) m/s, its
acceleration normal(0, 1) m/s^2, held above 2 m. The car to the right: log-uniform from 4 to 50 m,
closing speed normal(1, 3) m/s, a lane change of 2.5 to 5 s that begins at -2 to 3 s, where it does
not come closer than 3 m to the car ahead. The ego's speed is uniform from 5 to 32 m/s.

Drives of the kind ``approaches`` come upon every other car ahead fast: 40 to 75 m away at the
start, closing at 8 to 20 m/s. Those of the kind ``braking`` do so too, and every car ahead brakes.

A car is labelled where it counts as visible by what ``pemviz.simulators.encounters`` says of sight:
its centre up to 80 m ahead, less than nine tenths of it hidden.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters.sight import seen
from studies.detector_in_the_loop.bodies import SIZES_M
from studies.detector_in_the_loop.camera import CAMERA_HEIGHT_M, HALF_ANGLE_DEG, boxes
from studies.detector_in_the_loop.frames import Frames, frames_at
from studies.detector_in_the_loop.scene import TRAFFIC, Domain, Scenes, draw_scenes

DriveKind = Literal["usual", "approaches", "braking"]
DT_S = 0.1
FRAMES = 60
"""Of a sequence."""
CARS = 2
LANE_M = 3.5
ABSENT_M = -1e3
SIGHT = EncounterConfig(
    camera_to_bumper_m=0.0, camera_half_angle_deg=HALF_ANGLE_DEG, camera_height_m=CAMERA_HEIGHT_M
)


@dataclass(frozen=True)
class Labels:
    """What is there in N frames, of K cars each.

    Attributes:
        visible: Whether a car is labelled ``[N, K]``.
        box_px: ``[N, K, 4]``.
        size_m: Height, width, length ``[N, K, 3]``.
        x_m: Its centre, to the right ``[N, K]``.
        z_m: Its centre, ahead ``[N, K]``.
        heading_rad: Counterclockwise from straight ahead ``[N, K]``.
        truncated: Share beyond the image ``[N, K]``.
        occluded: Share that nearer cars hide ``[N, K]``.
    """

    visible: BoolArray
    box_px: FloatArray
    size_m: FloatArray
    x_m: FloatArray
    z_m: FloatArray
    heading_rad: FloatArray
    truncated: FloatArray
    occluded: FloatArray


@dataclass(frozen=True)
class Drive:
    """S sequences of :data:`FRAMES` frames.

    Attributes:
        scenes: S scenes.
        poses: x, near, heading and whether it brakes ``[S, T, K + 1, 4]``.
        travelled_m: ``[S, T]``.
    """

    scenes: Scenes
    poses: FloatArray
    travelled_m: FloatArray

    @property
    def count(self) -> int:
        """Number of sequences S."""
        return self.scenes.count

    def at(self, sequence: IntArray, step: IntArray) -> tuple[Scenes, Frames]:
        """Scenes and frames of N sequences, at one step each."""
        scenes = self.scenes.take(sequence)
        found = frames_at(
            scenes,
            step=step.astype(np.float64),
            dt_s=DT_S,
            poses=self.poses[sequence, step],
            travelled_m=self.travelled_m[sequence, step],
        )
        return scenes, found

    def labels(self, sequence: IntArray, step: IntArray) -> Labels:
        """What is there in those frames."""
        return labels_of(self.scenes.take(sequence), self.poses[sequence, step])


def labels_of(scenes: Scenes, poses: FloatArray) -> Labels:
    """Labels of N scenes whose cars have ``poses [N, K, 4]``."""
    x_m, near_m, heading_rad = poses[..., 0], poses[..., 1], poses[..., 2]
    size_m = SIZES_M[scenes.cars[..., 0].astype(np.int64)]
    sight = seen(SIGHT, near_m.T, -x_m.T)
    box_px = boxes(x_m=x_m, near_m=near_m, heading_rad=heading_rad, size_m=size_m)
    wide = (box_px[..., 2] - box_px[..., 0] > 0.5) & (box_px[..., 3] - box_px[..., 1] > 0.5)
    half_m = 0.5 * size_m[..., 2]
    return Labels(
        visible=sight.present.T & wide,
        box_px=box_px,
        size_m=size_m,
        x_m=x_m - half_m * np.tan(heading_rad),
        z_m=near_m + half_m,
        heading_rad=heading_rad,
        truncated=sight.truncated.T,
        occluded=sight.occluded.T,
    )


def draw_drive(
    domain: Domain, *, count: int, seeds: np.random.SeedSequence, kind: DriveKind = "usual"
) -> Drive:
    """That many sequences of a kind in a domain."""
    scene_seeds, motion_seeds = seeds.spawn(2)
    scenes = draw_scenes(domain, count=count, cars=CARS, seeds=scene_seeds)
    random = np.random.default_rng(motion_seeds)
    time_s = np.arange(FRAMES, dtype=np.float64) * DT_S
    ego_mps = random.uniform(5.0, 32.0, count)[:, None]
    poses = np.zeros((count, FRAMES, CARS + TRAFFIC, 4))
    poses[:, :, 0] = _ahead(count, time_s, random, kind=kind)
    poses[:, :, 1] = _beside(count, time_s, random, ahead_m=poses[:, :, 0, 1])
    traffic_m = scenes.column("traffic_m")[:, None]
    poses[:, :, 2, 0] = -LANE_M
    poses[:, :, 2, 1] = traffic_m + scenes.column("traffic_mps")[:, None] * time_s
    poses[:, :, 2, 3] = (random.random(count) < 0.1)[:, None]
    return Drive(scenes=scenes, poses=poses, travelled_m=ego_mps * time_s)


def _ahead(
    count: int, time_s: FloatArray, random: np.random.Generator, *, kind: DriveKind
) -> FloatArray:
    """Poses of the car in the lane ``[S, T, 4]``."""
    gap_m = np.exp(random.uniform(np.log(3.0), np.log(70.0), count))[:, None]
    closing_mps = random.normal(0.0, 3.0, count)[:, None]
    closing_mps2 = random.normal(0.0, 1.0, count)[:, None]
    if kind != "usual":
        fast = np.arange(count)[:, None] % 2 == 0
        gap_m = np.where(fast, random.uniform(40.0, 75.0, (count, 1)), gap_m)
        closing_mps = np.where(fast, random.uniform(8.0, 20.0, (count, 1)), closing_mps)
        closing_mps2 = np.where(fast, 0.0, closing_mps2)
    near_m = gap_m - closing_mps * time_s - 0.5 * closing_mps2 * time_s**2
    near_m = 2.0 + np.logaddexp(0.0, near_m - 2.0)  # smoothly above 2 m
    poses = np.zeros((count, time_s.size, 4))
    poses[..., 0] = random.normal(0.0, 0.15, count)[:, None]
    there = (random.random(count) < 0.85)[:, None]
    poses[..., 1] = np.where(there, near_m, ABSENT_M)
    brakes = random.random(count) < np.where(closing_mps[:, 0] > 1.0, 0.7, 0.15)
    poses[..., 3] = kind == "braking" or brakes[:, None]
    return poses


def _beside(
    count: int, time_s: FloatArray, random: np.random.Generator, *, ahead_m: FloatArray
) -> FloatArray:
    """Poses of the car to the right, which may change lanes ``[S, T, 4]``."""
    gap_m = np.exp(random.uniform(np.log(4.0), np.log(50.0), count))[:, None]
    near_m = gap_m - random.normal(1.0, 3.0, count)[:, None] * time_s
    begin_s = random.uniform(-2.0, 3.0, count)[:, None]
    lasts_s = random.uniform(2.5, 5.0, count)[:, None]
    clear = (ahead_m < ABSENT_M / 2) | (near_m + 8.0 < ahead_m)
    changes = clear.all(axis=1) & (random.random(count) < 0.6) & (near_m > 2.0).all(axis=1)
    share = np.where(changes[:, None], ((time_s - begin_s) / lasts_s).clip(0.0, 1.0), 0.0)
    x_m = LANE_M * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2))
    poses = np.zeros((count, time_s.size, 4))
    poses[..., 0] = x_m
    there = (random.random(count) < 0.7)[:, None]
    poses[..., 1] = np.where(there, near_m, ABSENT_M)
    aside_mps = -np.gradient(x_m, DT_S, axis=1)  # to the left is counterclockwise
    poses[..., 2] = np.arctan(aside_mps / 20.0)
    return poses
