"""The least robust rollouts of any scenario that tells where its cars are, in 3D.

Every rollout has a road of its own, the least robust one's nearest to the viewer. The ego car's
centre stays at x = 0, so that the rollouts can be compared; the road moves instead. Coordinates: x
ahead, y to the left, in metres. :mod:`pemviz.recording.scene_plan` has the same from above.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from pemviz.arrays import AnyArray, FloatArray
from pemviz.colors import DETECTED, GREEN, GREY, MISSED, Rgba, car_color
from pemviz.recording import paths
from pemviz.recording.shades import ROAD, WORDS, shade
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_road import DrawnRoad, drawn_road
from pemviz.runs.drawn_rollout import NOT_EVALUATED, RIGHT, WRONG, DrawnRollout, answer_words
from pemviz.simulators.scene import Road, SceneCar, SceneTracks, SceneZone

MOST_ROADS = 3
WIDTH_M = 34.0
"""Of all roads and verges together, which is where ranks end."""
VERGE_M = 5.0
"""Between two roads; a rollout's words stand there."""
BEHIND_M, AHEAD_M = 15.0, 60.0
PAINT_M = 0.03
ANSWERS: dict[int, Rgba] = {
    NOT_EVALUATED: shade(GREY),
    RIGHT: shade(DETECTED),
    WRONG: shade(MISSED),
}
SIGMAS = 2.0
"""How many standard deviations an ellipse of a track reaches."""
RADII_M = {NOT_EVALUATED: 0.15, RIGHT: 0.3, WRONG: 0.6}
"""Of the mark over a car: a miss differs in more than its colour."""
MARK_M, NEXT_MARK_M = 1.8, 1.5
"""How high a mark is over the first car's roof, and how much higher over the next one's."""
CABIN_SHARE, BODY_SHARE = 0.55, 0.58
"""Of a car's length, and of its height."""
ZONE_WORDS_M, ZONE_WORDS_ASIDE_M = 4.0, 3.0
UNKNOWN_SD_M = 0.02


def row_m(road: Road) -> float:
    """How far a rollout's road is from the next."""
    return road.left_m - road.right_m + VERGE_M


def roads_shown(road: Road) -> int:
    """How many of the least robust rollouts there is room for: at least two."""
    return min(max(int(WIDTH_M // row_m(road)), 2), MOST_ROADS)


@dataclass(frozen=True)
class OnRoad:
    """A rollout on its road, and where that is written; ranks count from 1."""

    file: RecordingFile
    drawn: DrawnRollout
    rank: int
    title: str
    times: StepTimes

    @property
    def shift_m(self) -> float:
        """What is added to the rollout's own y."""
        road = self.drawn.road
        return (self.rank - 1) * row_m(road) - road.right_m

    @property
    def grey_from(self) -> int:
        """The first state of contact: what follows is no motion of the encounter."""
        drawn = self.drawn
        return drawn.count if drawn.contact_step is None else drawn.contact_step

    @property
    def titles(self) -> list[str]:
        """Which rollout it is, at every step; how it ended, from then on."""
        before, after = f"rank {self.rank}: {self.title}", f"rank {self.rank}: "
        grey = [after + self.drawn.contact_words] * (self.drawn.count - self.grey_from)
        return [before] * self.grey_from + grey

    def drawn_road(self, beyond_m: float = 0.0) -> DrawnRoad:
        """Its road, as far as a picture shows of it at any step, and farther."""
        ego_m = self.drawn.states.x_m[:, 0]
        from_m, to_m = float(np.min(ego_m)) - BEHIND_M, float(np.max(ego_m)) + AHEAD_M
        return drawn_road(self.drawn.road, from_m=from_m - beyond_m, to_m=to_m + beyond_m)

    @property
    def road_moves(self) -> Any:
        """The road's move from step to step, as columns: the ego stays where it is."""
        moved = np.zeros((self.drawn.count, 3))
        moved[:, 0] = -self.drawn.states.x_m[:, 0]
        return rr.Transform3D.columns(translation=moved)

    def log(self, path: str, fixed: Sequence[Any], columns: Any) -> None:
        """Log what stays the same and what changes from step to step."""
        self.file.static(path, *fixed)
        self.file.along(path, columns, times=self.times)


def on_roads(
    file: RecordingFile, drawn: Sequence[tuple[DrawnRollout, str]], *, stage: int
) -> list[OnRoad]:
    """Rollouts and their titles, in the order of their ranks."""
    return [
        OnRoad(file, one, rank, title, StepTimes(stage, one.count, one.dt_s))
        for rank, (one, title) in enumerate(drawn, start=1)
    ]


def log_scene(file: RecordingFile, shown: Sequence[OnRoad]) -> None:
    """A road for each rollout; later calls replace what earlier ones drew."""
    file.static(paths.SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    for one in shown:
        _log_road(one)
        for car in range(len(one.drawn.cars)):
            _log_car(one, car)
        if one.drawn.tracks is not None:
            _log_tracks(one, one.drawn.tracks)
        at_m = [-BEHIND_M + 9.0, one.drawn.road.left_m + one.shift_m + 2.0, 0.0]
        words = rr.Points3D.from_fields(
            positions=[at_m], radii=[0.02], colors=[WORDS], show_labels=True
        )
        columns = rr.Points3D.columns(labels=one.titles)
        one.log(paths.lane(one.rank, "words"), (words,), columns)


def _log_road(one: OnRoad) -> None:
    """All of the road that the rollout comes by; it moves, and the ego stays."""
    road, path = one.drawn_road(), paths.lane(one.rank, "road")
    asphalt, faces = list[FloatArray](), list[AnyArray]()
    for right, left in road.asphalt:
        at, count = np.arange(len(right) - 1), len(right)
        first = sum(map(len, asphalt))
        corners = [(at, at + 1, at + count), (at + 1, at + count + 1, at + count)]
        faces += [first + np.stack(one_face, axis=1) for one_face in corners]
        asphalt += [right, left]
    shift = (0.0, one.shift_m)
    lines = [_at_height(line + shift, PAINT_M) for line in (*road.solid, *road.dashed)]
    ground = rr.Mesh3D(
        vertex_positions=_at_height(np.concatenate(asphalt) + shift, 0.0),
        triangle_indices=np.concatenate(faces),
        albedo_factor=ROAD,
    )
    one.log(path, (ground, rr.LineStrips3D(lines, colors=WORDS, radii=0.06)), one.road_moves)


def _at_height(line: FloatArray, z_m: float) -> FloatArray:
    return np.column_stack([line, np.full(len(line), z_m)])


def _log_car(one: OnRoad, car: int) -> None:
    path, drawn = paths.road_car(one.rank, car), one.drawn
    shape, states = drawn.cars[car], drawn.states
    ahead_m = states.x_m[:, car] - states.x_m[:, 0]
    there = states.present[:, car]
    half = np.where(there, states.heading_rad[:, car], 0.0) / 2
    zeros = np.zeros_like(half)
    turned = np.stack([zeros, zeros, np.sin(half), np.cos(half)], axis=1)
    centre_m = np.stack([ahead_m, states.y_m[:, car] + one.shift_m, zeros], axis=1)
    centre_m = np.where(there[:, None], centre_m, [0.0, 0.0, -100.0])  # out of sight
    moved = rr.Transform3D.columns(translation=centre_m, quaternion=turned)
    one.file.along(path, moved, times=one.times)
    shades = np.tile(np.array(shade(car_color(car)), dtype=np.uint8), (drawn.count, 1))
    shades[one.grey_from :] = shade(GREY)
    columns = rr.Boxes3D.columns(colors=np.repeat(shades, 2, axis=0))
    one.log(f"{path}/body", (_body(shape),), columns.partition([2] * drawn.count))
    if shape.zone is not None:
        _log_zone(one, f"{path}/zone", shape, shape.zone)
    slot = drawn.slot_of_car[car]
    if slot is not None:
        _log_mark(one, path, car, slot)
    elif one.rank == 1:
        above = [[0.0, 0.0, shape.height_m + MARK_M]]
        name = rr.Points3D(above, labels=[shape.name], colors=WORDS, radii=0.02, show_labels=True)
        one.file.static(f"{path}/name", name)


def _log_zone(one: OnRoad, path: str, car: SceneCar, zone: SceneZone) -> None:
    """Its outline on the road; of the least robust rollout what happens in it, beyond its far end.

    There they leave the ego's own name free.
    """
    near_m, far_m, aside_m = car.length_m / 2, car.length_m / 2 + zone.ahead_m, 0.8 * car.width_m
    outline = [(near_m, -aside_m), (far_m, -aside_m), (far_m, aside_m), (near_m, aside_m)]
    strip = [(x, y, 0.04) for x, y in [*outline, outline[0]]]
    one.file.static(path, rr.LineStrips3D([strip], colors=shade(GREEN), radii=0.06))
    if one.rank == 1:
        label = rr.Points3D(
            [(far_m + ZONE_WORDS_M, -aside_m - ZONE_WORDS_ASIDE_M, 0.0)],
            labels=[zone.words],
            colors=shade(GREEN),
            radii=0.02,
            show_labels=True,
        )
        one.file.static(f"{path}/words", label)


def _body(car: SceneCar) -> rr.Boxes3D:
    """Body and cabin around the car's centre; colours come with time."""
    low_m = BODY_SHARE * car.height_m
    cabin_m = CABIN_SHARE * car.length_m
    back_m = -0.45 * car.length_m
    return rr.Boxes3D(
        centers=[[0.0, 0.0, low_m / 2], [back_m + cabin_m / 2, 0.0, (low_m + car.height_m) / 2]],
        half_sizes=[
            [car.length_m / 2, car.width_m / 2, low_m / 2],
            [cabin_m / 2, 0.44 * car.width_m, (car.height_m - low_m) / 2],
        ],
        fill_mode="solid",
    )


def _log_mark(one: OnRoad, path: str, car: int, slot: int) -> None:
    """Over the car what perception said of it; of the least robust rollout in words too.

    There a pole leads to it from the car, and every car's is higher than that of the one before,
    so that words of cars behind each other are apart.
    """
    shape, answers = one.drawn.cars[car], one.drawn.answer_about(car).tolist()
    known = min(one.grey_from, one.drawn.count - 1)
    names = [
        f"{shape.name}: {answer_words(one.drawn.slots[slot], answer)}" for answer in answers[:known]
    ]
    names += [shape.name] * (one.drawn.count - known)
    top_m = shape.height_m + MARK_M
    if one.rank == 1:
        top_m += NEXT_MARK_M * (car - 1)
        pole = [(0.0, 0.0, shape.height_m), (0.0, 0.0, top_m)]
        line = rr.LineStrips3D([pole], colors=shade(car_color(car)), radii=0.04)
        one.file.static(f"{path}/pole", line)
    mark = rr.Points3D.from_fields(positions=[(0.0, 0.0, top_m)], show_labels=one.rank == 1)
    shades = np.array([ANSWERS[answer] for answer in answers], dtype=np.uint8)
    radii = [RADII_M[answer] for answer in answers]
    columns = rr.Points3D.columns(colors=shades, radii=radii, labels=names)
    one.log(f"{path}/outcome", (mark,), columns)


def _log_tracks(one: OnRoad, tracks: SceneTracks) -> None:
    """Where the controller believes cars to be: a flat ellipse of two standard deviations."""
    drawn = one.drawn
    shown = tracks.confirmed & (np.arange(drawn.count) < one.grey_from)[:, None]
    step, slot = np.nonzero(shown)
    lengths = shown.sum(axis=1)
    ahead_m = tracks.x_m[step, slot] - drawn.states.x_m[step, 0]
    aside_m = tracks.y_m[step, slot] + one.shift_m
    centers = np.stack([ahead_m, aside_m, np.full(step.size, 0.1)], axis=1)
    reach = [
        SIGMAS * np.maximum(sd_m[step, slot], UNKNOWN_SD_M)
        for sd_m in (tracks.x_sd_m, tracks.y_sd_m)
    ]
    sizes = np.stack([*reach, np.full(step.size, 0.05)], axis=1)
    cars = [drawn.car_of_slot(place) for place in slot.tolist()]
    car_sizes = np.array([(c.length_m, c.width_m, c.height_m) for c in cars]).reshape(-1, 3)

    def grey(opacity: int) -> AnyArray:
        return np.tile(np.array((*WORDS[:3], opacity), dtype=np.uint8), (step.size, 1))

    path = paths.lane(one.rank, "tracks")
    columns = rr.Ellipsoids3D.columns(centers=centers, half_sizes=sizes, colors=grey(150))
    one.log(path, (rr.Ellipsoids3D.from_fields(fill_mode="solid"),), columns.partition(lengths))
    above = centers + np.array([0.0, 0.0, 0.65])
    boxes = rr.Boxes3D.columns(centers=above, half_sizes=car_sizes / 2, colors=grey(255))
    wires = rr.Boxes3D.from_fields(fill_mode="majorwireframe")
    one.log(f"{path}/cars", (wires,), boxes.partition(lengths))
