"""The state that a step leads to: contact, headings, and what the rules ask for.

Arrays have a row for each other car, ``[K, N]``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters import margins
from pemviz.simulators.encounters.cars import Values, headings, lateral_places
from pemviz.simulators.encounters.contact import first_touch
from pemviz.simulators.encounters.ego import Told, acceleration
from pemviz.simulators.encounters.margins import Cars
from pemviz.simulators.encounters.names import (
    AVOIDABLE_BY,
    CLEARANCE,
    COLLIDED,
    EGO_ACCELERATION,
    EGO_SPEED,
    EGO_X,
    IMPACT_SPEED,
    NEEDLESS,
    OF_EACH,
    SAFE_DISTANCE,
    Each,
    by_car,
)
from pemviz.types import StateBatch


@dataclass(frozen=True)
class Moved:
    """Where cars are after a whole step in which none touches another.

    Attributes:
        ego_x_m: ``[N]`` centre along the road [m].
        ego_mps: ``[N]`` speed [m/s].
        x_m: ``[K, N]`` the other cars' centres along the road [m].
        y_m: ``[K, N]`` to the left [m].
        speed_mps: ``[K, N]`` [m/s].
    """

    ego_x_m: FloatArray
    ego_mps: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    speed_mps: FloatArray


@dataclass(frozen=True)
class Left:
    """The states ``[N]`` that a step leaves, and what was done in it.

    Attributes:
        config: The encounter.
        cars: Names of the K other cars.
        states: The states.
        each: Where the K other cars are, ``[K, N]``.
        along_mps: The other cars' speeds along the road ``[K, N]`` [m/s].
        values: Start values that steps need, ``[N]``.
        told: What the ego is told, of all slots.
        others_mps2: The other cars' deceleration ``[K, N]`` [m/s^2].
        states_ahead: For how many states each car is the nearest ahead in lane, ``[K, N]``.
    """

    config: EncounterConfig
    cars: tuple[str, ...]
    states: StateBatch
    each: Each
    along_mps: FloatArray
    values: Values
    told: Told
    others_mps2: FloatArray
    states_ahead: IntArray

    @cached_property
    def ego_mps2(self) -> FloatArray:
        """The ego's acceleration ``[N]`` [m/s^2]."""
        signals = self.states.signals
        wanted_mps2 = acceleration(
            self.config, self.told, ego_mps=signals[EGO_SPEED], set_mps=self.values["ego_speed"]
        )
        return np.where(signals[COLLIDED] > 0.0, 0.0, wanted_mps2)


@dataclass(frozen=True)
class _Arrived:
    """As :class:`Moved`, after contact, with ``collided`` and ``impact_mps`` ``[N]``."""

    moved: Moved
    collided: BoolArray
    impact_mps: FloatArray


def arrive(left: Left, moved: Moved) -> tuple[Mapping[str, FloatArray], IntArray, Each]:
    """Signals of the next states, states ahead ``[K, N]``, and where the other cars are.

    Args:
        left: The states that the step leaves.
        moved: Where cars are if none touches another.
    """
    config, before = left.config, left.states.signals
    arrived = _after_contact(left, moved)
    moved = arrived.moved
    time_s = float(left.states.step + 1) * config.dt_s
    next_m = lateral_places(config, left.values, time_s=time_s + config.dt_s)
    heading = headings(moved.y_m, next_m, moved.speed_mps, left.each.heading_rad, config.dt_s)
    cars = Cars(
        ego_mps=moved.ego_mps,
        gap_m=moved.x_m - moved.ego_x_m - config.car_length_m,
        aside_m=moved.y_m,
        along_mps=moved.speed_mps * np.cos(heading),
    )
    nearest = margins.nearest_ahead(config, cars)
    states_ahead = np.where(nearest, left.states_ahead + 1, 0)
    asked_for = {
        SAFE_DISTANCE: margins.settled_distance(config, cars, states_ahead),
        NEEDLESS: margins.needless_deceleration(
            config, _cars_of(left), ego_mps2=left.ego_mps2, others_mps2=_braked(left)
        ),
        **_cut_in_margin(left, cars, time_s),
    }
    clear_m = np.where(arrived.collided, 0.0, margins.clearance(config, cars))
    each = Each(cars.gap_m, cars.aside_m, moved.speed_mps, heading)
    signals = {
        EGO_X: moved.ego_x_m,
        EGO_SPEED: moved.ego_mps,
        EGO_ACCELERATION: left.ego_mps2,
        **{n: v for what, values in zip(OF_EACH, each, strict=True)
           for n, v in by_car(what, left.cars, values).items()},
        CLEARANCE: clear_m,
        **{n: np.where(arrived.collided, before[n], values) for n, values in asked_for.items()},
        COLLIDED: arrived.collided.astype(np.float64),
        IMPACT_SPEED: arrived.impact_mps,
    }  # fmt: skip
    return signals, states_ahead, each


def _braked(left: Left) -> FloatArray:
    """The other cars' deceleration, ``[K, N]``: one that stands brakes no more [m/s^2]."""
    return np.minimum(left.others_mps2, left.each.speed_mps / left.config.dt_s)


def _cars_of(left: Left) -> Cars:
    """The cars of the states that the step leaves."""
    each, ego_mps = left.each, left.states.signals[EGO_SPEED]
    return Cars(ego_mps, each.gap_m, each.aside_m, left.along_mps)


def _cut_in_margin(left: Left, cars: Cars, time_s: float) -> Mapping[str, FloatArray]:
    """The regulation's margin, told once, where a car cuts in."""
    if left.config.logical_scenario != "cut-in":
        return {}
    before = left.states.signals[AVOIDABLE_BY]
    margin_s = margins.avoidable_by(cars, begin_s=left.values["cut_in_time"], time_s=time_s)
    was_in, is_in = (
        margins.has_come_in(left.config, aside_m[0])
        for aside_m in (left.each.aside_m, cars.aside_m)
    )
    return {AVOIDABLE_BY: np.where(is_in & ~was_in, margin_s, before)}


def _after_contact(left: Left, moved: Moved) -> _Arrived:
    """With the ego and what it touches first where they touch, at rest."""
    config, before = left.config, left.states.signals
    ego_m, length_m = before[EGO_X], config.car_length_m
    along_m, aside_m = left.each.gap_m + length_m, left.each.aside_m
    x_m = ego_m + along_m
    later_m = moved.x_m - moved.ego_x_m
    share = first_touch(
        (along_m, aside_m), (later_m, moved.y_m), reach_m=(length_m, config.car_width_m)
    )
    had = before[COLLIDED] > 0.0
    first, least = share.argmin(axis=0), share.min(axis=0)
    new = ~had & (least <= 1.0)
    touched = new & (np.arange(len(share))[:, None] == first)
    until = np.where(new, least, 1.0)

    def stopped(begin_m: FloatArray, end_m: FloatArray, stops: BoolArray) -> FloatArray:
        return np.where(stops, begin_m + until * (end_m - begin_m), end_m)

    relative_mps = np.hypot(later_m - along_m, moved.y_m - aside_m) / config.dt_s
    impact_mps = np.take_along_axis(relative_mps, first[None], axis=0)[0]
    return _Arrived(
        moved=Moved(
            ego_x_m=stopped(ego_m, moved.ego_x_m, new),
            ego_mps=np.where(new, 0.0, moved.ego_mps),
            x_m=stopped(x_m, moved.x_m, touched),
            y_m=stopped(aside_m, moved.y_m, touched),
            speed_mps=np.where(touched, 0.0, moved.speed_mps),
        ),
        collided=had | new,
        impact_mps=np.where(new, impact_mps, before[IMPACT_SPEED]),
    )
