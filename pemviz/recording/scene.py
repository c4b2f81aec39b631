"""The least robust rollouts as a 3D scene, seen from the ego car.

Every lane shows one rollout. The ego car's windscreen camera stays at x = 0, so that the lead
car's rear stands at the gap and the rollouts can be compared; the road moves instead.
Coordinates: x ahead, y to the left, z up, in metres.
"""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import AnyArray, FloatArray
from pemviz.colors import DETECTED, EGO, GREEN, GREY, LEAD, MISSED, WHITE, Rgba, rgba
from pemviz.config import ScenarioConfig
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.recording.worst import Track
from pemviz.simulators.braking.contact import (
    CAMERA_TO_BUMPER_M,
    Contact,
    contact_text,
    drawn_gap,
    first_contact,
    until_contact,
)
from pemviz.simulators.braking.scenario import CAR_HEIGHT_M, CAR_WIDTH_M, EGO_SPEED, GAP

LANES = 5
POST_M = 5.5
LABEL_X_M, LABEL_STEP_M = -7.5, -0.7
"""Where a lane's words stand; farther lanes' cover more of the road."""
LANE_SPACING_M = 4.5
ROAD_START_M = -12.0
ROAD_END_M = 32.0
DASH_SPACING_M = 6.0
DASH_M = 2.5
TICKS_M = (0.0, 5.0, 10.0, 15.0, 20.0)
BONNET_HEIGHT_M = 0.9
FOCAL_PX = 721.5
IMAGE_PX = (1242, 375)
AHEAD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
PAINT: Rgba = (190, 190, 190, 255)
ROAD: Rgba = (55, 55, 60, 255)


def log_scene_setting(file: RecordingFile, scenario: ScenarioConfig) -> None:
    """What never moves: axes, a ruler of gaps, and where emergency braking starts."""
    file.static(paths.SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    near_m, far_m = -LANE_SPACING_M / 2, (LANES - 0.5) * LANE_SPACING_M
    ticks = [[[x, near_m, 0.03], [x, far_m, 0.03]] for x in TICKS_M]
    file.static(
        paths.setting("ruler"),
        rr.LineStrips3D(ticks, colors=rgba(GREY), radii=0.02),
    )
    file.static(
        paths.setting("ruler/labels"),
        rr.Points3D(
            [[x, near_m - 0.8, 0.0] for x in TICKS_M],
            labels=[f"gap {x:g} m" for x in TICKS_M],
            radii=0.05,
            colors=rgba(GREY),
            show_labels=True,
        ),
    )
    edge_m = scenario.emergency_gap_m
    file.static(
        paths.setting("emergency_gap"),
        rr.LineStrips3D(
            [[[edge_m, near_m, 0.05], [edge_m, far_m, 0.05], [edge_m, far_m, POST_M]]],
            colors=rgba(GREEN),
            radii=0.07,
        ),
    )
    file.static(
        paths.setting("emergency_gap/label"),
        rr.Points3D(
            [[edge_m, far_m, POST_M]],
            labels=[f"a detection nearer than {edge_m:g} m brakes hard"],
            colors=rgba(GREEN),
            radii=0.02,
            show_labels=True,
        ),
    )


def log_scene(
    file: RecordingFile, tracks: Sequence[Track], *, scenario: ScenarioConfig, stage: int
) -> None:
    """One lane for each of the first tracks; later calls replace what earlier ones drew."""
    for rank, track in enumerate(tracks[:LANES], start=1):
        _log_lane_setting(file, rank, scenario)
        _log_lane(file, rank, track, scenario=scenario, stage=stage)


def lane_y_m(rank: int) -> float:
    """Where the lane's middle lies; the least robust rollout is nearest to the viewer."""
    return (rank - 1) * LANE_SPACING_M


def _log_lane_setting(file: RecordingFile, rank: int, scenario: ScenarioConfig) -> None:
    if paths.lane(rank, "road") in file.logged:
        return
    y_m = lane_y_m(rank)
    file.static(
        paths.lane(rank, "road"),
        rr.Boxes3D(
            centers=[[(ROAD_START_M + ROAD_END_M) / 2, y_m, -0.06]],
            half_sizes=[[(ROAD_END_M - ROAD_START_M) / 2, 0.45 * LANE_SPACING_M, 0.05]],
            colors=ROAD,
            fill_mode="solid",
        ),
    )
    starts_m = np.arange(ROAD_START_M + DASH_SPACING_M, ROAD_END_M, DASH_SPACING_M)
    side_m = y_m + 0.4 * LANE_SPACING_M
    file.static(
        paths.lane(rank, "paint"),
        rr.LineStrips3D(
            [[[x, side_m, 0.02], [x + DASH_M, side_m, 0.02]] for x in starts_m],
            colors=PAINT,
            radii=0.06,
        ),
    )
    length_m = scenario.lead_length_m
    ego = _car(x_m=CAMERA_TO_BUMPER_M - length_m, y_m=y_m, length_m=length_m)
    file.static(paths.lane(rank, "ego"), ego)
    file.static(
        paths.lane(rank, "camera"),
        rr.Transform3D(translation=[0.0, y_m, scenario.camera_height_m], mat3x3=AHEAD_FROM_CAMERA),
        rr.Pinhole(
            focal_length=FOCAL_PX, width=IMAGE_PX[0], height=IMAGE_PX[1], image_plane_distance=1.5
        ),
    )
    file.static(paths.lane(rank, "lead/body"), _car(x_m=0.0, y_m=y_m, length_m=length_m))


def _car(*, x_m: float, y_m: float, length_m: float) -> rr.Boxes3D:
    """Cabin and bonnet of a car whose rear is at ``x_m``; the bonnet ends in front.

    It has no colour here: what is logged once for all time hides what is logged over time.
    """
    cabin_m = length_m - CAMERA_TO_BUMPER_M
    return rr.Boxes3D(
        centers=[
            [x_m + cabin_m / 2, y_m, CAR_HEIGHT_M / 2],
            [x_m + cabin_m + CAMERA_TO_BUMPER_M / 2, y_m, BONNET_HEIGHT_M / 2],
        ],
        half_sizes=[
            [cabin_m / 2, CAR_WIDTH_M / 2, CAR_HEIGHT_M / 2],
            [CAMERA_TO_BUMPER_M / 2, CAR_WIDTH_M / 2, BONNET_HEIGHT_M / 2],
        ],
        fill_mode="solid",
    )


def _log_lane(
    file: RecordingFile, rank: int, track: Track, *, scenario: ScenarioConfig, stage: int
) -> None:
    contact = first_contact(track.signals[GAP], dt_s=scenario.dt_s)
    gap_m = drawn_gap(track.signals[GAP], contact)
    times = StepTimes(stage=stage, count=gap_m.size, dt_s=scenario.dt_s)
    grey_from = gap_m.size if contact is None else contact.step
    zeros = np.zeros(gap_m.size)
    lead = np.stack([gap_m, zeros, zeros], axis=1)
    file.along(paths.lane(rank, "lead"), rr.Transform3D.columns(translation=lead), times=times)
    for part, color in (("ego", EGO), ("lead/body", LEAD)):
        body = _car_colors(color, count=gap_m.size, grey_from=grey_from)
        file.along(paths.lane(rank, part), rr.Boxes3D.columns(colors=body), times=times)
    shades = _outcome_colors(track, grey_from=grey_from)
    file.along(paths.lane(rank, "camera"), rr.Pinhole.columns(color=shades), times=times)
    travelled_m = _travelled_m(track.signals[EGO_SPEED], dt_s=scenario.dt_s)
    travelled_m = until_contact(travelled_m, contact)
    road = np.stack([-(travelled_m % DASH_SPACING_M), zeros, zeros], axis=1)
    file.along(paths.lane(rank, "paint"), rr.Transform3D.columns(translation=road), times=times)
    _log_label(file, rank, track, contact=contact, times=times)


def _log_label(
    file: RecordingFile, rank: int, track: Track, *, contact: Contact | None, times: StepTimes
) -> None:
    """What happens at each step, in words, at the lane's beginning: there is room there."""
    gap_m = track.signals[GAP]
    outcomes = [*np.where(track.detected, "detected", "MISSED").tolist(), "end"]
    words = [f"{word}, gap {gap:.1f} m" for word, gap in zip(outcomes, gap_m.tolist(), strict=True)]
    if contact is not None:
        words[contact.step :] = [contact_text(contact)] * (gap_m.size - contact.step)
    path = paths.lane(rank, "outcome")
    place = rr.Points3D.from_fields(
        positions=[[LABEL_X_M + (rank - 1) * LABEL_STEP_M, lane_y_m(rank), 0.3]],
        radii=[0.02],
        colors=[rgba(WHITE)],
        show_labels=True,
    )
    file.static(path, place)
    labels = [f"rank {rank}: {word}" for word in words]
    file.along(path, rr.Points3D.columns(labels=labels), times=times)


def _car_colors(color: str, *, count: int, grey_from: int) -> AnyArray:
    """RGBA ``[T, 4]`` of a car: grey from contact on, what follows happens in no encounter."""
    shades = np.tile(np.array(rgba(color), dtype=np.uint8), (count, 1))
    shades[grey_from:] = rgba(GREY)
    return shades


def _outcome_colors(track: Track, *, grey_from: int) -> AnyArray:
    """RGBA ``[T, 4]``: detected, missed; grey at the last state and from contact on."""
    shades = np.empty((track.detected.size + 1, 4), dtype=np.uint8)
    shades[:-1] = np.where(track.detected[:, None], rgba(DETECTED), rgba(MISSED))
    shades[min(grey_from, track.detected.size) :] = rgba(GREY)
    return shades


def _travelled_m(speed_mps: FloatArray, *, dt_s: float) -> FloatArray:
    """Distance ``[T]`` since the start by explicit Euler, as the simulators step."""
    return np.concatenate([[0.0], np.cumsum(speed_mps[:-1] * dt_s)])
