"""The least robust rollouts of any scenario that tells where its cars are, in 3D.

Every rollout has a road of its own, the least robust one's nearest to the viewer. The ego car's
centre stays at x = 0, so that the rollouts can be compared; the road moves instead. Coordinates: x
ahead, y to the left, in metres. :mod:`pemviz.recording.scene_plan` has the same from above.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from pemviz.arrays import AnyArray
from pemviz.colors import DETECTED, GREEN, GREY, MISSED, WHITE, Rgba, car_color, rgba
from pemviz.recording import paths
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_rollout import NOT_ASKED, RIGHT, WRONG, DrawnRollout, answer_words
from pemviz.simulators.scene import Road, SceneCar, SceneTracks, SceneZone

MOST_ROADS = 3
WIDTH_M = 34.0
"""Of all roads and verges together, which is where ranks end."""
VERGE_M = 5.0
"""Between two roads; a rollout's words stand there."""
BEHIND_M, AHEAD_M = 15.0, 60.0
DASH_M, DASH_SPACING_M = 3.0, 9.0
ANSWERS: dict[int, Rgba] = {NOT_ASKED: rgba(GREY), RIGHT: rgba(DETECTED), WRONG: rgba(MISSED)}
SIGMAS = 2.0
"""How many standard deviations an ellipse of a track reaches."""
PAINT: Rgba = (190, 190, 190, 255)
ROAD: Rgba = (55, 55, 60, 255)
RADII_M = {NOT_ASKED: 0.15, RIGHT: 0.3, WRONG: 0.6}
"""Of the mark over a car: a miss differs in more than its colour."""
CABIN_SHARE, BODY_SHARE = 0.55, 0.58
"""Of a car's length, and of its height."""
UNKNOWN_SD_M = 0.02


@dataclass(frozen=True)
class RoadPlace:
    """Where a rollout's road lies.

    Attributes:
        rank: Of the rollout, from 1.
        low_m: Right edge of its road, in the rollout's own y.
        high_m: Left edge.
    """

    rank: int
    low_m: float
    high_m: float

    @property
    def shift_m(self) -> float:
        """What is added to the rollout's own y."""
        return (self.rank - 1) * (self.high_m - self.low_m + VERGE_M) - self.low_m


def road_place(drawn: DrawnRollout, rank: int) -> RoadPlace:
    """Where the road of the ``rank``-th rollout lies."""
    edges_m = drawn.road.lane_edges_m
    return RoadPlace(rank=rank, low_m=edges_m[0], high_m=edges_m[-1])


def row_m(road: Road) -> float:
    """How far a rollout's road is from the next."""
    return road.lane_edges_m[-1] - road.lane_edges_m[0] + VERGE_M


def roads_shown(road: Road) -> int:
    """How many of the least robust rollouts there is room for: at least two."""
    return min(max(int(WIDTH_M // row_m(road)), 2), MOST_ROADS)


def with_room(
    drawn: Sequence[DrawnRollout], titles: Sequence[str], *, stage: int
) -> list[tuple[int, DrawnRollout, str, StepTimes]]:
    """Those of the first rollouts that there is room for, with rank, title and times."""
    shown = zip(drawn[: roads_shown(drawn[0].road)], titles, strict=False)
    return [
        (rank, one, title, StepTimes(stage, one.count, one.dt_s))
        for rank, (one, title) in enumerate(shown, start=1)
    ]


def grey_from(drawn: DrawnRollout) -> int:
    """The first state of contact: what follows is no motion of the encounter."""
    return drawn.count if drawn.contact_step is None else drawn.contact_step


def log_scene(
    file: RecordingFile, drawn: Sequence[DrawnRollout], *, titles: Sequence[str], stage: int
) -> None:
    """A road for each of the first rollouts; later calls replace what earlier ones drew."""
    file.static(paths.SCENE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    for rank, one, title, times in with_room(drawn, titles, stage=stage):
        place = road_place(one, rank)
        _log_road(file, one, place, times=times)
        for car in range(len(one.cars)):
            _log_car(file, one, place, car, times=times)
        if one.tracks is not None:
            _log_tracks(file, one, one.tracks, place, times=times)
        _log_words(file, one, place, title=title, times=times)


def _log_road(
    file: RecordingFile, drawn: DrawnRollout, place: RoadPlace, *, times: StepTimes
) -> None:
    rank, shift_m = place.rank, place.shift_m
    middle_m = (place.low_m + place.high_m) / 2 + shift_m
    half = [(BEHIND_M + AHEAD_M) / 2, (place.high_m - place.low_m) / 2 + 0.5, 0.05]
    file.static(
        paths.lane(rank, "road"),
        rr.Boxes3D(
            centers=[[(AHEAD_M - BEHIND_M) / 2, middle_m, -0.06]],
            half_sizes=[half],
            colors=ROAD,
            fill_mode="solid",
        ),
    )
    edges_m = [edge_m + shift_m for edge_m in drawn.road.lane_edges_m]
    solid = [[[-BEHIND_M, y, 0.02], [AHEAD_M, y, 0.02]] for y in (edges_m[0], edges_m[-1])]
    file.static(paths.lane(rank, "edges"), rr.LineStrips3D(solid, colors=PAINT, radii=0.06))
    starts_m = np.arange(DASH_SPACING_M - BEHIND_M, AHEAD_M - DASH_M, DASH_SPACING_M)
    dashes = [[[x, y, 0.02], [x + DASH_M, y, 0.02]] for y in edges_m[1:-1] for x in starts_m]
    if not dashes:
        return
    file.static(paths.lane(rank, "paint"), rr.LineStrips3D(dashes, colors=PAINT, radii=0.06))
    moved = np.zeros((drawn.count, 3))
    moved[:, 0] = -(drawn.states.x_m[:, 0] % DASH_SPACING_M)
    file.along(paths.lane(rank, "paint"), rr.Transform3D.columns(translation=moved), times=times)


def _log_car(
    file: RecordingFile, drawn: DrawnRollout, place: RoadPlace, car: int, *, times: StepTimes
) -> None:
    path = paths.road_car(place.rank, car)
    shape, states = drawn.cars[car], drawn.states
    file.static(f"{path}/body", _body(shape))
    there = states.present[:, car]
    half = np.where(there, states.heading_rad[:, car], 0.0) / 2
    zeros = np.zeros_like(half)
    turned = np.stack([zeros, zeros, np.sin(half), np.cos(half)], axis=1)
    ahead_m = states.x_m[:, car] - states.x_m[:, 0]
    centre_m = np.stack([ahead_m, states.y_m[:, car] + place.shift_m, zeros], axis=1)
    centre_m = np.where(there[:, None], centre_m, [0.0, 0.0, -100.0])  # out of sight
    file.along(path, rr.Transform3D.columns(translation=centre_m, quaternion=turned), times=times)
    shades = np.tile(np.array(rgba(car_color(car)), dtype=np.uint8), (drawn.count, 1))
    shades[grey_from(drawn) :] = rgba(GREY)
    twice = np.repeat(shades, 2, axis=0)
    body = rr.Boxes3D.columns(colors=twice).partition([2] * drawn.count)
    file.along(f"{path}/body", body, times=times)
    if shape.zone is not None:
        _log_zone(file, f"{path}/zone", shape, shape.zone, named=place.rank == 1)
    if drawn.slot_of_car[car] is not None:
        _log_mark(file, drawn, place, car, times=times)


def _log_zone(
    file: RecordingFile, path: str, car: SceneCar, zone: SceneZone, *, named: bool
) -> None:
    """Its outline on the road; of the least robust rollout what happens in it, at its far end."""
    near_m, far_m, aside_m = car.length_m / 2, car.length_m / 2 + zone.ahead_m, 0.8 * car.width_m
    outline = [(near_m, -aside_m), (far_m, -aside_m), (far_m, aside_m), (near_m, aside_m)]
    strip = [(x, y, 0.04) for x, y in [*outline, outline[0]]]
    file.static(path, rr.LineStrips3D([strip], colors=rgba(GREEN), radii=0.06))
    if named:
        label = rr.Points3D(
            [(far_m, -aside_m - 0.6, 0.0)], labels=[zone.words], colors=rgba(GREEN), radii=0.02,
            show_labels=True,
        )  # fmt: skip
        file.static(f"{path}/words", label)


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


def _log_mark(
    file: RecordingFile, drawn: DrawnRollout, place: RoadPlace, car: int, *, times: StepTimes
) -> None:
    """Over the car what perception told of it; of the least robust rollout in words too."""
    path = f"{paths.road_car(place.rank, car)}/outcome"
    answers = drawn.answer_about(car)
    slot_place = drawn.slot_of_car[car] or 0
    names = [
        f"{drawn.cars[car].name}: {answer_words(drawn.slots[slot_place], int(answer))}"
        for answer in answers
    ]
    names[grey_from(drawn) :] = [drawn.cars[car].name] * (drawn.count - grey_from(drawn))
    names[-1] = drawn.cars[car].name
    above_m = drawn.cars[car].height_m + 1.8
    mark = rr.Points3D.from_fields(positions=[[0.0, 0.0, above_m]], show_labels=place.rank == 1)
    file.static(path, mark)
    shades = np.array([ANSWERS[int(answer)] for answer in answers], dtype=np.uint8)
    radii = [RADII_M[int(answer)] for answer in answers]
    columns = rr.Points3D.columns(colors=shades, radii=radii, labels=names)
    file.along(path, columns, times=times)


def _log_tracks(
    file: RecordingFile,
    drawn: DrawnRollout,
    tracks: SceneTracks,
    place: RoadPlace,
    *,
    times: StepTimes,
) -> None:
    """Where the controller believes cars to be: a flat ellipse of two standard deviations."""
    shown = tracks.confirmed & (np.arange(drawn.count) < grey_from(drawn))[:, None]
    step, slot = np.nonzero(shown)
    ego_x_m = drawn.states.x_m[step, 0]
    centers = np.stack(
        [tracks.x_m[step, slot] - ego_x_m, tracks.y_m[step, slot] + place.shift_m,
         np.full(step.size, 0.1)], axis=1,
    )  # fmt: skip
    reach = [
        SIGMAS * np.maximum(sd_m[step, slot], UNKNOWN_SD_M)
        for sd_m in (tracks.x_sd_m, tracks.y_sd_m)
    ]
    sizes = np.stack([*reach, np.full(step.size, 0.05)], axis=1)
    cars = [drawn.car_of_slot(int(one)) for one in slot]
    car_sizes = np.array([(c.length_m, c.width_m, c.height_m) for c in cars]).reshape(-1, 3)
    lengths = shown.sum(axis=1)
    path = paths.lane(place.rank, "tracks")
    file.static(path, rr.Ellipsoids3D.from_fields(fill_mode="solid"))
    columns = rr.Ellipsoids3D.columns(
        centers=centers, half_sizes=sizes, colors=_white(step.size, opacity=150)
    )
    file.along(path, columns.partition(lengths), times=times)
    file.static(f"{path}/cars", rr.Boxes3D.from_fields(fill_mode="majorwireframe"))
    boxes = rr.Boxes3D.columns(
        centers=centers + np.array([0.0, 0.0, 0.65]), half_sizes=car_sizes / 2,
        colors=_white(step.size, opacity=255),
    )  # fmt: skip
    file.along(f"{path}/cars", boxes.partition(lengths), times=times)


def _white(count: int, *, opacity: int) -> AnyArray:
    return np.tile(np.array(rgba(WHITE, opacity=opacity), dtype=np.uint8), (count, 1))


def _log_words(
    file: RecordingFile,
    drawn: DrawnRollout,
    place: RoadPlace,
    *,
    title: str,
    times: StepTimes,
) -> None:
    """Which rollout it is, at its road's beginning; how it ended, from then on."""
    labels = [f"rank {place.rank}: {title}"] * drawn.count
    labels[grey_from(drawn) :] = [f"rank {place.rank}: {drawn.contact_words}"] * (
        drawn.count - grey_from(drawn)
    )
    path = paths.lane(place.rank, "words")
    at_m = [[-BEHIND_M + 8.0, place.high_m + place.shift_m + 0.4 * 5.0, 0.0]]
    file.static(
        path,
        rr.Points3D.from_fields(
            positions=at_m, radii=[0.02], colors=[rgba(WHITE)], show_labels=True
        ),
    )
    file.along(path, rr.Points3D.columns(labels=labels), times=times)
