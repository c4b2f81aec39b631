"""What all back ends of the families share: all but how cars are moved over a step."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.config.distribution_text import Distribution, read_distribution
from pemviz.config.encounters import start_values
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.latents import LatentCounts
from pemviz.simulators.families import ego, margins
from pemviz.simulators.families.arrival import Left, Moved, arrive
from pemviz.simulators.families.cars import (
    KEPT,
    START_PLANES,
    begun_cars,
    car_names,
    changes_lane,
    decelerations,
    headings,
    lateral_places,
)
from pemviz.simulators.families.drawing import encounter_cars, lanes, scene_states, scene_tracks
from pemviz.simulators.families.ego import Told
from pemviz.simulators.families.margins import Cars
from pemviz.simulators.families.names import (
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
    by_car,
    encounter_signals,
    of_cars,
    slot_signals,
    slot_title,
)
from pemviz.simulators.families.sight import salient, seen
from pemviz.simulators.families.told import nothing_told, told_after
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot
from pemviz.simulators.tracking.named import tracker_of_text
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import Signal, StateBatch

KEPT_START = "start_"
STATES_AHEAD = "states_ahead"


@dataclass(frozen=True)
class FamilyScenario:
    """Encounters of a family; a back end adds ``name`` and :meth:`moved_cars`.

    Attributes:
        config: The encounters' parameters.
        chosen: Start values with other distributions than the family's.
        tracker_text: The tracker between perception and controller.
    """

    config: EncounterConfig
    chosen: tuple[StartChoice, ...] = ()
    tracker_text: str = NO_TRACKER

    @property
    def states(self) -> int:
        """States in a rollout."""
        return self.config.states

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.config.dt_s

    @cached_property
    def cars(self) -> tuple[str, ...]:
        """Names of the K other cars, in the order of their slots."""
        return car_names(self.config)

    @property
    def name(self) -> str:
        """Back end's name: its own."""
        raise NotImplementedError

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The ego's, each other car's, and what rules ask for."""
        return self._signals

    @cached_property
    def _signals(self) -> tuple[Signal, ...]:
        return encounter_signals(self.config, self.cars)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """One for each other car."""
        return self._slots

    @cached_property
    def _slots(self) -> tuple[Slot, ...]:
        return tuple(Slot(slot_title(name), signals=slot_signals(name)) for name in self.cars)

    @cached_property
    def tracker(self) -> Tracker | None:
        """Between perception and controller; ``None``: the ego reacts to single detections."""
        return tracker_of_text(self.tracker_text, dt_s=self.config.dt_s, axes=2)

    @cached_property
    def distributions(self) -> Mapping[str, Distribution]:
        """Of the start values, by name."""
        texts = {value.name: value.distribution for value in start_values(self.config)}
        texts |= {choice.name: choice.distribution for choice in self.chosen}
        return {name: read_distribution(text, name=f"start.{name}") for name, text in texts.items()}

    @property
    def latents(self) -> LatentCounts:
        """One at the start for each start value that is not fixed."""
        return LatentCounts(start=sum(not one.fixed for one in self.distributions.values()))

    @property
    def starts(self) -> tuple[Signal, ...]:
        """The start values."""
        return tuple(
            Signal(name=value.name, key=value.key, unit=value.unit, low=value.low, high=value.high)
            for value in start_values(self.config)
        )

    @property
    def start_plane(self) -> tuple[str, str]:
        """The two that together tell most of the danger."""
        return START_PLANES[self.config.family]

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Latents ``[N, S]`` to start values ``[N]`` by name."""
        columns = iter(np.asarray(start).T)
        values = {
            name: one.of(np.zeros(len(start)) if one.fixed else next(columns))
            for name, one in self.distributions.items()
        }
        least = dict.fromkeys(NEVER_NEGATIVE, 0.0) | {"duration": self.config.dt_s}
        return {name: one.clip(least.get(name, -np.inf)) for name, one in values.items()}

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
        return StateBatch(
            step=np.zeros((), dtype=np.int64),
            signals={signal.name: found[signal.name] for signal in self.signals},
            memory={
                **{f"{KEPT_START}{name}": values[name] for name in KEPT[config.family]},
                **by_car(STATES_AHEAD, self.cars, states_ahead),
                **nothing_told(self.tracker, self.cars, count),
            },
        )

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """The next states, given perception's outcomes ``[N, K]``."""
        config, memory, signals = self.config, states.memory, states.signals
        hits = (np.asarray(detected) & self.present(signals)).T
        told, remembered = told_after(self.tracker, self.cars, memory, hits, self._measured(states))
        values = {name: memory[f"{KEPT_START}{name}"] for name in KEPT[config.family]}
        wanted_mps2 = ego.acceleration(
            config, told, ego_mps=signals[EGO_SPEED], set_mps=values["ego_speed"]
        )
        time_s = float(states.step) * config.dt_s
        left = Left(
            config=config,
            cars=self.cars,
            states=states,
            values=values,
            ego_mps2=np.where(signals[COLLIDED] > 0.0, 0.0, wanted_mps2),
            others_mps2=decelerations(config, values, time_s=time_s),
            states_ahead=of_cars(STATES_AHEAD, self.cars, memory),
        )
        arrived, states_ahead = arrive(left, self.moved_cars(left))
        kept = {name: values for name, values in memory.items() if name.startswith(KEPT_START)}
        return StateBatch(
            step=states.step + 1,
            signals=arrived,
            memory={**kept, **by_car(STATES_AHEAD, self.cars, states_ahead), **remembered},
        )

    def moved_cars(self, left: Left) -> Moved:
        """Where all cars are a step on if none touches another: a back end's own."""
        raise NotImplementedError

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The other cars' salient variables ``[..., K, 11]``."""
        gap_m, aside_m, _, heading_rad = self._of_each(signals)
        found = salient(self.config, seen(self.config, gap_m, aside_m), heading_rad)
        return np.moveaxis(found, 0, -2)

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether each is to be seen, ``[..., K]``."""
        gap_m, aside_m, _, _ = self._of_each(signals)
        return np.moveaxis(seen(self.config, gap_m, aside_m).present, 0, -1)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the ego might do otherwise for each outcome, at once or later, ``[..., K]``.

        Without a tracker: the car is in the path, and to keep a gap to it slows the ego down.
        """
        config = self.config
        gap_m, aside_m, speed_mps, heading_rad = self._of_each(signals)
        free = signals[COLLIDED] == 0.0
        if self.tracker is not None:
            known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * config.dt_s
            wider_m = np.where(changes_lane(config), FASTEST_ASIDE_MPS * known_s, 0.0)
            near = ego.is_beside(config, np.moveaxis(aside_m, 0, -1), wider_m=wider_m)
            return near & free[..., None]
        ego_mps = signals[EGO_SPEED]
        closing_mps = ego_mps - speed_mps * np.cos(heading_rad)
        follow = ego.follow_acceleration(config, gap_m, closing_mps, ego_mps)
        slows = (follow < config.maximum_acceleration_mps2) | ego.is_urgent(
            config, gap_m, closing_mps
        )
        return np.moveaxis(ego.in_path(config, gap_m, aside_m) & slows & free, 0, -1)

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The ego and the other cars."""
        return encounter_cars(self.config, self.cars)

    @property
    def road(self) -> Road:
        """Three lanes."""
        return lanes(self.config)

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Where the cars are in states with signals ``[...]``."""
        return scene_states(self.config, self.cars, signals)

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        """Where the controller believes cars to be, from the tracks in states ``[...]``."""
        return scene_tracks(self.config, self.cars, self.tracker, states)

    def _measured(self, states: StateBatch) -> Told:
        """What perception measures of each car that it reports, ``[K, N]``."""
        gap_m, aside_m, speed_mps, heading_rad = self._of_each(states.signals)
        closing_mps = states.signals[EGO_SPEED] - speed_mps * np.cos(heading_rad)
        return Told(np.ones(gap_m.shape, dtype=np.bool_), gap_m, aside_m, closing_mps)

    def _of_each(
        self, signals: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Gaps, offsets, speeds and headings of the other cars, ``[K, ...]`` each."""
        gap_m, aside_m, speed_mps, heading_rad = (
            of_cars(what, self.cars, signals) for what in OF_EACH
        )
        return gap_m, aside_m, speed_mps, heading_rad


NEVER_NEGATIVE = ("ego_speed", "revealed_speed", "deceleration")
"""Start values of which no distribution brings one below 0."""
FASTEST_ASIDE_MPS = 5.0
"""No car changes lanes faster."""
