"""The least robust rollouts of any scenario that tells where its cars are, from above.

In metres, x ahead of the ego's centre to the right, and a road below the other for each rollout.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, GREEN, GREY, WHITE, Rgba, car_color, rgba
from pemviz.recording import paths, scene
from pemviz.recording.plot import NO_DOT
from pemviz.recording.scene import AHEAD_M, ANSWERS, BEHIND_M, DASH_M, VERGE_M, OnRoad, row_m
from pemviz.recording.stream import RecordingFile
from pemviz.runs.drawn_rollout import NOT_EVALUATED, WRONG, DrawnRollout, answer_words
from pemviz.simulators.scene import Road

Bounds = tuple[tuple[float, float], tuple[float, float]]
Strip = tuple[FloatArray, Rgba, float]
"""A line, its colour and its radius [m]."""

CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]) / 2
ANGLES = np.linspace(0.0, 2 * np.pi, 33)
CROSS = ([0, 2], [1, 3])
FIRST_WORDS_M, WORDS_SPACING_M = 38.0, 24.0
LAPS = 8
"""Lines side by side that fill a rectangle."""
HALO_M = 0.7
"""How far the line that shows an outcome stands off its car, both ends together."""
LINE_M, THIN_M = 0.22, 0.12
ASPHALT: Rgba = (40, 40, 44, 255)


def plan_bounds(road: Road) -> Bounds:
    """What a view shows, from left to right and from top to bottom."""
    return (-BEHIND_M - 4.0, AHEAD_M + 4.0), (-1.0, scene.roads_shown(road) * row_m(road) + 1.0)


def log_scene_plan(
    file: RecordingFile, drawn: Sequence[DrawnRollout], *, titles: Sequence[str], stage: int
) -> None:
    """A road for each of the first rollouts; later calls replace what earlier ones drew."""
    for one in scene.on_roads(file, drawn, titles, stage=stage):
        _log_asphalt(one)
        parts = [(_lane_lines, "lines", 2.0), (_cars, "cars", 10.0), (_outcomes, "outcomes", 15.0)]
        if one.drawn.tracks is not None:
            parts.append((_tracks, "tracks", 20.0))
        for draw, name, order in parts:
            steps = [list(draw(one, step)) for step in range(one.drawn.count)]
            every = [strip for strips in steps for strip in strips]
            columns = rr.LineStrips2D.columns(
                strips=[line for line, _, _ in every],
                colors=[color for _, color, _ in every],
                radii=[radius for _, _, radius in every],
            ).partition([len(strips) for strips in steps])
            fixed = rr.LineStrips2D.from_fields(draw_order=order)
            one.log(paths.plan(one.rank, name), fixed, columns)
        _log_words(one)


def _down(one: OnRoad, y_m: FloatArray) -> FloatArray:
    """Left of the road is up."""
    road = one.drawn.road
    return (one.rank - 1) * row_m(road) + VERGE_M + road.lane_edges_m[-1] - y_m


def _flat(one: OnRoad, points: FloatArray) -> FloatArray:
    """Points ``[N, 2]`` ahead and to the left as places of the view."""
    return np.stack([points[:, 0], _down(one, points[:, 1])], axis=1)


def _log_asphalt(one: OnRoad) -> None:
    edges_m = one.drawn.road.lane_edges_m
    middle = np.array([(AHEAD_M - BEHIND_M) / 2, (edges_m[0] + edges_m[-1]) / 2])
    lap, radius_m = _filled(AHEAD_M + BEHIND_M, edges_m[-1] - edges_m[0])
    places = [_flat(one, middle + lap)]
    road = rr.LineStrips2D(places, colors=ASPHALT, radii=radius_m, draw_order=1.0)
    one.file.static(paths.plan(one.rank, "asphalt"), road)


def _lane_lines(one: OnRoad, step: int) -> Iterator[Strip]:
    """Edges without a gap, what parts lanes dashed; dashes stand on the road that moves."""
    down = _down(one, np.asarray(one.drawn.road.lane_edges_m))
    for y in (down[0], down[-1]):
        yield np.array([(-BEHIND_M, y), (AHEAD_M, y)]), rgba(WHITE), THIN_M
    ego_x_m, spacing_m = float(one.drawn.states.x_m[step, 0]), scene.DASH_SPACING_M
    first_m = -BEHIND_M - (ego_x_m - BEHIND_M) % spacing_m + spacing_m
    starts_m = np.arange(first_m, AHEAD_M - DASH_M, spacing_m)
    for y in down[1:-1]:
        for x in starts_m:
            yield np.array([(x, y), (x + DASH_M, y)]), rgba(WHITE), THIN_M


def _cars(one: OnRoad, step: int) -> Iterator[Strip]:
    drawn, states, after = one.drawn, one.drawn.states, step >= one.grey_from
    for car, shape in enumerate(drawn.cars):
        centre = np.array([states.x_m[step, car] - states.x_m[step, 0], states.y_m[step, car]])
        reach_m = shape.length_m / 2
        if not states.present[step, car] or not _in_view(centre[0], reach_m):
            continue
        turn = _turn(float(states.heading_rad[step, car]))
        color = rgba(GREY) if after else rgba(car_color(car))
        if shape.zone is not None and not after:
            far_m = reach_m + shape.zone.ahead_m
            across = np.array([(far_m, -shape.width_m), (far_m, shape.width_m)])
            yield _flat(one, centre + across @ turn.T), rgba(GREEN), LINE_M
        lap, radius_m = _filled(shape.length_m, shape.width_m)
        yield _flat(one, centre + lap @ turn.T), color, radius_m
        across_m = 0.36 * shape.width_m
        windscreen = [(0.3 * reach_m, -across_m), (0.3 * reach_m, across_m)]
        yield _flat(one, centre + np.array(windscreen) @ turn.T), rgba(BLACK), 2 * LINE_M


def _outcomes(one: OnRoad, step: int) -> Iterator[Strip]:
    """A line around every car in its outcome's colour; a cross over one that is missed."""
    drawn, states = one.drawn, one.drawn.states
    for car, shape in enumerate(drawn.cars):
        answer = int(drawn.answer_about(car)[step])
        x_m = states.x_m[step, car] - states.x_m[step, 0]
        if answer == NOT_EVALUATED or not _in_view(x_m, shape.length_m / 2):
            continue
        size = np.array([shape.length_m + HALO_M, shape.width_m + HALO_M])
        turn = _turn(float(states.heading_rad[step, car]))
        flat = _flat(one, np.array([x_m, states.y_m[step, car]]) + (CORNERS * size) @ turn.T)
        yield flat, ANSWERS[answer], LINE_M
        for ends in CROSS if answer == WRONG else ():
            yield flat[ends], ANSWERS[answer], LINE_M


def _tracks(one: OnRoad, step: int) -> Iterator[Strip]:
    """Where the controller believes cars to be, with an ellipse of two standard deviations."""
    drawn, tracks = one.drawn, one.drawn.tracks
    if tracks is None or step >= one.grey_from:
        return
    for slot in np.flatnonzero(tracks.confirmed[step]):
        x_m = tracks.x_m[step, slot] - drawn.states.x_m[step, 0]
        if not _in_view(float(x_m), 0.0):
            continue
        centre = np.array([x_m, tracks.y_m[step, slot]])
        shape = drawn.car_of_slot(int(slot))
        yield (
            _flat(one, centre + CORNERS * (shape.length_m, shape.width_m)),
            rgba(WHITE),
            THIN_M / 2,
        )
        reach = scene.SIGMAS * np.array([tracks.x_sd_m[step, slot], tracks.y_sd_m[step, slot]])
        ellipse = centre + np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) * reach
        if reach.any():
            yield _flat(one, ellipse), rgba(WHITE), THIN_M


def _filled(length_m: float, width_m: float) -> tuple[FloatArray, float]:
    """A line back and forth that fills a rectangle around the origin, and its radius."""
    radius_m = 0.6 * width_m / LAPS
    across_m = np.repeat(np.linspace(radius_m - width_m / 2, width_m / 2 - radius_m, LAPS), 2)
    end_m = length_m / 2 - radius_m
    along_m = np.resize([-end_m, end_m, end_m, -end_m], 2 * LAPS)
    return np.stack([along_m, across_m], axis=1), radius_m


def _turn(heading_rad: float) -> FloatArray:
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([(cos, -sin), (sin, cos)])


def _in_view(x_m: float, reach_m: float) -> bool:
    return -BEHIND_M + reach_m <= x_m <= AHEAD_M - reach_m


def _log_words(one: OnRoad) -> None:
    """Which rollout, then what perception says of every slot; how it ended, from then on."""
    drawn = one.drawn
    colors = [rgba(WHITE)] * len(drawn.slots)
    for car, slot in enumerate(drawn.slot_of_car):
        if slot is not None:
            colors[slot] = rgba(car_color(car))
    # nothing more is said at the end and from contact on
    known = min(one.grey_from, len(drawn.answers))
    labels: list[str] = []
    for step, title in enumerate(one.titles):
        labels.append(title)
        for place, slot in enumerate(drawn.slots):
            answer = answer_words(slot, int(drawn.answers[step, place])) if step < known else ""
            labels.append(f"{slot.name}: {answer}" if answer else slot.name)
    others_m = [FIRST_WORDS_M + WORDS_SPACING_M * place for place in range(len(drawn.slots))]
    above_m = (one.rank - 1) * row_m(drawn.road) + 0.25 * VERGE_M
    places = [(-BEHIND_M + x_m, above_m) for x_m in (11.0, *others_m)]
    words = rr.Points2D.from_fields(
        positions=places, radii=[NO_DOT], colors=[rgba(WHITE), *colors], show_labels=True,
        draw_order=30.0,
    )  # fmt: skip
    columns = rr.Points2D.columns(labels=labels).partition([len(places)] * drawn.count)
    one.log(paths.plan(one.rank, "words"), words, columns)
