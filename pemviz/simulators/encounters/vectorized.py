"""Encounters of a logical scenario for a whole batch of rollouts at once."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.simulators.encounters import margins
from pemviz.simulators.encounters.arrival import Left, Moved, arrive
from pemviz.simulators.encounters.cars import (
    KEPT,
    begun_cars,
    decelerations,
    headings,
    lateral_places,
)
from pemviz.simulators.encounters.ego import Told
from pemviz.simulators.encounters.ghost import GHOST_GAP, ghost_signals
from pemviz.simulators.encounters.margins import Cars
from pemviz.simulators.encounters.measured import displaced
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
    of_cars,
)
from pemviz.simulators.encounters.scenario import LogicalScenario
from pemviz.simulators.encounters.told import nothing_told, told_after
from pemviz.simulators.slots import SeenStates
from pemviz.types import StateBatch

KEPT_START = "start_"
STATES_AHEAD = "states_ahead"


@dataclass(frozen=True)
class VectorizedEncounters(LogicalScenario):
    """Explicit Euler steps of ``pemviz.simulators.encounters``: positions, then speeds."""

    @property
    def name(self) -> str:
        """Back end's name."""
        return "vectorized"

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The states s_0, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: Standard normals ``[N, S]``; ``None``: 0, the medians.
        """
        given = np.zeros((count, self.latents.start)) if start is None else start
        config, values, none = self.config, self.start_values(given), np.zeros(count)
        begun = begun_cars(config, values)
        next_m = lateral_places(config, values, time_s=config.dt_s)
        still = np.zeros_like(begun.gap_m)
        heading = headings(begun.aside_m, next_m, begun.speed_mps, still, config.dt_s)
        ego_mps = values["ego_speed"]
        cars = Cars(ego_mps, begun.gap_m, begun.aside_m, begun.speed_mps * np.cos(heading))
        states_ahead = margins.nearest_ahead(config, cars).astype(np.int64)
        found = {
            EGO_X: none,
            EGO_SPEED: ego_mps,
            EGO_ACCELERATION: none,
            CLEARANCE: margins.clearance(config, cars),
            SAFE_DISTANCE: margins.settled_distance(config, cars, states_ahead),
            NEEDLESS: none,
            AVOIDABLE_BY: np.full(count, margins.UNAVOIDABLE_S),
            COLLIDED: none,
            IMPACT_SPEED: none,
        }
        each = (begun.gap_m, begun.aside_m, begun.speed_mps, heading)
        for what, of_each in zip(OF_EACH, each, strict=True):
            found |= by_car(what, self.cars, of_each)
        if self.has_ghost:
            found |= ghost_signals(values[GHOST_GAP], none)
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={signal.name: found[signal.name] for signal in self.signals},
            memory={
                **{f"{KEPT_START}{name}": values[name] for name in self._kept},
                **by_car(STATES_AHEAD, self.cars, states_ahead),
                **nothing_told(self.tracker, self.told_of, count),
                **self.noise_begun(given),
            },
        )

    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The next states, for outcomes ``[N, K]`` and, with errors, noise ``[N, 2 K]``."""
        config, memory, signals = self.config, states.memory, states.signals
        hits = (np.asarray(detected) & self.sight_at(states).present).T
        noises = {} if self.measured is None else self.measured.renewed(states, noise)
        every = Each.of(self.told_of, signals)
        along_mps = every.speed_mps * np.cos(every.heading_rad)
        true = Told(hits, every.gap_m, every.aside_m, signals[EGO_SPEED] - along_mps)
        measured = self._measured(states, noises, true)
        told, remembered = told_after(self.tracker, self.told_of, memory, measured)
        values = {name: memory[f"{KEPT_START}{name}"] for name in self._kept}
        time_s, others = float(states.step) * config.dt_s, len(self.cars)
        left = Left(
            config=config,
            cars=self.cars,
            states=states,
            each=every.first(others),
            along_mps=along_mps[:others],
            values=values,
            told=told,
            others_mps2=decelerations(config, values, time_s=time_s),
            states_ahead=of_cars(STATES_AHEAD, self.cars, memory),
        )
        arrived, states_ahead, each = arrive(*self._driven(left))
        if self.has_ghost:
            arrived = {**arrived, **ghost_signals(values[GHOST_GAP], arrived[EGO_X])}
        kept = {name: values for name, values in memory.items() if name.startswith(KEPT_START)}
        ahead = by_car(STATES_AHEAD, self.cars, states_ahead)
        return SeenStates(
            step=states.step + 1,
            signals={signal.name: arrived[signal.name] for signal in self.signals},
            memory={**kept, **ahead, **remembered, **noises},
            sight=self.sight_of(each, arrived),
        )

    @property
    def _kept(self) -> tuple[str, ...]:
        """Start values that steps need."""
        own = KEPT[self.config.logical_scenario]
        return (*own, GHOST_GAP) if self.has_ghost else own

    def _measured(self, states: StateBatch, noises: Mapping[str, AnyArray], true: Told) -> Told:
        """What perception measures of what it reports, ``[K, N]``, instead of what is true."""
        if self.measured is None:
            return true
        errors_m = self.measured.errors_m(self.sight_at(states).salient, noises)
        off_m = np.moveaxis(errors_m, 1, 0)
        gap_m, aside_m = displaced(self.config, true.gap_m, true.aside_m, off_m)
        return replace(true, gap_m=gap_m, aside_m=aside_m)

    def _driven(self, left: Left) -> tuple[Left, Moved]:
        """What is done in the step, and where all cars then are if none touches another."""
        dt_s, signals = self.config.dt_s, left.states.signals
        gap_m, aside_m, speed_mps, heading_rad = left.each
        ego_m, ego_mps = signals[EGO_X], signals[EGO_SPEED]
        x_m = ego_m + gap_m + self.config.car_length_m
        return left, Moved(
            ego_x_m=ego_m + ego_mps * dt_s,
            ego_mps=(ego_mps + left.ego_mps2 * dt_s).clip(0.0),
            x_m=x_m + left.along_mps * dt_s,
            y_m=aside_m + speed_mps * np.sin(heading_rad) * dt_s,
            speed_mps=(speed_mps - left.others_mps2 * dt_s).clip(0.0),
        )
