"""The 3D scene of one rollout: road, two cars, camera's view, gap line, hits and misses.

Coordinates: x ahead, y to the left, z up, in metres; the ego's windscreen camera stands at
x = 0 when the rollout begins.
"""

import math

import numpy as np
import viser
from numpy.typing import NDArray

from pemviz.arrays import FloatArray
from pemviz.colors import BLUE, DETECTED, EGO, LEAD, MISSED, rgb
from pemviz.panel import meshes
from pemviz.panel.views.rollout import Track
from pemviz.simulators.braking.contact import (
    CAMERA_TO_BUMPER_M,
    contact_text,
    drawn_gap,
    until_contact,
)

ROAD = (72, 76, 84)
VERGE = (176, 190, 168)
PAINT = (240, 240, 240)
GLASS = (28, 34, 44)
TYRE = (22, 22, 24)
LAMP_ON, LAMP_OFF = (255, 20, 20), (84, 12, 12)
SAFE, CLOSE = np.array([120.0, 130.0, 140.0]), np.array([225.0, 20.0, 20.0])
FOCAL_PX, IMAGE_PX = 721.5, (1242, 375)
VIEW_DEPTH_M = 2.0
LOOK_AHEAD_WXYZ = (0.5, -0.5, 0.5, -0.5)
FIRST_VIEW_POSITION = (-15.0, -19.0, 12.0)
FIRST_VIEW_TARGET = (4.5, 0.0, -3.6)
FIRST_VIEW_FOV = 0.66
BRAKING_MPS2 = 1.0
AFTER_CONTACT = (150, 150, 150)
OUTCOME = {True: "detected", False: "MISSED"}


class Scene:
    """Draws a rollout with one scene API, of a browser or of an exporter."""

    def __init__(self, api: viser.SceneApi) -> None:
        self._api = api
        self._track: Track | None = None
        self._follow = True
        self._travelled_m: FloatArray = np.zeros(1)
        self._gap_m: FloatArray = np.zeros(1)
        lights(api)
        self._world = api.add_frame("/world", show_axes=False)
        self._ego = api.add_frame("/world/ego", show_axes=False)
        self._lead = api.add_frame("/world/lead", show_axes=False)
        self._ego_body, self._ego_lamps = self._car(
            "/world/ego", color=EGO, x_m=CAMERA_TO_BUMPER_M - meshes.CAR_LENGTH_M
        )
        self._lead_body, self._lead_lamps = self._car("/world/lead", color=LEAD, x_m=0.0)
        self._frustum = api.add_camera_frustum(
            "/world/ego/camera",
            fov=2 * math.atan(IMAGE_PX[1] / 2 / FOCAL_PX),
            aspect=IMAGE_PX[0] / IMAGE_PX[1],
            scale=VIEW_DEPTH_M,
            thickness=0.035,
            color=rgb(DETECTED),
            wxyz=LOOK_AHEAD_WXYZ,
            position=(0.0, 0.0, 1.65),
            cast_shadow=False,
        )
        self._gap_line = api.add_line_segments(
            "/world/ego/gap",
            points=np.zeros((1, 2, 3), dtype=np.float32),
            colors=(120, 130, 140),
            thickness=0.14,
        )
        self._gap_label = api.add_label(
            "/world/ego/gap_label", "gap", anchor="bottom-center", font_screen_scale=1.15
        )

    def clear(self) -> None:
        """Nothing is drawn; a later rollout is."""
        self._world.visible = False

    def show(self, track: Track) -> None:
        """Draw another rollout; call :meth:`at` afterwards."""
        self._track = track
        self._world.visible = True
        dt_s = track.scenario.dt_s
        travelled_m = np.concatenate([[0.0], np.cumsum(track.ego_speed_mps[:-1] * dt_s)])
        self._travelled_m = until_contact(travelled_m, track.contact)
        self._gap_m = drawn_gap(track.gap_m, track.contact)
        self._ground(float(self._travelled_m[-1]))
        self._zones(track.scenario.emergency_gap_m)
        self._marks(track)

    def follow(self, follow: bool) -> None:
        """Whether the ego car stays put and the road moves, so that any view follows it."""
        self._follow = follow

    def at(self, step: int) -> None:
        """Move everything to a step of the rollout."""
        track = self._track
        if track is None:
            return
        x_m, gap_m = float(self._travelled_m[step]), float(self._gap_m[step])
        self._world.position = (-x_m if self._follow else 0.0, 0.0, 0.0)
        self._ego.position = (x_m, 0.0, 0.0)
        self._lead.position = (x_m + gap_m, 0.0, 0.0)
        touching = track.contact is not None and step >= track.contact.step
        self._shade(touching)
        last = step >= track.detected.size
        seen = not last and bool(track.detected[step])
        self._frustum.color = AFTER_CONTACT if touching else rgb(DETECTED if seen else MISSED)
        self._set_gap(track, gap_m, words=gap_words(track, step))
        for lamps, speed_mps in (
            (self._ego_lamps, track.ego_speed_mps),
            (self._lead_lamps, track.lead_speed_mps),
        ):
            self._set_lamps(lamps, not touching and braking(speed_mps, step, track.scenario.dt_s))

    def _shade(self, touching: bool) -> None:
        """Cars in grey from contact on: what the simulation goes on with is no real motion."""
        for body, color in ((self._ego_body, EGO), (self._lead_body, LEAD)):
            shade = AFTER_CONTACT if touching else rgb(color)
            if tuple(body.color) != shade:
                body.color = shade

    def _set_gap(self, track: Track, gap_m: float, *, words: str) -> None:
        start, end = np.array([0.0, 0.0, 1.15]), np.array([gap_m, 0.0, 1.15])
        self._gap_line.points = np.stack([start, end])[None].astype(np.float32)
        self._gap_line.colors = np.tile(
            gap_color(gap_m, wide_m=track.scenario.emergency_gap_m), (1, 2, 1)
        )
        self._gap_label.position = (gap_m / 2, 0.0, 1.9)
        self._gap_label.text = words

    def _set_lamps(self, lamps: list[viser.BoxHandle], lit: bool) -> None:
        for lamp in lamps:
            lamp.color = LAMP_ON if lit else LAMP_OFF
            lamp.scale = 1.35 if lit else 1.0

    def _car(
        self, path: str, *, color: str, x_m: float
    ) -> tuple[viser.MeshHandle, list[viser.BoxHandle]]:
        """A car with its rear at ``x_m``: its body and its lamps."""
        parts = (
            ("body", meshes.car_body(), rgb(color)),
            ("glass", meshes.car_glass(), GLASS),
            ("wheels", meshes.car_wheels(), TYRE),
        )
        body, *_ = [
            self._api.add_mesh_simple(
                f"{path}/{name}",
                vertices=mesh.vertices.astype(np.float32),
                faces=mesh.faces.astype(np.uint32),
                color=shade,
                flat_shading=True,
                side="double",
                position=(x_m, 0.0, 0.0),
            )
            for name, mesh, shade in parts
        ]
        places = ((-0.66, 0.74, 0.34), (0.66, 0.74, 0.34), (0.0, 1.36, 0.5))
        lamps = [
            self._api.add_box(
                f"{path}/lamp{number}",
                color=LAMP_OFF,
                dimensions=(0.1 if number < 2 else 0.2, width, 0.2 if number < 2 else 0.08),
                position=(x_m + (0.0 if number < 2 else 0.85), y, z),
                cast_shadow=False,
            )
            for number, (y, z, width) in enumerate(places)
        ]
        return body, lamps

    def _ground(self, travelled_m: float) -> None:
        start_m, end_m = -60.0, travelled_m + 90.0
        self._api.add_box(
            "/world/verge",
            color=VERGE,
            dimensions=(end_m - start_m + 400.0, 400.0, 0.1),
            position=((start_m + end_m) / 2, 0.0, -0.2),
            cast_shadow=False,
        )
        self._api.add_box(
            "/world/road",
            color=ROAD,
            dimensions=(end_m - start_m, 9.0, 0.1),
            position=((start_m + end_m) / 2, 1.2, -0.06),
            cast_shadow=False,
        )
        dashes_m = np.arange(start_m, end_m, 6.0)
        self._stripes("/world/dashes", dashes_m, dashes_m + 2.5, y_m=1.9)
        ends = (np.array([start_m]), np.array([end_m]))
        self._stripes("/world/edge_right", *ends, y_m=-2.9)
        self._stripes("/world/edge_left", *ends, y_m=5.4)

    def _stripes(self, name: str, starts_m: FloatArray, ends_m: FloatArray, *, y_m: float) -> None:
        height, across = np.full(starts_m.size, 0.02), np.full(starts_m.size, y_m)
        points = np.stack(
            [np.stack([x, across, height], axis=1) for x in (starts_m, ends_m)], axis=1
        )
        self._api.add_line_segments(
            name, points=points.astype(np.float32), colors=PAINT, thickness=0.13
        )

    def _zones(self, emergency_gap_m: float) -> None:
        """The distance in which a detection brakes hard, and where the bumpers touch."""
        self._api.add_box(
            "/world/ego/zone",
            color=rgb(BLUE),
            dimensions=(emergency_gap_m, 3.2, 0.02),
            position=(emergency_gap_m / 2, 0.0, 0.01),
            opacity=0.32,
            cast_shadow=False,
        )
        self._api.add_box(
            "/world/ego/limit",
            color=rgb(MISSED),
            dimensions=(0.12, 3.2, 0.03),
            position=(CAMERA_TO_BUMPER_M, 0.0, 0.03),
            cast_shadow=False,
        )

    def _marks(self, track: Track) -> None:
        at_m = self._travelled_m[:-1]
        real = np.arange(at_m.size) < (at_m.size if track.contact is None else track.contact.step)
        for name, mesh, chosen, color in (
            ("hits", meshes.hit_mark(), real & track.detected, DETECTED),
            ("misses", meshes.miss_mark(), real & ~track.detected, MISSED),
        ):
            count = int(np.count_nonzero(chosen))
            path = f"/world/{name}"
            if not count:
                self._api.remove_by_name(path)
                continue
            positions = np.stack(
                [at_m[chosen], np.full(count, -2.2), np.zeros(count)], axis=1
            ).astype(np.float32)
            self._api.add_batched_meshes_simple(
                path,
                vertices=mesh.vertices.astype(np.float32),
                faces=mesh.faces.astype(np.uint32),
                batched_wxyzs=np.tile(np.array([1.0, 0, 0, 0], dtype=np.float32), (count, 1)),
                batched_positions=positions,
                batched_colors=linear(rgb(color)),
                flat_shading=True,
                side="double",
                lod="off",
                cast_shadow=False,
            )


def lights(api: viser.SceneApi) -> None:
    """A sky and a sun."""
    api.configure_default_lights(enabled=False)
    api.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 150), intensity=0.65
    )
    api.add_light_directional("/light/sun", intensity=1.0, position=(-6.0, -10.0, 14.0))


def gap_words(track: Track, step: int) -> str:
    """The gap and perception's outcome at a step, or how the cars came into contact."""
    if track.contact is not None and step >= track.contact.step:
        return contact_text(track.contact)
    word = "end" if step >= track.detected.size else OUTCOME[bool(track.detected[step])]
    gap_m = float(track.gap_m[step])
    return f"gap {gap_m:.1f} m (bumper {gap_m - CAMERA_TO_BUMPER_M:.1f} m), {word}"


def braking(speed_mps: FloatArray, step: int, dt_s: float) -> bool:
    """Whether a car decelerates noticeably between a step and the next."""
    if step + 1 >= speed_mps.size:
        return False
    return float(speed_mps[step] - speed_mps[step + 1]) > BRAKING_MPS2 * dt_s


def linear(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """A colour as batched meshes want it: viser takes theirs for linear light."""
    red, green, blue = (round(255 * (channel / 255) ** 2.2) for channel in color)
    return red, green, blue


def gap_color(gap_m: float, *, wide_m: float) -> NDArray[np.uint8]:
    """RGB ``[3]`` from 0 to 255: grey at ``wide_m`` and beyond, red at contact."""
    share = float(np.clip((wide_m - gap_m) / max(wide_m - CAMERA_TO_BUMPER_M, 1e-9), 0.0, 1.0))
    return np.rint(SAFE + share * (CLOSE - SAFE)).astype(np.uint8)
