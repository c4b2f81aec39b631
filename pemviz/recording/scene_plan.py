"""The least robust rollouts of any scenario that tells where its cars are, from above.

In metres, x ahead of the ego's centre to the right, and a road below the other for each rollout.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from pemviz.arrays import FloatArray
from pemviz.colors import BLACK, GREEN, GREY, WHITE, Rgba, car_color, rgba
from pemviz.recording import paths, scene
from pemviz.recording.plot import NO_DOT
from pemviz.recording.scene import AHEAD_M, ANSWERS, BEHIND_M, DASH_M, VERGE_M, grey_from, row_m
from pemviz.recording.stream import RecordingFile, StepTimes
from pemviz.runs.drawn_rollout import NOT_ASKED, WRONG, DrawnRollout, answer_words
from pemviz.simulators.scene import Road

Bounds = tuple[tuple[float, float], tuple[float, float]]

CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)]) / 2
ANGLES = np.linspace(0.0, 2 * np.pi, 33)
CROSS = ((0, 2), (1, 3))
FIRST_WORDS_M, WORDS_SPACING_M = 38.0, 24.0
LAPS = 8
"""Lines side by side that fill a rectangle."""
HALO_M = 0.7
"""How far the line that shows an outcome stands off its car, both ends together."""
LINE_M, THIN_M = 0.22, 0.12
ASPHALT: Rgba = (40, 40, 44, 255)


@dataclass
class _Strips:
    """Lines of one step, in the order in which they are drawn."""

    lines: list[FloatArray] = field(default_factory=list[FloatArray])
    colors: list[Rgba] = field(default_factory=list[Rgba])
    radii: list[float] = field(default_factory=list[float])

    def add(self, line: FloatArray, color: Rgba, radius_m: float) -> None:
        self.lines.append(line)
        self.colors.append(color)
        self.radii.append(radius_m)


@dataclass(frozen=True)
class _Row:
    """Where a rollout is drawn: its road, and how far down."""

    drawn: DrawnRollout
    rank: int

    def down(self, y_m: FloatArray) -> FloatArray:
        """Left of the road is up."""
        edges_m = self.drawn.road.lane_edges_m
        return (self.rank - 1) * row_m(self.drawn.road) + VERGE_M + edges_m[-1] - y_m

    @property
    def words_m(self) -> float:
        """Where its words stand: above the road."""
        return (self.rank - 1) * row_m(self.drawn.road) + 0.25 * VERGE_M


def plan_bounds(road: Road) -> Bounds:
    """What a view shows, from left to right and from top to bottom."""
    return (-BEHIND_M - 4.0, AHEAD_M + 4.0), (-1.0, scene.roads_shown(road) * row_m(road) + 1.0)


def log_scene_plan(
    file: RecordingFile, drawn: Sequence[DrawnRollout], *, titles: Sequence[str], stage: int
) -> None:
    """A road for each of the first rollouts; later calls replace what earlier ones drew."""
    for rank, one, title, times in scene.with_room(drawn, titles, stage=stage):
        row, steps = _Row(one, rank), range(one.count)
        _log_asphalt(file, row)
        _log_strips(file, row, "lines", [_lane_lines(row, step) for step in steps], times=times)
        _log_strips(file, row, "cars", [_cars(row, step) for step in steps], times=times)
        outcomes = [_outcomes(row, step) for step in steps]
        _log_strips(file, row, "outcomes", outcomes, times=times)
        if one.tracks is not None:
            _log_strips(file, row, "tracks", [_tracks(row, step) for step in steps], times=times)
        _log_words(file, row, title=title, times=times)


def _log_asphalt(file: RecordingFile, row: _Row) -> None:
    edges_m = row.drawn.road.lane_edges_m
    middle = np.array([(AHEAD_M - BEHIND_M) / 2, (edges_m[0] + edges_m[-1]) / 2])
    size_m = (AHEAD_M + BEHIND_M, edges_m[-1] - edges_m[0])
    lap, radius_m = _filled(*size_m)
    file.static(
        paths.plan(row.rank, "asphalt"),
        rr.LineStrips2D([_flat(row, middle + lap)], colors=ASPHALT, radii=radius_m, draw_order=1.0),
    )


def _log_strips(
    file: RecordingFile, row: _Row, part: str, strips: Sequence[_Strips], *, times: StepTimes
) -> None:
    order = {"lines": 2.0, "cars": 10.0, "outcomes": 15.0, "tracks": 20.0}[part]
    path = paths.plan(row.rank, part)
    file.static(path, rr.LineStrips2D.from_fields(draw_order=order))
    columns = rr.LineStrips2D.columns(
        strips=[line for step in strips for line in step.lines],
        colors=[color for step in strips for color in step.colors],
        radii=[radius for step in strips for radius in step.radii],
    )
    file.along(path, columns.partition([len(step.lines) for step in strips]), times=times)


def _lane_lines(row: _Row, step: int) -> _Strips:
    """Edges without a gap, what parts lanes dashed; dashes stand on the road that moves."""
    edges_m, strips = row.drawn.road.lane_edges_m, _Strips()
    down = row.down(np.asarray(edges_m))
    for y in (down[0], down[-1]):
        strips.add(np.array([(-BEHIND_M, y), (AHEAD_M, y)]), rgba(WHITE), THIN_M)
    ego_x_m, spacing_m = float(row.drawn.states.x_m[step, 0]), scene.DASH_SPACING_M
    first_m = -BEHIND_M - (ego_x_m - BEHIND_M) % spacing_m + spacing_m
    starts_m = np.arange(first_m, AHEAD_M - DASH_M, spacing_m)
    for y in down[1:-1]:
        for x in starts_m:
            strips.add(np.array([(x, y), (x + DASH_M, y)]), rgba(WHITE), THIN_M)
    return strips


def _cars(row: _Row, step: int) -> _Strips:
    drawn, strips = row.drawn, _Strips()
    states, after = drawn.states, step >= grey_from(drawn)
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
            strips.add(_flat(row, centre + across @ turn.T), rgba(GREEN), LINE_M)
        lap, radius_m = _filled(shape.length_m, shape.width_m)
        strips.add(_flat(row, centre + lap @ turn.T), color, radius_m)
        across_m = 0.36 * shape.width_m
        windscreen = [(0.3 * reach_m, -across_m), (0.3 * reach_m, across_m)]
        strips.add(_flat(row, centre + np.array(windscreen) @ turn.T), rgba(BLACK), 2 * LINE_M)
    return strips


def _outcomes(row: _Row, step: int) -> _Strips:
    """A line around every car in its outcome's colour; a cross over one that is missed."""
    drawn, strips = row.drawn, _Strips()
    states = drawn.states
    for car, shape in enumerate(drawn.cars):
        answer = int(drawn.answer_about(car)[step])
        x_m = states.x_m[step, car] - states.x_m[step, 0]
        if answer == NOT_ASKED or not _in_view(x_m, shape.length_m / 2):
            continue
        size = np.array([shape.length_m + HALO_M, shape.width_m + HALO_M])
        turn = _turn(float(states.heading_rad[step, car]))
        flat = _flat(row, np.array([x_m, states.y_m[step, car]]) + (CORNERS * size) @ turn.T)
        strips.add(flat, ANSWERS[answer], LINE_M)
        for one, other in CROSS if answer == WRONG else ():
            strips.add(flat[[one, other]], ANSWERS[answer], LINE_M)
    return strips


def _tracks(row: _Row, step: int) -> _Strips:
    """Where the controller believes cars to be, with an ellipse of two standard deviations."""
    drawn, strips = row.drawn, _Strips()
    tracks = drawn.tracks
    if tracks is None or step >= grey_from(drawn):
        return strips
    for slot in np.flatnonzero(tracks.confirmed[step]):
        x_m = tracks.x_m[step, slot] - drawn.states.x_m[step, 0]
        if not _in_view(float(x_m), 0.0):
            continue
        centre = np.array([x_m, tracks.y_m[step, slot]])
        shape = drawn.car_of_slot(int(slot))
        strips.add(
            _flat(row, centre + CORNERS * (shape.length_m, shape.width_m)), rgba(WHITE), THIN_M / 2
        )
        reach = scene.SIGMAS * np.array([tracks.x_sd_m[step, slot], tracks.y_sd_m[step, slot]])
        ellipse = centre + np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) * reach
        if reach.any():
            strips.add(_flat(row, ellipse), rgba(WHITE), THIN_M)
    return strips


def _filled(length_m: float, width_m: float) -> tuple[FloatArray, float]:
    """A line back and forth that fills a rectangle around the origin, and its radius."""
    radius_m = 0.6 * width_m / LAPS
    across_m = np.repeat(np.linspace(radius_m - width_m / 2, width_m / 2 - radius_m, LAPS), 2)
    end_m = length_m / 2 - radius_m
    along_m = np.resize([-end_m, end_m, end_m, -end_m], 2 * LAPS)
    return np.stack([along_m, across_m], axis=1), radius_m


def _flat(row: _Row, points: FloatArray) -> FloatArray:
    """Points ``[N, 2]`` ahead and to the left as places of the view."""
    return np.stack([points[:, 0], row.down(points[:, 1])], axis=1)


def _turn(heading_rad: float) -> FloatArray:
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([(cos, -sin), (sin, cos)])


def _in_view(x_m: float, reach_m: float) -> bool:
    return -BEHIND_M + reach_m <= x_m <= AHEAD_M - reach_m


def _log_words(file: RecordingFile, row: _Row, *, title: str, times: StepTimes) -> None:
    """Which rollout, then what perception tells of every slot; how it ended, from then on."""
    drawn = row.drawn
    names = [""] * len(drawn.slots)
    colors = [rgba(WHITE)] * len(drawn.slots)
    for car, slot in enumerate(drawn.slot_of_car):
        if slot is not None:
            colors[slot] = rgba(car_color(car))
            names[slot] = drawn.cars[car].name
    labels: list[str] = []
    for step in range(drawn.count):
        after = step >= grey_from(drawn)
        first = f"rank {row.rank}: {drawn.contact_words if after else title}"
        labels += [first, *(_slot_words(drawn, slot, step) for slot in range(len(names)))]
    others_m = [FIRST_WORDS_M + WORDS_SPACING_M * place for place in range(len(names))]
    places = [(-BEHIND_M + x_m, row.words_m) for x_m in (11.0, *others_m)]
    path = paths.plan(row.rank, "words")
    file.static(
        path,
        rr.Points2D.from_fields(
            positions=places, radii=[NO_DOT], colors=[rgba(WHITE), *colors], show_labels=True,
            draw_order=30.0,
        ),
    )  # fmt: skip
    columns = rr.Points2D.columns(labels=labels).partition([len(places)] * drawn.count)
    file.along(path, columns, times=times)


def _slot_words(drawn: DrawnRollout, slot: int, step: int) -> str:
    """A slot with perception's answer about it; nothing more at the end and from contact on."""
    name = drawn.slots[slot].name
    if step >= min(grey_from(drawn), len(drawn.answers)):
        return name
    return f"{name}: {answer_words(drawn.slots[slot], int(drawn.answers[step, slot]))}"
