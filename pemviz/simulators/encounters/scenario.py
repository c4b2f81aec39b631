"""What encounters of a logical scenario are, all but how they begin and step.

And what a proposal sees of their states, in the turn of each slot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pemviz.arrays import AnyArray, BoolArray, FloatArray
from pemviz.config import EncounterConfig, StartChoice
from pemviz.config.distribution_text import Distribution, read_distribution
from pemviz.config.encounters import start_values
from pemviz.config.tracker_text import NO_TRACKER
from pemviz.latents import NO_LATENTS, LatentCounts
from pemviz.simulators.encounters import ego
from pemviz.simulators.encounters.cars import START_PLANES, car_names
from pemviz.simulators.encounters.encounter_signals import (
    ASIDE,
    COLLIDED,
    EGO_SPEED,
    EGO_X,
    FALSE_POSITIVE,
    GAP,
    HEADING,
    OF_EACH,
    SPEED,
    CarStates,
    encounter_signals,
)
from pemviz.simulators.encounters.sight import EncounterSight, FalsePositiveReports
from pemviz.simulators.measurement_errors import MeasurementNoise, PositionErrors
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import SIGHT, Slot, UnrolledSimulator
from pemviz.simulators.tracking.tracker import Tracker, scene_tracks, tracker_of_text
from pemviz.types import Signal, StateBatch

TITLES = {
    "lead": "lead car",
    "cutting_in": "car that cuts in",
    "revealed": "revealed car",
    "neighbour": "neighbour",
    FALSE_POSITIVE: "ghost",
}
"""Names of slots."""
ERROR_KINDS = ("range", "cross_range")
"""Of places, in the order of a slot's latents."""
NEVER_NEGATIVE = ("ego_speed", "revealed_speed", "deceleration")
"""Start values of which no distribution brings one below 0."""
FASTEST_ASIDE_MPS = 5.0
"""No car changes lanes faster."""
FARTHEST_ASIDE_M = 2.0
"""What is farther beside the path than this is not taken to be measured in it."""
FARTHEST_M = 80.0
"""Proposals tell gaps apart up to here."""


@dataclass(frozen=True)
class LogicalScenario:
    """Encounters of a logical scenario, but for how they begin and step.

    Attributes:
        config: The encounters' parameters.
        chosen: Start values with other distributions than the logical scenario's.
        tracker_text: The tracker between perception and controller.
        errors: Of measured places; ``None``: there are none.
    """

    config: EncounterConfig
    chosen: tuple[StartChoice, ...] = ()
    tracker_text: str = NO_TRACKER
    errors: PositionErrors | None = None

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
        """Names of the other cars, in the order of their slots."""
        return car_names(self.config)

    @cached_property
    def reported_names(self) -> tuple[str, ...]:
        """Names of what perception may report, a slot each: the cars, and a ghost last."""
        return (*self.cars, FALSE_POSITIVE) if self.has_false_positive else self.cars

    @property
    def has_false_positive(self) -> bool:
        """Whether there is a place where a ghost may appear."""
        return self.config.ghost_probability > 0.0

    @property
    def slot_models(self) -> Mapping[str, FalsePositiveReports]:
        """How likely the ghost is reported, by its slot's name; nothing without one."""
        if not self.has_false_positive:
            return {}
        return {TITLES[FALSE_POSITIVE]: FalsePositiveReports(self.config.ghost_probability)}

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The ego's, each other car's, and what rules ask for."""
        return self._signals

    @cached_property
    def _signals(self) -> tuple[Signal, ...]:
        return encounter_signals(self.config, self.reported_names)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """One for each other car, then the ghost's."""
        return self._slots

    @cached_property
    def _slots(self) -> tuple[Slot, ...]:
        return tuple(
            Slot(TITLES[name], name != FALSE_POSITIVE, tuple(f"{what}_{name}" for what in OF_EACH))
            for name in self.reported_names
        )

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
        """One at the start for each start value that is not fixed, then those of errors."""
        errors = NO_LATENTS if self.noise is None else self.noise.latents
        return LatentCounts(start=self.random_values + errors.start, noise=errors.noise)

    @cached_property
    def random_values(self) -> int:
        """How many start values are not fixed."""
        return sum(not one.fixed for one in self.distributions.values())

    @cached_property
    def noise(self) -> MeasurementNoise | None:
        """Of the errors of measured places; ``None`` without any."""
        if self.errors is None:
            return None
        kinds = dict(zip(ERROR_KINDS, self.errors.axes, strict=False))
        return MeasurementNoise(
            {
                f"{kind}_{name}": kinds[kind].memory
                for name in self.reported_names
                for kind in kinds
            },
            self.config.dt_s,
        )

    def noise_begun(self, given: FloatArray) -> dict[str, AnyArray]:
        """What states remember of errors' noise at the start, for latents ``[N, S]``."""
        if self.noise is None:
            return {}
        return self.noise.begin(len(given), given[:, self.random_values :])

    def errors_m(self, salient: FloatArray, memory: Mapping[str, AnyArray]) -> FloatArray:
        """Measured minus true, along the line of sight and across it, ``[N, K, 2]`` [m].

        Args:
            salient: Of the slots, ``[N, K, 11]``.
            memory: With the step's noise.
        """
        assert self.errors is not None  # noqa: S101  asked for with errors alone
        assert self.noise is not None  # noqa: S101
        kinds = len(ERROR_KINDS)
        noise = np.zeros((*salient.shape[:-1], len(self.errors.axes)))
        for place, own in enumerate(self.noise.values(memory)):
            noise[:, place // kinds, place % kinds] = own
        flat = self.errors.error(
            salient.reshape(-1, salient.shape[-1]), noise.reshape(-1, noise.shape[-1])
        )
        return flat.reshape(noise.shape)[..., :kinds]

    def measurement_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Errors of measured places at each step ``[T-1]`` of a rollout ``[T]`` [m]."""
        if self.errors is None:
            return {}
        sight = self.sight({name: values[:-1] for name, values in signals.items()})
        after = {name: values[1:] for name, values in memory.items()}
        errors_m = self.errors_m(sight.salient, after)
        errors_m = np.where(sight.present[..., None], errors_m, np.nan)
        return {
            f"{slot.name}, {direction}": errors_m[:, place, axis]
            for place, slot in enumerate(self.slots)
            for axis, direction in enumerate(("along the line of sight", "across it"))
        }

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
        return START_PLANES[self.config.logical_scenario]

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Latents ``[N, S]`` to start values ``[N]`` by name."""
        columns = iter(np.asarray(start).T)
        values = {
            name: one.of(np.zeros(len(start)) if one.fixed else next(columns))
            for name, one in self.distributions.items()
        }
        least = dict.fromkeys(NEVER_NEGATIVE, 0.0) | {"duration": self.config.dt_s}
        return {name: one.clip(least.get(name, -np.inf)) for name, one in values.items()}

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The slots' salient variables ``[..., K, 11]``."""
        return self.sight(signals).salient

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[..., K]``."""
        return self.sight(signals).present

    def sight(self, signals: Mapping[str, FloatArray]) -> EncounterSight:
        """Both at once, for signals ``[...]``."""
        return self.sight_of(CarStates.of(self.cars, signals), signals)

    def sight_of(self, each: CarStates, signals: Mapping[str, FloatArray]) -> EncounterSight:
        """The same, of whose other cars the places are put together already."""
        own = np.asarray(signals[f"{GAP}_{FALSE_POSITIVE}"]) if self.has_false_positive else None
        return EncounterSight(self.config, each, own)

    def sight_at(self, states: StateBatch) -> EncounterSight:
        """The same, at states that may know it already."""
        known = states.beside.get(SIGHT)
        return known if isinstance(known, EncounterSight) else self.sight(states.signals)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the ego might do otherwise for each outcome, at once or later, ``[..., K]``.

        Without a tracker: the car is in the path, and to keep a gap to it slows the ego down. With
        errors: it is not too far beside the path to be measured in it.
        """
        each = [self.reacts_in(slot, signals) for slot in range(len(self.reported_names))]
        return np.stack(each, axis=-1)

    def reacts_in(self, slot: int, signals: Mapping[str, FloatArray]) -> BoolArray:
        """The same of one slot, ``[...]``."""
        config, name = self.config, self.reported_names[slot]
        free, aside_m = signals[COLLIDED] == 0.0, signals[f"{ASIDE}_{name}"]
        if self.tracker is not None or self.errors is not None:
            return ego.is_beside(config, aside_m, wider_m=self._wider_m[slot]) & free
        gap_m, ego_mps = signals[f"{GAP}_{name}"], signals[EGO_SPEED]
        closing_mps = ego_mps - signals[f"{SPEED}_{name}"] * np.cos(signals[f"{HEADING}_{name}"])
        follow = ego.follow_acceleration(config, gap_m, closing_mps, ego_mps)
        slows = (follow < config.maximum_acceleration_mps2) | ego.is_urgent(
            config, gap_m, closing_mps
        )
        return ego.in_path(config, gap_m, aside_m) & slows & free

    @cached_property
    def _wider_m(self) -> FloatArray:
        """How far beside the path what is reported may matter, with tracker or errors, ``[K]``."""
        known_s = 0.0
        if self.tracker is not None:
            known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * self.config.dt_s
        moves = np.array([name == self.cars[0] for name in self.reported_names])
        moves &= self.config.logical_scenario != "braking"
        wider_m = np.where(moves, FASTEST_ASIDE_MPS * known_s, 0.0)
        return wider_m + (0.0 if self.errors is None else FARTHEST_ASIDE_M)

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The ego and the other cars, all of one size."""
        size = (self.config.car_length_m, self.config.car_width_m, self.config.car_height_m)
        others = (SceneCar(TITLES[car], *size, slot=TITLES[car]) for car in self.cars)
        return (SceneCar("ego", *size), *others)

    @property
    def road(self) -> Road:
        """Three lanes, the ego's in the middle."""
        return Road(tuple(self.config.lane_width_m * place for place in (-1.5, -0.5, 0.5, 1.5)))

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Where the cars are in states with signals ``[...]``."""
        ego_m, ego_mps = np.asarray(signals[EGO_X]), np.asarray(signals[EGO_SPEED])
        others, none = CarStates.of(self.cars, signals), np.zeros_like(ego_m)

        def together(own: FloatArray, of_others: FloatArray) -> FloatArray:
            return np.moveaxis(np.concatenate([own[None], of_others]), 0, -1)

        x_m = together(ego_m, ego_m + (others.gap_m + self.config.car_length_m))
        return SceneStates(
            x_m=x_m,
            y_m=together(none, others.aside_m),
            heading_rad=together(none, others.heading_rad),
            speed_mps=together(ego_mps, others.speed_mps),
            present=np.ones(x_m.shape, dtype=np.bool_),
            collided=np.asarray(signals[COLLIDED]) > 0.0,
        )

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        """Where the controller believes cars to be, from the tracks in states ``[...]``."""
        ego_m, length_m = states.signals[EGO_X], self.config.car_length_m
        count = len(self.reported_names)
        return scene_tracks(self.tracker, states, slots=count, ego_m=ego_m, length_m=length_m)


@dataclass(frozen=True)
class EncounterFeatures:
    """The slot's gap, offset and closing speed, time, its number; its track, if there is one.

    Attributes:
        unrolled: The encounter in single outcomes.
        scenario: The encounter.
    """

    unrolled: UnrolledSimulator
    scenario: LogicalScenario

    def values(self, states: StateBatch) -> FloatArray:
        """Numbers ``[..., D]``."""
        signals, slot = states.signals, self.unrolled.slot_of(states.signals)
        turn, names = self.unrolled.turn_at(states), self._in_turn(states)
        cars = CarStates.of(names, signals)
        of_all = [
            cars.gap_m.clip(-FARTHEST_M, FARTHEST_M),
            np.abs(cars.aside_m),
            signals[EGO_SPEED] - cars.along_mps,
        ]
        tracker = self.scenario.tracker
        if tracker is not None:
            every = tracker.numbers(tracker.state(states.memory, slots=self.unrolled.turns))[:2]
            own = [np.moveaxis(one, -1, 0) for one in every]
            of_all += own if turn is None else [one[turn : turn + 1] for one in own]
        if turn is None:
            columns = [np.take_along_axis(one, slot[None], axis=0)[0] for one in of_all]
        else:
            columns = [one[0] for one in of_all]
        time_s = np.asarray(states.step // self.unrolled.turns) * self.scenario.dt_s
        columns.append(np.broadcast_to(time_s, slot.shape))
        if self.unrolled.turns > 1:
            columns.append(slot.astype(np.float64))
        return np.stack(columns, axis=-1)

    def reacts(self, states: StateBatch) -> BoolArray:
        """Where the ego might do otherwise for the slot's outcome, ``[...]``."""
        return self.unrolled.reacts_at(states)

    def reacts_within(self, states: StateBatch, *, steps: int) -> BoolArray:
        """Where it might, or would a few steps on if all cars went on as they are, ``[...]``."""
        signals, found = states.signals, self.reacts(states)
        for share in (0.5, 1.0):
            later_s, moved = share * steps * self.scenario.dt_s, dict(signals)
            for car in self._in_turn(states):
                speed_mps, heading_rad = signals[f"{SPEED}_{car}"], signals[f"{HEADING}_{car}"]
                closing_mps = signals[EGO_SPEED] - speed_mps * np.cos(heading_rad)
                moved[f"{GAP}_{car}"] = signals[f"{GAP}_{car}"] - closing_mps * later_s
                aside_mps = speed_mps * np.sin(heading_rad)
                moved[f"{ASIDE}_{car}"] = signals[f"{ASIDE}_{car}"] + aside_mps * later_s
            found = found | self.reacts(StateBatch(states.step, moved, states.memory))
        return found

    def _in_turn(self, states: StateBatch) -> Sequence[str]:
        """What the slots in turn are about: one, or all if the states differ in that."""
        turn, names = self.unrolled.turn_at(states), self.scenario.reported_names
        return names if turn is None else names[turn : turn + 1]
