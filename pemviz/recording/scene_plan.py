"""The least robust rollouts of any scenario that tells where its cars are, each from above.

In metres, x ahead of the ego's centre to the right. Words stand beside the road, at their cars:
over its asphalt, which is dark on either theme, none could be read on both.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.colors import BLACK, GREEN, GREY, WHITE, Rgba, car_color, rgba
from pemviz.recording import paths, scene
from pemviz.recording.plot import NO_DOT
from pemviz.recording.scene import ANSWERS, OnRoad
from pemviz.recording.shades import WORDS
from pemviz.runs.drawn_rollout import NOT_EVALUATED, WRONG, answer_words
from pemviz.simulators.scene import Road

Bounds = tuple[tuple[float, float], tuple[float, float]]

CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]) / 2
ANGLES = np.linspace(0.0, 2 * np.pi, 25)
CROSS = ([0, 2], [1, 3])
VERGE_M, VERGE_SHARE, ASIDE_M = 4.0, 0.3, 1.2
"""Above and below the road, where words stand, so much at least and such a share of its width."""
KERB_M = 0.4
"""Of asphalt beyond the outer lines."""
LETTER, AROUND = 0.041, 0.15
"""About how wide a letter is, and what is left free around words, in heights of the view."""
ROAD_LAPS, CAR_LAPS = 8, 4
"""Lines side by side that fill a strip of road, and a car."""
LAP_SHARE = 0.7
"""Radius of such a line, of its share of the width: they overlap, or specks would be left."""
TITLE_M = 20.0
"""Where the middle of a title is, from the view's left end."""
HALO_M = 0.7
"""How far the line that shows an outcome stands off its car, both ends together."""
LINE_M, THIN_M = 0.22, 0.12
ASPHALT: Rgba = (40, 40, 44, 255)
BEHIND_M, AHEAD_M = 25.0, 80.0
"""Of the ego's centre, where the view ends that is sure to be seen."""
BESIDE_VIEW_M = 100.0
"""How much farther all is drawn: in a wide window the view shows more."""


def plan_bounds(road: Road) -> Bounds:
    """What a view shows, from left to right and from top to bottom."""
    width_m = road.left_m - road.right_m
    return (-BEHIND_M, AHEAD_M), (-0.5, width_m + 2 * _verge_m(road) + ASIDE_M)


def _verge_m(road: Road) -> float:
    return max(VERGE_M, VERGE_SHARE * (road.left_m - road.right_m))


def log_scene_plan(one: OnRoad) -> None:
    """A rollout on its road; a later call replaces what an earlier one drew."""
    _log_road(one)
    layers = [*_cars(one), *_outcomes(one), *_tracks(one)]
    fixed = (
        rr.LineStrips2D.from_fields(draw_order=10.0),
        rr.Points2D.from_fields(radii=[NO_DOT], show_labels=True, draw_order=30.0),
    )
    one.log(paths.plan(one.rank), fixed, [*_strips(one, layers), *_words(one)])


def _down(one: OnRoad, y_m: FloatArray) -> FloatArray:
    """Left of the road is up."""
    return _verge_m(one.drawn.road) + one.drawn.road.left_m - y_m


def _flat(one: OnRoad, points: FloatArray) -> FloatArray:
    """Points ``[..., 2]`` ahead and to the left as places of the view."""
    return np.stack([points[..., 0], _down(one, points[..., 1])], axis=-1)


def _log_road(one: OnRoad) -> None:
    """All of the road that the rollout comes by; it moves, and the ego stays."""
    road, beyond = one.drawn_road(BESIDE_VIEW_M), np.array([(0.0, -KERB_M), (0.0, KERB_M)])
    filled = [_filled(edges + beyond[:, None], ROAD_LAPS) for edges in road.asphalt]
    lines = [*road.solid, *road.dashed]
    strips = [_flat(one, line) for line in (*(line for line, _ in filled), *lines)]
    drawn = rr.LineStrips2D(
        strips,
        colors=[ASPHALT] * len(filled) + [rgba(WHITE)] * len(lines),
        radii=[radius_m for _, radius_m in filled] + [THIN_M] * len(lines),
        draw_order=1.0,
    )
    one.log(paths.plan_road(one.rank), (drawn,), one.road_moves)


@dataclass(frozen=True, eq=False)
class _Layer:
    """A line ``[T, P, 2]`` ahead and to the left, its colours ``[T, 4]``, and when it shows."""

    points_m: FloatArray
    colors: AnyArray
    radius_m: float
    shown: BoolArray


def _cars(one: OnRoad) -> Iterator[_Layer]:
    drawn = one.drawn
    after = np.arange(drawn.count) >= one.grey_from
    for car, shape in enumerate(drawn.cars):
        reach_m, shown = shape.length_m / 2, _seen(one, car)
        if shape.zone is not None:
            far_m = reach_m + shape.zone.ahead_m
            across = np.array([(far_m, -shape.width_m), (far_m, shape.width_m)])
            points_m = _turned(one, car, across)
            yield _Layer(points_m, _each(one, rgba(GREEN)), LINE_M, shown & ~after)
        colors = np.where(after[:, None], rgba(GREY), rgba(car_color(car)))
        lap, radius_m = _rectangle(shape.length_m, shape.width_m)
        yield _Layer(_turned(one, car, lap), colors, radius_m, shown)
        across_m = 0.36 * shape.width_m
        windscreen = np.array([(0.3 * reach_m, -across_m), (0.3 * reach_m, across_m)])
        yield _Layer(_turned(one, car, windscreen), _each(one, rgba(BLACK)), 2 * LINE_M, shown)


def _outcomes(one: OnRoad) -> Iterator[_Layer]:
    """A line around every car in its outcome's colour; a cross over one that is missed."""
    for car, shape in enumerate(one.drawn.cars):
        answers = one.drawn.answer_about(car)
        shown = _seen(one, car) & (answers != NOT_EVALUATED)
        size = np.array([shape.length_m + HALO_M, shape.width_m + HALO_M])
        around = _turned(one, car, CORNERS * size)
        colors = np.array([ANSWERS[answer] for answer in answers.tolist()])
        yield _Layer(around, colors, LINE_M, shown)
        for ends in CROSS:
            # on a light ground, as a car may have the cross's colour nearly
            missed = shown & (answers == WRONG)
            yield _Layer(around[:, ends], _each(one, rgba(WHITE)), 1.6 * LINE_M, missed)
            yield _Layer(around[:, ends], colors, LINE_M, missed)


def _tracks(one: OnRoad) -> Iterator[_Layer]:
    """Where the controller believes cars to be, with an ellipse of two standard deviations."""
    drawn, tracks = one.drawn, one.drawn.tracks
    if tracks is None:
        return
    before = np.arange(drawn.count) < one.grey_from
    circle = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    for slot in range(len(drawn.slots)):
        x_m, y_m = tracks.x_m[:, slot] - drawn.states.x_m[:, 0], tracks.y_m[:, slot]
        shown = tracks.confirmed[:, slot] & before & _within(x_m)
        centre = np.stack([x_m, y_m], axis=1)[:, None]
        shape = drawn.car_of_slot(slot)
        outline = centre + CORNERS * (shape.length_m, shape.width_m)
        yield _Layer(outline, _each(one, rgba(WHITE)), THIN_M / 2, shown)
        spread = np.stack([tracks.x_sd_m[:, slot], tracks.y_sd_m[:, slot]], axis=1)
        ellipse = centre + scene.SIGMAS * spread[:, None] * circle
        known = shown & spread.any(axis=1)
        yield _Layer(ellipse, _each(one, rgba(WHITE)), THIN_M, known)


def _strips(one: OnRoad, layers: list[_Layer]) -> Any:
    """Columns of what shows at each step, later layers over earlier ones."""
    step, layer = np.nonzero(np.stack([layer.shown for layer in layers], axis=1))
    flat = [_flat(one, layer.points_m).astype(np.float32) for layer in layers]
    pairs = list(zip(layer.tolist(), step.tolist(), strict=True))
    points = [flat[place][at] for place, at in pairs]
    colors = np.array([layers[place].colors[at] for place, at in pairs], dtype=np.uint8)
    radii = np.array([one_layer.radius_m for one_layer in layers])[layer]
    columns = rr.LineStrips2D.columns(
        strips=_arrow_strips(points), colors=colors.reshape(-1, 4), radii=radii
    )
    return columns.partition(np.bincount(step, minlength=one.drawn.count))


STRIPS: Any = rr.components.LineStrip2DBatch(np.zeros((1, 2, 2), np.float32)).as_arrow_array().type


def _arrow_strips(points: list[FloatArray]) -> Any:
    """Lines as rerun keeps them; by itself it would look at each in turn, which takes longer."""
    ends = np.cumsum([0, *map(len, points)], dtype=np.int32)
    values = pa.array(np.concatenate([np.empty((0, 2), np.float32), *points]).ravel())
    inner = pa.FixedSizeListArray.from_arrays(values, type=STRIPS.value_type)
    return pa.ListArray.from_arrays(pa.array(ends), inner, type=STRIPS)


def _each(one: OnRoad, color: Rgba) -> AnyArray:
    return np.tile(np.array(color), (one.drawn.count, 1))


def _turned(one: OnRoad, car: int, shape_m: FloatArray) -> FloatArray:
    """A shape ``[P, 2]`` around a car's centre where the car is and as it heads, ``[T, P, 2]``."""
    states = one.drawn.states
    heading = states.heading_rad[:, car]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    along, aside = shape_m[:, 0], shape_m[:, 1]
    x_m = (states.x_m[:, car] - states.x_m[:, 0])[:, None] + cos * along - sin * aside
    return np.stack([x_m, states.y_m[:, car][:, None] + sin * along + cos * aside], axis=2)


def _within(ahead_m: FloatArray) -> BoolArray:
    return (ahead_m >= -BEHIND_M - BESIDE_VIEW_M) & (ahead_m <= AHEAD_M + BESIDE_VIEW_M)


def _seen(one: OnRoad, car: int) -> BoolArray:
    """``[T]`` whether a car is there, and near enough to be drawn."""
    states = one.drawn.states
    return states.present[:, car] & _within(states.x_m[:, car] - states.x_m[:, 0])


def _filled(edges: FloatArray, laps: int) -> tuple[FloatArray, float]:
    """A line back and forth that fills what is between two lines ``[2, N, 2]``, and its radius."""
    width_m = float(np.mean(np.linalg.norm(edges[1] - edges[0], axis=1)))
    radius_m = LAP_SHARE * width_m / laps
    shares = np.linspace(radius_m / width_m, 1.0 - radius_m / width_m, laps)
    lines = [edges[0] + share * (edges[1] - edges[0]) for share in shares]
    return np.concatenate([line[:: 1 - 2 * (lap % 2)] for lap, line in enumerate(lines)]), radius_m


def _rectangle(length_m: float, width_m: float) -> tuple[FloatArray, float]:
    """Likewise of a rectangle around the origin."""
    end_m = length_m / 2 - LAP_SHARE * width_m / CAR_LAPS
    sides = [[(-end_m, y), (end_m, y)] for y in (-width_m / 2, width_m / 2)]
    return _filled(np.array(sides), CAR_LAPS)


@dataclass(frozen=True)
class _Words:
    """Words whose middle is wanted at ``x_m``."""

    text: str
    x_m: float
    color: Rgba

    def reach(self) -> float:
        """Half of about how wide they are, in heights of the view."""
        return (LETTER * len(self.text) + AROUND) / 2


def _words(one: OnRoad) -> Any:
    """Above the road which rollout, or how it ended; below it every car and what is said of it."""
    road = one.drawn.road
    # below it a car may come from beside
    below_m = float(_down(one, np.array(road.right_m))) + ASIDE_M
    top_m, bottom_m = plan_bounds(road)[1]
    rows = [
        [
            _Words(title, -BEHIND_M + TITLE_M, WORDS),
            *_apart(list(_said(one, step)), height_m=bottom_m - top_m),
        ]
        for step, title in enumerate(one.titles)
    ]
    every = [
        (words, below_m if place else 0.1 * VERGE_M)
        for row in rows
        for place, words in enumerate(row)
    ]
    columns = rr.Points2D.columns(
        positions=np.array([(words.x_m, down_m) for words, down_m in every]),
        labels=[words.text for words, _ in every],
        colors=np.array([words.color for words, _ in every], dtype=np.uint8),
    )
    return columns.partition([len(row) for row in rows])


def _said(one: OnRoad, step: int) -> Iterator[_Words]:
    """Names of cars in the picture or reported on, and what perception says; likewise of ghosts."""
    drawn, states = one.drawn, one.drawn.states
    # nothing more is said at the end and from contact on
    is_known = step < min(one.grey_from, len(drawn.answers))
    for car, shape in enumerate(drawn.cars):
        ahead_m = float(states.x_m[step, car] - states.x_m[step, 0])
        slot = drawn.slot_of_car[car] if is_known else None
        is_reported = slot is not None and drawn.answers[step, slot] != NOT_EVALUATED
        is_near = -BEHIND_M <= ahead_m <= AHEAD_M
        if states.present[step, car] and (is_reported or is_near):
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


def _apart(words: list[_Words], *, height_m: float) -> Iterator[_Words]:
    """The words, from left to right, moved as far as they would overlap or leave the picture."""
    words = sorted(words, key=lambda one: one.x_m)
    reach_m = [height_m * one.reach() for one in words]
    free_m, places = -BEHIND_M, list[float]()
    for one, half_m in zip(words, reach_m, strict=True):
        places.append(max(one.x_m, free_m + half_m))
        free_m = places[-1] + half_m
    free_m = AHEAD_M
    for place in reversed(range(len(words))):
        places[place] = min(places[place], free_m - reach_m[place])
        free_m = places[place] - reach_m[place]
    for one, x_m in zip(words, places, strict=True):
        yield replace(one, x_m=x_m)
