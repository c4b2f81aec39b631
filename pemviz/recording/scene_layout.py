"""What the two pictures of the least robust rollouts on their roads share: places and colours.

Every rollout has a road of its own, the least robust one's nearest to the viewer. The ego car's
centre stays at x = 0, so that the rollouts can be compared; the road moves instead. Coordinates: x
ahead, y to the left, in metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.colors import DETECTED, GREY, MISSED, Rgba, rgba
from pemviz.runs.drawn_rollout import NOT_ASKED, RIGHT, WRONG, DrawnRollout
from pemviz.simulators.scene import Road

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


def places_m(drawn: DrawnRollout, place: RoadPlace, car: int) -> FloatArray:
    """Centre ``[T, 2]`` of a car, seen from the ego."""
    states = drawn.states
    return np.stack(
        [states.x_m[:, car] - states.x_m[:, 0], states.y_m[:, car] + place.shift_m], axis=1
    )


def dash_starts_m(ego_x_m: float) -> FloatArray:
    """Where dashes of lane lines begin, seen from the ego."""
    first = -BEHIND_M - (ego_x_m - BEHIND_M) % DASH_SPACING_M + DASH_SPACING_M
    return np.arange(first, AHEAD_M - DASH_M, DASH_SPACING_M)


def grey_from(drawn: DrawnRollout) -> int:
    """The first state of contact: what follows is no motion of the encounter."""
    return drawn.count if drawn.contact_step is None else drawn.contact_step


def row_m(road: Road) -> float:
    """How far a rollout's road is from the next."""
    return road.lane_edges_m[-1] - road.lane_edges_m[0] + VERGE_M


def roads_shown(road: Road) -> int:
    """How many of the least robust rollouts there is room for: at least two."""
    return min(max(int(WIDTH_M // row_m(road)), 2), MOST_ROADS)


def with_room(drawn: Sequence[DrawnRollout]) -> Sequence[DrawnRollout]:
    """Those of the first rollouts that there is room for."""
    return drawn[: roads_shown(drawn[0].road)] if drawn else ()
