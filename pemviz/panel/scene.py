"""The 3D scene of one rollout of any scenario that tells where its cars are.

Coordinates: x along the road, y to the left, z up, in metres; the ego's centre is at x = 0 when
the rollout begins.
"""

import threading
from dataclasses import dataclass
from typing import Literal

import numpy as np
import viser

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.colors import BLUE, DETECTED, MISSED, car_color, rgb
from pemviz.panel.server import guarded_server
from pemviz.runs.drawn_road import drawn_road
from pemviz.runs.drawn_rollout import NOT_EVALUATED, RIGHT, WRONG, DrawnRollout, answer_words


@dataclass(frozen=True)
class Mesh:
    """Vertices ``[V, 3]`` in metres and triangles ``[F, 3]``."""

    vertices: FloatArray
    faces: IntArray


def extruded(profile: FloatArray, *, width: float, y: float = 0.0) -> Mesh:
    """A convex counter-clockwise profile ``[N, 2]`` in x and z, extruded along y around ``y``."""
    count = len(profile)
    sides = [np.insert(profile, 1, y + side * width / 2, axis=1) for side in (-1, 1)]
    faces: list[tuple[int, int, int]] = []
    for place in range(1, count - 1):
        faces.append((0, place, place + 1))
        faces.append((count, count + place + 1, count + place))
    for place in range(count):
        after = (place + 1) % count
        faces.append((place, count + place, after))
        faces.append((after, count + place, count + after))
    return Mesh(np.concatenate(sides), np.asarray(faces, dtype=np.int64))


def strip_between(right: FloatArray, left: FloatArray) -> Mesh:
    """The ground between two lines ``[N, 2]``."""
    count = len(right)
    vertices = np.concatenate([right, left])
    at = np.arange(count - 1)
    faces = [(at, at + 1, at + count), (at + 1, at + count + 1, at + count)]
    return Mesh(
        np.column_stack([vertices, np.full(2 * count, -0.01)]),
        np.concatenate([np.stack(corners, axis=1) for corners in faces]),
    )


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


CAR_LENGTH_M, WIDTH_M, HEIGHT_M = 5.0, 1.75, 1.55
BODY = np.array([(0, 0.3), (5, 0.3), (5, 0.72), (4.85, 0.84), (0.15, 0.98), (0, 0.88)])
CABIN = np.array(
    [(0.45, 0.93), (3.75, 0.82), (2.95, 1.42), (2.55, 1.5), (1.2, 1.5), (0.9, 1.42)]
)  # fmt: skip
ROOF = np.array([(1.05, 1.48), (2.75, 1.46), (2.5, 1.54), (1.3, 1.55)])
ROUND = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
WHEEL = 0.34 * np.stack([np.cos(ROUND), np.sin(ROUND) + 1.0], axis=1)
CAR_BODY = joined(extruded(BODY, width=WIDTH_M), extruded(ROOF, width=WIDTH_M - 0.32))
"""Its rear at x = 0, the ground at z = 0."""
CAR_GLASS = extruded(CABIN, width=WIDTH_M - 0.18)
CAR_WHEELS = joined(
    *(
        extruded(WHEEL + np.array([x, 0.0]), width=0.22, y=y)
        for x in (0.95, 4.05)
        for y in (-WIDTH_M / 2 + 0.08, WIDTH_M / 2 - 0.08)
    )
)
BAR = np.array([(-0.42, -0.07), (0.42, -0.07), (0.42, 0.07), (-0.42, 0.07)])
HIT_MARK = extruded(np.array([(-0.28, 0), (0.28, 0), (0.28, 0.05), (-0.28, 0.05)]), width=0.5)
"""A flat lozenge on the road."""
MISS_MARK = joined(
    *(
        extruded(BAR @ np.array([[c, s], [-s, c]]) + np.array([0.0, 0.42]), width=0.14)
        for c, s in ((np.sqrt(0.5), np.sqrt(0.5)), (np.sqrt(0.5), -np.sqrt(0.5)))
    )
)
"""An upright cross, which differs from the hit's mark in more than colour."""

ROOT, WORDS = "/world", "/words-"
FIRST_VIEW_POSITION = (-24.0, -14.0, 16.0)
FIRST_VIEW_TARGET = (14.0, 0.5, -6.0)
FIRST_VIEW_FOV = 0.66
ROAD = (72, 76, 84)
VERGE = (176, 190, 168)
PAINT = (240, 240, 240)
GLASS = (28, 34, 44)
TYRE = (22, 22, 24)
LAMP_ON, LAMP_OFF = (255, 20, 20), (84, 12, 12)
AFTER_CONTACT = (150, 150, 150)
BRAKING_MPS2 = 1.0
"""From which on a car's lamps are lit."""
BEFORE_M, BEYOND_M = 70.0, 150.0
KERB_M = 0.4
"""Of asphalt beyond a road's outer lines."""
SIGMAS = 2.0
TRACKED = (255, 255, 255)
ANGLES = np.linspace(0.0, 2.0 * np.pi, 25)
CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]) / 2
MARK_SPACING_M = 1.3
BALL_ABOVE_M, WORDS_ABOVE_M, WORDS_ASIDE_M = 0.8, 1.4, 0.4
"""Of what tells of a car: over its roof, and beside it."""
LAMPS = ((-0.5, -0.38, 0.48), (-0.5, 0.38, 0.48), (-0.33, 0.0, 0.88))
"""Of a car's length, width and height, from its centre on the ground."""
LAMP_SIZES_M = ((0.1, 0.34, 0.2), (0.1, 0.34, 0.2), (0.2, 0.5, 0.08))
BALL_M = {NOT_EVALUATED: 0.12, RIGHT: 0.28, WRONG: 0.5}
BALLS = {NOT_EVALUATED: AFTER_CONTACT, RIGHT: rgb(DETECTED), WRONG: rgb(MISSED)}


class Scene:
    """Draws a rollout with one scene API, of a browser or of an exporter.

    Attributes:
        follow: Whether the ego car stays put and the road moves, so that any view follows it.
    """

    def __init__(self, api: viser.SceneApi) -> None:
        lights(api)
        self._api = api
        self._drawn: DrawnRollout | None = None
        self.follow = True
        self._cars: list[_Car] = []
        self._words = _Words(api)
        self._tracks: list[viser.LineSegmentsHandle] = []

    def clear(self) -> None:
        """Nothing is drawn."""
        if self._drawn is not None:
            self._api.remove_by_name(ROOT)
            self._words.hide()
        self._drawn, self._cars, self._tracks = None, [], []

    def show(self, drawn: DrawnRollout) -> None:
        """Draw another rollout; call :meth:`at` afterwards."""
        self.clear()
        self._drawn = drawn
        self._world = self._api.add_frame(ROOT, show_axes=False)
        self._ground(drawn)
        self._cars = [_Car(self._api, drawn, car) for car in range(len(drawn.cars))]
        if drawn.tracks is not None:
            self._tracks = [self._track_lines(slot) for slot in range(len(drawn.slots))]
        self._marks(drawn)

    def at(self, step: int) -> None:
        """Move everything to a step of the rollout."""
        drawn = self._drawn
        if drawn is None:
            return
        ego_x_m = float(drawn.states.x_m[step, 0])
        ahead_m = -ego_x_m if self.follow else 0.0
        self._world.position = (ahead_m, 0.0, 0.0)
        after = drawn.contact_step is not None and step >= drawn.contact_step
        for car in self._cars:
            car.at(step, after=after)
        self._words.at(drawn, step, ahead_m=ahead_m, after=after)
        tracks = drawn.tracks
        for slot, lines in enumerate(self._tracks):
            lines.visible = tracks is not None and not after and bool(tracks.confirmed[step, slot])
            if tracks is None or not lines.visible:
                continue
            # where the controller believes a slot's car to be: its outline and an ellipse
            centre = np.array([tracks.x_m[step, slot], tracks.y_m[step, slot]])
            car = drawn.car_of_slot(slot)
            outline = centre + CORNERS * (car.length_m + 0.3, car.width_m + 0.3)
            reach = SIGMAS * np.array([tracks.x_sd_m[step, slot], tracks.y_sd_m[step, slot]])
            ellipse = centre + np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) * reach
            flat = [_segments(outline, 0.06), _segments(ellipse, car.height_m + 0.15)]
            lines.points = np.concatenate(flat).astype(np.float32)

    def _ground(self, drawn: DrawnRollout) -> None:
        x_m = drawn.states.x_m[drawn.states.present]
        start_m, end_m = float(np.min(x_m)) - BEFORE_M, float(np.max(x_m)) + BEYOND_M
        road = drawn_road(drawn.road, from_m=start_m, to_m=end_m)
        middle_m = (start_m + end_m) / 2
        self._api.add_box(
            f"{ROOT}/verge",
            color=VERGE,
            dimensions=(end_m - start_m + 400.0, 400.0, 0.1),
            position=(middle_m, 0.0, -0.2),
            cast_shadow=False,
        )
        kerb = np.array([0.0, KERB_M])
        for place, (right, left) in enumerate(road.asphalt):
            flat = strip_between(right - kerb, left + kerb)
            self._api.add_mesh_simple(
                f"{ROOT}/road{place}",
                vertices=flat.vertices.astype(np.float32),
                faces=flat.faces.astype(np.uint32),
                color=ROAD,
                side="double",
                cast_shadow=False,
            )
        solid = [np.stack([line[:-1], line[1:]], axis=1) for line in road.solid]
        painted = np.concatenate([*solid, road.dashed])
        points = np.full((len(painted), 2, 3), 0.02)
        points[..., :2] = painted
        self._api.add_line_segments(
            f"{ROOT}/lines", points=points.astype(np.float32), colors=PAINT, thickness=0.13
        )

    def _track_lines(self, slot: int) -> viser.LineSegmentsHandle:
        return self._api.add_line_segments(
            f"{ROOT}/track{slot}",
            points=np.zeros((len(CORNERS) + len(ANGLES) - 2, 2, 3), dtype=np.float32),
            colors=TRACKED,
            thickness=0.09,
            visible=False,
        )

    def _marks(self, drawn: DrawnRollout) -> None:
        """Beside the road, a row for each slot: where the ego was at every answer about it."""
        end = drawn.count - 1 if drawn.contact_step is None else drawn.contact_step
        x_m = drawn.states.x_m[:-1, 0]
        edge_m = drawn.road.right_m
        for answer, mesh, color in (
            (RIGHT, HIT_MARK, DETECTED),
            (WRONG, MISS_MARK, MISSED),
        ):
            step, slot = np.nonzero(drawn.answers[:end] == answer)
            if not step.size:
                continue
            places = np.zeros((step.size, 3), dtype=np.float32)
            places[:, 0], places[:, 1] = x_m[step], edge_m - 1.0 - MARK_SPACING_M * slot
            self._api.add_batched_meshes_simple(
                f"{ROOT}/answers{answer}",
                vertices=mesh.vertices.astype(np.float32),
                faces=mesh.faces.astype(np.uint32),
                batched_wxyzs=np.tile(np.array([1.0, 0, 0, 0], dtype=np.float32), (step.size, 1)),
                batched_positions=places,
                batched_colors=linear(rgb(color)),
                flat_shading=True,
                side="double",
                lod="off",
                cast_shadow=False,
            )


class _Car:
    """One car: body, glass, wheels, lamps, its zone and, over it, what perception tells of it."""

    def __init__(self, api: viser.SceneApi, drawn: DrawnRollout, car: int) -> None:
        self._drawn, self._car = drawn, car
        shape = drawn.cars[car]
        self._color = rgb(car_color(car))
        self._answers = drawn.answer_about(car)
        path = f"{ROOT}/car{car}"
        self._frame = api.add_frame(path, show_axes=False)
        parts = (
            ("body", CAR_BODY, self._color),
            ("glass", CAR_GLASS, GLASS),
            ("wheels", CAR_WHEELS, TYRE),
        )
        centre = np.array([CAR_LENGTH_M / 2, 0.0, 0.0])
        size = np.array([shape.length_m, shape.width_m, shape.height_m])
        size /= (CAR_LENGTH_M, WIDTH_M, HEIGHT_M)
        self._body, *_ = [
            api.add_mesh_simple(
                f"{path}/{name}",
                vertices=((mesh.vertices - centre) * size).astype(np.float32),
                faces=mesh.faces.astype(np.uint32),
                color=color,
                flat_shading=True,
                side="double",
            )
            for name, mesh, color in parts
        ]
        self._lamps = [
            api.add_box(
                f"{path}/lamp{number}",
                color=LAMP_OFF,
                dimensions=lamp_m,
                position=(x * shape.length_m, y * shape.width_m, z * shape.height_m),
                cast_shadow=False,
            )
            for number, ((x, y, z), lamp_m) in enumerate(zip(LAMPS, LAMP_SIZES_M, strict=True))
        ]
        self._brakes = brakes(drawn.states.speed_mps[:, car], dt_s=drawn.dt_s)
        if shape.zone is not None:
            ahead_m, front_m = shape.zone.ahead_m, shape.length_m / 2
            api.add_box(
                f"{path}/zone",
                color=rgb(BLUE),
                dimensions=(ahead_m, 1.6 * shape.width_m, 0.02),
                position=(front_m + ahead_m / 2, 0.0, 0.01),
                opacity=0.32,
                cast_shadow=False,
            )
        self._ball = api.add_icosphere(
            f"{path}/answer", 1.0, BALLS[NOT_EVALUATED],
            position=(0.0, 0.0, shape.height_m + BALL_ABOVE_M),
            cast_shadow=False, visible=False,
        )  # fmt: skip
        self._is_evaluated = drawn.slot_of_car[car] is not None

    def at(self, step: int, *, after: bool) -> None:
        states, car = self._drawn.states, self._car
        there = bool(states.present[step, car])
        self._frame.visible = there
        if not there:
            return
        half = float(states.heading_rad[step, car]) / 2
        self._frame.position = (float(states.x_m[step, car]), float(states.y_m[step, car]), 0.0)
        self._frame.wxyz = (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))
        shade = AFTER_CONTACT if after else self._color
        if tuple(self._body.color) != shade:
            self._body.color = shade
        for lamp in self._lamps:
            lit = not after and bool(self._brakes[step])
            lamp.color, lamp.scale = (LAMP_ON, 1.35) if lit else (LAMP_OFF, 1.0)
        answer = int(self._answers[step])
        self._ball.visible = self._is_evaluated and not after and step < self._drawn.count - 1
        self._ball.color, self._ball.scale = BALLS[answer], BALL_M[answer]


class _Words:
    """What is written: a label for each car, and when and how fast the ego touched one.

    The labels stay from one rollout to the next, and only move: of labels that are taken away and
    put back at once, a browser may draw one at another one's place.
    """

    def __init__(self, api: viser.SceneApi) -> None:
        self._api = api
        self._contact: viser.LabelHandle | None = None
        self._names: list[viser.LabelHandle] = []

    def hide(self) -> None:
        for label in (self._contact, *self._names):
            if label is not None:
                label.visible = False

    def at(self, drawn: DrawnRollout, step: int, *, ahead_m: float, after: bool) -> None:
        """Beside each car its name and, of one that perception is asked about, the answer.

        Names stand to the left of their cars and what contact was like to the right of the ego:
        there they cover no car, seen from behind or from above.
        """
        if self._contact is None:
            self._contact = self._label("contact", anchor="top-left", scale=1.15)
        while len(self._names) < len(drawn.cars):
            name = f"car{len(self._names)}"
            self._names.append(self._label(name, anchor="bottom-center", scale=0.95))
        x_m, y_m = drawn.states.x_m[step] + ahead_m, drawn.states.y_m[step]
        for car, (label, shape) in enumerate(zip(self._names, drawn.cars, strict=False)):
            label.visible = bool(drawn.states.present[step, car])
            slot = drawn.slot_of_car[car]
            label.text = shape.name
            if slot is not None and not after and step < len(drawn.answers):
                answer = int(drawn.answers[step, slot])
                label.text = f"{shape.name}: {answer_words(drawn.slots[slot], answer)}"
            aside_m = shape.width_m / 2 + WORDS_ASIDE_M
            above_m = shape.height_m + WORDS_ABOVE_M
            label.position = (float(x_m[car]), float(y_m[car]) + aside_m, above_m)
        self._contact.visible = after
        self._contact.text = drawn.contact_words
        right_m = float(y_m[0]) - drawn.cars[0].width_m / 2 - WORDS_ASIDE_M
        self._contact.position = (float(x_m[0]), right_m, 0.0)

    def _label(
        self, name: str, *, anchor: Literal["bottom-center", "top-left"], scale: float
    ) -> viser.LabelHandle:
        return self._api.add_label(
            f"{WORDS}{name}", "", anchor=anchor, font_screen_scale=scale, visible=False
        )


def lights(api: viser.SceneApi) -> None:
    """A sky and a sun."""
    api.configure_default_lights(enabled=False)
    api.add_light_hemisphere(
        "/light/sky", sky_color=(255, 255, 255), ground_color=(150, 150, 150), intensity=0.65
    )
    api.add_light_directional("/light/sun", intensity=1.0, position=(-6.0, -10.0, 14.0))


def brakes(speed_mps: FloatArray, *, dt_s: float) -> BoolArray:
    """``[T]`` whether a car decelerates noticeably between a state and the next."""
    return np.append(np.diff(speed_mps) < -BRAKING_MPS2 * dt_s, False)


def linear(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """A colour as batched meshes want it: viser takes theirs for linear light."""
    red, green, blue = (round(255 * (channel / 255) ** 2.2) for channel in color)
    return red, green, blue


def _segments(outline: FloatArray, height_m: float) -> FloatArray:
    """A closed outline ``[N, 2]`` as segments ``[N-1, 2, 3]`` at a height."""
    at = np.column_stack([outline, np.full(len(outline), height_m)])
    return np.stack([at[:-1], at[1:]], axis=1)


REST_S = 1.0
_ONE_PAGE_AT_A_TIME = threading.Lock()


def scene_html(drawn: DrawnRollout) -> str:
    """The scene as an HTML page that plays without a server, and rests a moment at its end."""
    with _ONE_PAGE_AT_A_TIME:
        server = guarded_server(host="127.0.0.1", port=0)
        try:
            look_from_first_view(server)
            scene = Scene(server.scene)
            scene.show(drawn)
            scene.at(0)
            serializer = server.get_scene_serializer()
            for step in range(1, drawn.count):
                serializer.insert_sleep(drawn.dt_s)
                scene.at(step)
            serializer.insert_sleep(REST_S)
            return serializer.as_html()
        finally:
            server.stop()


def look_from_first_view(server: viser.ViserServer) -> None:
    """Put the cameras of browsers that connect where the scene is seen from at first."""
    server.initial_camera.position = FIRST_VIEW_POSITION
    server.initial_camera.look_at = FIRST_VIEW_TARGET
    server.initial_camera.fov = FIRST_VIEW_FOV
