"""Encounters of a logical scenario for a whole batch of rollouts at once.

Arrays have a row for each other car, ``[K, N]``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray, IntArray
from pemviz.config import EncounterConfig
from pemviz.simulators.encounters import ego
from pemviz.simulators.encounters import encounter_signals as es
from pemviz.simulators.encounters.cars import (
    KEPT,
    Values,
    begun_cars,
    decelerations,
    headings,
    lateral_places,
)
from pemviz.simulators.encounters.encounter_signals import CarStates
from pemviz.simulators.encounters.scenario import LogicalScenario
from pemviz.simulators.encounters.sight import FALSE_POSITIVE_GAP, displaced, false_positive_signals
from pemviz.simulators.slots import SIGHT
from pemviz.types import StateBatch

KEPT_START = "start_"
STATES_AHEAD = "states_ahead"


@dataclass(frozen=True)
class Left:
    """The states ``[N]`` that a step leaves, and what is done in it.

    Attributes:
        states: The states.
        cars: Where the K other cars are.
        values: Start values that steps need, ``[N]``.
        ego_mps2: The ego's acceleration ``[N]`` [m/s^2].
        others_mps2: The other cars' deceleration ``[K, N]`` [m/s^2].
    """

    states: StateBatch
    cars: CarStates
    values: Values
    ego_mps2: FloatArray
    others_mps2: FloatArray


@dataclass(frozen=True)
class Moved:
    """Where cars are after a whole step in which none touches another, ``[N]`` and ``[K, N]``."""

    ego_x_m: FloatArray
    ego_mps: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    speed_mps: FloatArray


@dataclass(frozen=True)
class VectorizedEncounters(LogicalScenario):
    """Explicit Euler steps of ``pemviz.simulators.encounters``: positions, then speeds.

    A back end in which something else moves the cars has another ``name`` and ``_driven``.
    """

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The states s_0, arrays ``[count]``, for standard normals ``[count, S]`` or medians."""
        given = np.zeros((count, self.latents.start)) if start is None else start
        config, values, none = self.config, self.start_values(given), np.zeros(count)
        gap_m, aside_m, speed_mps = begun_cars(config, values)
        next_m = lateral_places(config, values, time_s=config.dt_s)
        heading = headings(aside_m, next_m, speed_mps, np.zeros_like(gap_m), config.dt_s)
        cars, ego_mps = CarStates(gap_m, aside_m, speed_mps, heading), values["ego_speed"]
        states_ahead = es.nearest_ahead(config, cars).astype(np.int64)
        found = {
            es.EGO_X: none,
            es.EGO_SPEED: ego_mps,
            es.EGO_ACCELERATION: none,
            es.CLEARANCE: es.clearance(config, cars),
            es.SAFE_DISTANCE: es.settled_distance(config, cars, ego_mps, states_ahead),
            es.NEEDLESS: none,
            es.AVOIDABLE_BY: np.full(count, es.UNAVOIDABLE_S),
            es.COLLIDED: none,
            es.IMPACT_SPEED: none,
            **cars.signals(self.cars),
        }
        kept = {name: values[name] for name in KEPT[config.logical_scenario]}
        if self.has_false_positive:
            kept[FALSE_POSITIVE_GAP] = values[FALSE_POSITIVE_GAP]
            found |= false_positive_signals(values[FALSE_POSITIVE_GAP], none)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={signal.name: found[signal.name] for signal in self.signals},
            memory={
                **{f"{KEPT_START}{name}": own for name, own in kept.items()},
                **es.by_car(STATES_AHEAD, self.cars, states_ahead),
                **ego.nothing_reported(self.tracker, self.reported_names, count),
                **self.noise_begun(given),
            },
        )

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The next states, for outcomes ``[N, K]`` and, with errors, noise ``[N, 2 K]``."""
        config, memory, signals = self.config, states.memory, states.signals
        every, ego_mps = CarStates.of(self.reported_names, signals), signals[es.EGO_SPEED]
        noises = {} if self.noise is None else self.noise.renewed(states, noise)
        measured = self._measured(states, every, detected, noises)
        reported, remembered = ego.reported_after(
            self.tracker, self.reported_names, memory, measured
        )
        kept = {name: own for name, own in memory.items() if name.startswith(KEPT_START)}
        values = {name.removeprefix(KEPT_START): own for name, own in kept.items()}
        wanted_mps2 = ego.acceleration(
            config, reported, ego_mps=ego_mps, set_mps=values["ego_speed"]
        )
        left, moved = self._driven(
            Left(
                states=states,
                cars=every.first(len(self.cars)),
                values=values,
                ego_mps2=np.where(signals[es.COLLIDED] > 0.0, 0.0, wanted_mps2),
                others_mps2=decelerations(config, values, time_s=float(states.step) * config.dt_s),
            )
        )
        found, cars, states_ahead = self._arrived(left, moved)
        if self.has_false_positive:
            found |= false_positive_signals(values[FALSE_POSITIVE_GAP], found[es.EGO_X])
        ahead = es.by_car(STATES_AHEAD, self.cars, states_ahead)
        return StateBatch(
            step=states.step + 1,
            signals={signal.name: found[signal.name] for signal in self.signals},
            memory={**kept, **ahead, **remembered, **noises},
            beside={SIGHT: self.sight_of(cars, found)},
        )

    def _measured(
        self,
        states: StateBatch,
        every: CarStates,
        detected: BoolArray,
        noises: Mapping[str, AnyArray],
    ) -> ego.Reported:
        """What perception reports, and what it measures of that."""
        sight, gap_m, aside_m = self.sight_at(states), every.gap_m, every.aside_m
        if noises:
            errors_m = np.moveaxis(self.errors_m(sight.salient, noises), 1, 0)
            gap_m, aside_m = displaced(self.config, gap_m, aside_m, errors_m)
        hits = (np.asarray(detected) & sight.present).T
        return ego.Reported(hits, gap_m, aside_m, states.signals[es.EGO_SPEED] - every.along_mps)

    def _driven(self, left: Left) -> tuple[Left, Moved]:
        """What is done in the step, and where all cars then are if none touches another."""
        dt_s, signals, cars = self.config.dt_s, left.states.signals, left.cars
        ego_m, ego_mps = signals[es.EGO_X], signals[es.EGO_SPEED]
        x_m = ego_m + cars.gap_m + self.config.car_length_m
        return left, Moved(
            ego_x_m=ego_m + ego_mps * dt_s,
            ego_mps=(ego_mps + left.ego_mps2 * dt_s).clip(0.0),
            x_m=x_m + cars.along_mps * dt_s,
            y_m=cars.aside_m + cars.speed_mps * np.sin(cars.heading_rad) * dt_s,
            speed_mps=(cars.speed_mps - left.others_mps2 * dt_s).clip(0.0),
        )

    def _arrived(
        self, left: Left, moved: Moved
    ) -> tuple[dict[str, FloatArray], CarStates, IntArray]:
        """Signals of the next states, where the other cars are, states ahead ``[K, N]``."""
        config, before, cars = self.config, left.states.signals, left.cars
        moved, collided, impact_mps = _after_contact(config, left, moved)
        time_s = float(left.states.step + 1) * config.dt_s
        next_m = lateral_places(config, left.values, time_s=time_s + config.dt_s)
        heading = headings(moved.y_m, next_m, moved.speed_mps, cars.heading_rad, config.dt_s)
        gap_m = moved.x_m - moved.ego_x_m - config.car_length_m
        after = CarStates(gap_m, moved.y_m, moved.speed_mps, heading)
        nearest = es.nearest_ahead(config, after)
        ahead_before = es.of_cars(STATES_AHEAD, self.cars, left.states.memory)
        states_ahead = np.where(nearest, ahead_before + 1, 0)
        # one that stands brakes no more
        braked_mps2 = np.minimum(left.others_mps2, cars.speed_mps / config.dt_s)
        assessed = {
            es.SAFE_DISTANCE: es.settled_distance(config, after, moved.ego_mps, states_ahead),
            es.NEEDLESS: es.needless_deceleration(
                config,
                cars,
                before[es.EGO_SPEED],
                ego_mps2=left.ego_mps2,
                others_mps2=braked_mps2,
            ),
        }
        if config.logical_scenario == "cut-in":
            begin_s = left.values["cut_in_time"]
            margin_s = es.avoidable_by(after, moved.ego_mps, begin_s=begin_s, time_s=time_s)
            was_in, is_in = (es.has_come_in(config, one.aside_m[0]) for one in (cars, after))
            margin_s = np.where(is_in & ~was_in, margin_s, before[es.AVOIDABLE_BY])
            assessed[es.AVOIDABLE_BY] = margin_s
        signals = {
            es.EGO_X: moved.ego_x_m,
            es.EGO_SPEED: moved.ego_mps,
            es.EGO_ACCELERATION: left.ego_mps2,
            **after.signals(self.cars),
            es.CLEARANCE: np.where(collided, 0.0, es.clearance(config, after)),
            **{name: np.where(collided, before[name], own) for name, own in assessed.items()},
            es.COLLIDED: collided.astype(np.float64),
            es.IMPACT_SPEED: impact_mps,
        }
        return signals, after, states_ahead


def _after_contact(
    config: EncounterConfig, left: Left, moved: Moved
) -> tuple[Moved, BoolArray, FloatArray]:
    """With the ego and what it touches first where they touch, at rest.

    Returns:
        Where cars are, whether the ego has touched one ``[N]``, and its impact speed ``[N]``.
    """
    before, length_m = left.states.signals, config.car_length_m
    ego_m, along_m, aside_m = before[es.EGO_X], left.cars.gap_m + length_m, left.cars.aside_m
    later_m = moved.x_m - moved.ego_x_m
    reach_m = (length_m, config.car_width_m)
    share = first_touch((along_m, aside_m), (later_m, moved.y_m), reach_m=reach_m)
    had = before[es.COLLIDED] > 0.0
    first, least = share.argmin(axis=0), share.min(axis=0)
    new = ~had & (least <= 1.0)
    touched = new & (np.arange(len(share))[:, None] == first)
    until = np.where(new, least, 1.0)

    def stopped(begin_m: FloatArray, end_m: FloatArray, stops: BoolArray) -> FloatArray:
        return np.where(stops, begin_m + until * (end_m - begin_m), end_m)

    relative_mps = np.hypot(later_m - along_m, moved.y_m - aside_m) / config.dt_s
    impact_mps = np.take_along_axis(relative_mps, first[None], axis=0)[0]
    stood = Moved(
        ego_x_m=stopped(ego_m, moved.ego_x_m, new),
        ego_mps=np.where(new, 0.0, moved.ego_mps),
        x_m=stopped(ego_m + along_m, moved.x_m, touched),
        y_m=stopped(aside_m, moved.y_m, touched),
        speed_mps=np.where(touched, 0.0, moved.speed_mps),
    )
    return stood, had | new, np.where(new, impact_mps, before[es.IMPACT_SPEED])


def first_touch(
    before_m: tuple[FloatArray, FloatArray],
    after_m: tuple[FloatArray, FloatArray],
    *,
    reach_m: tuple[float, float],
) -> FloatArray:
    """The least share of a step, from 0 to 1, at which centres are within reach; else infinity.

    Distances between centres, along the road and across ``[...]`` each [m], change linearly.
    """
    enters, leaves = np.zeros_like(before_m[0]), np.ones_like(before_m[0])
    for first, last, reach in zip(before_m, after_m, reach_m, strict=True):
        moved = last - first
        still = moved == 0.0
        speed = np.where(still, 1.0, moved)
        with np.errstate(over="ignore"):  # hardly moved: an end is infinitely far
            ends = np.stack([(-reach - first) / speed, (reach - first) / speed])
        inside = np.abs(first) <= reach
        enters = np.maximum(enters, np.where(still, np.where(inside, 0.0, np.inf), ends.min(0)))
        leaves = np.minimum(leaves, np.where(still, np.where(inside, 1.0, -np.inf), ends.max(0)))
    return np.where(enters <= leaves, enters, np.inf)
