"""The least robust rollout of any scenario that tells where its cars are, from above.

In metres, x ahead of the ego's centre to the right. Words stand beside the road, at their cars:
over its asphalt, which is dark on either theme, none could be read on both.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, GREEN, GREY, WHITE, Rgba, car_color, rgba
from pemviz.recording import paths, scene
from pemviz.recording.plot import NO_DOT
from pemviz.recording.scene import AHEAD_M, ANSWERS, BEHIND_M, DASH_M, OnRoad
from pemviz.recording.shades import WORDS
from pemviz.runs.drawn_rollout import NOT_EVALUATED, WRONG, answer_words
from pemviz.simulators.scene import Road

Bounds = tuple[tuple[float, float], tuple[float, float]]
Strip = tuple[FloatArray, Rgba, float]
"""A line, its colour and its radius [m]."""

CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]) / 2
ANGLES = np.linspace(0.0, 2 * np.pi, 33)
CROSS = ([0, 2], [1, 3])
VERGE_M, ASIDE_M = 4.0, 1.2
"""Above and below the road, where words stand; below it a car may come from beside."""
LETTER_M, AROUND_M = 0.75, 3.0
"""About how wide a letter is in the view as it opens, and what is left free around words."""
LAPS = 8
"""Lines side by side that fill a rectangle."""
HALO_M = 0.7
"""How far the line that shows an outcome stands off its car, both ends together."""
LINE_M, THIN_M = 0.22, 0.12
ASPHALT: Rgba = (40, 40, 44, 255)


def plan_bounds(road: Road) -> Bounds:
    """What a view shows, from left to right and from top to bottom."""
    width_m = road.lane_edges_m[-1] - road.lane_edges_m[0]
    return (-BEHIND_M - 1.0, AHEAD_M + 1.0), (-0.5, width_m + 2 * VERGE_M + ASIDE_M)


def log_scene_plan(one: OnRoad) -> None:
    """A rollout on its road; a later call replaces what an earlier one drew."""
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
        one.log(paths.plan(name), fixed, columns)
    _log_words(one)


def _down(one: OnRoad, y_m: FloatArray) -> FloatArray:
    """Left of the road is up."""
    return VERGE_M + one.drawn.road.lane_edges_m[-1] - y_m


def _flat(one: OnRoad, points: FloatArray) -> FloatArray:
    """Points ``[N, 2]`` ahead and to the left as places of the view."""
    return np.stack([points[:, 0], _down(one, points[:, 1])], axis=1)


def _log_asphalt(one: OnRoad) -> None:
    edges_m = one.drawn.road.lane_edges_m
    middle = np.array([(AHEAD_M - BEHIND_M) / 2, (edges_m[0] + edges_m[-1]) / 2])
    lap, radius_m = _filled(AHEAD_M + BEHIND_M, edges_m[-1] - edges_m[0])
    places = [_flat(one, middle + lap)]
    road = rr.LineStrips2D(places, colors=ASPHALT, radii=radius_m, draw_order=1.0)
    one.file.static(paths.plan("asphalt"), road)


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
            # on a light ground, as a car may have the cross's colour nearly
            yield flat[ends], rgba(WHITE), 1.6 * LINE_M
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


@dataclass(frozen=True)
class _Words:
    """Words whose middle is wanted at ``x_m``."""

    text: str
    x_m: float
    color: Rgba

    @property
    def reach_m(self) -> float:
        """Half of about how wide they are."""
        return (LETTER_M * len(self.text) + AROUND_M) / 2


def _log_words(one: OnRoad) -> None:
    """Above the road which rollout, or how it ended; below it every car and what is said of it."""
    below_m = float(_down(one, np.array(one.drawn.road.lane_edges_m[0]))) + ASIDE_M
    rows = [
        [
            _Words(title, -BEHIND_M + 13.0, WORDS),
            *_apart(list(_said(one, step))),
        ]
        for step, title in enumerate(one.titles)
    ]
    every = [(words, 0.1 * VERGE_M if not place else below_m) for row in rows
             for place, words in enumerate(row)]  # fmt: skip
    columns = rr.Points2D.columns(
        positions=[(words.x_m, down_m) for words, down_m in every],
        labels=[words.text for words, _ in every],
        colors=[words.color for words, _ in every],
    ).partition([len(row) for row in rows])
    fixed = rr.Points2D.from_fields(radii=[NO_DOT], show_labels=True, draw_order=30.0)
    one.log(paths.plan("words"), fixed, columns)


def _said(one: OnRoad, step: int) -> Iterator[_Words]:
    """Names of cars in the picture or reported on, and what perception says; likewise of ghosts."""
    drawn, states = one.drawn, one.drawn.states
    # nothing more is said at the end and from contact on
    is_known = step < min(one.grey_from, len(drawn.answers))
    for car, shape in enumerate(drawn.cars):
        ahead_m = float(states.x_m[step, car] - states.x_m[step, 0])
        slot = drawn.slot_of_car[car] if is_known else None
        is_reported = slot is not None and drawn.answers[step, slot] != NOT_EVALUATED
        if states.present[step, car] and (is_reported or _in_view(ahead_m, 0.0)):
            yield _words_of(one, shape.name, slot, step, ahead_m)
    for place, slot in enumerate(drawn.slots):
        if is_known and place not in drawn.slot_of_car and drawn.answers[step, place] == WRONG:
            yield _words_of(one, slot.name, place, step, AHEAD_M)


def _words_of(one: OnRoad, name: str, slot: int | None, step: int, ahead_m: float) -> _Words:
    text, color = name, WORDS
    if slot is not None:
        answer = int(one.drawn.answers[step, slot])
        text = f"{name}: {answer_words(one.drawn.slots[slot], answer)}"
        color = ANSWERS[answer]
    if ahead_m > AHEAD_M:
        text = f"{text}, {ahead_m:.0f} m ahead"
    elif ahead_m < -BEHIND_M:
        text = f"{text}, {-ahead_m:.0f} m behind"
    return _Words(text, ahead_m, color)


def _apart(words: list[_Words]) -> Iterator[_Words]:
    """The words, from left to right, moved as far as they would overlap or leave the picture."""
    words = sorted(words, key=lambda one: one.x_m)
    free_m, places = -BEHIND_M, list[float]()
    for one in words:
        places.append(max(one.x_m, free_m + one.reach_m))
        free_m = places[-1] + one.reach_m
    free_m = AHEAD_M
    for place in reversed(range(len(words))):
        places[place] = min(places[place], free_m - words[place].reach_m)
        free_m = places[place] - words[place].reach_m
    for one, x_m in zip(words, places, strict=True):
        yield replace(one, x_m=x_m)
