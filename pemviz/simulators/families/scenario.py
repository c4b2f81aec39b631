"""What all back ends of the families share: all but how they begin and step."""

from abc import ABC, abstractmethod
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
from pemviz.simulators.families import ego
from pemviz.simulators.families.cars import (
    START_PLANES,
    car_names,
    changes_lane,
)
from pemviz.simulators.families.drawing import encounter_cars, lanes, scene_states, scene_tracks
from pemviz.simulators.families.ghost import GhostReports, ghost_salient, may_appear
from pemviz.simulators.families.measured import FARTHEST_ASIDE_M, MeasuredPlaces, PlaneErrors
from pemviz.simulators.families.names import (
    COLLIDED,
    EGO_SPEED,
    GAP,
    GHOST,
    OF_EACH,
    encounter_signals,
    of_cars,
    slot_signals,
    slot_title,
)
from pemviz.simulators.families.sight import salient, seen
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot
from pemviz.simulators.tracking.named import tracker_of_text
from pemviz.simulators.tracking.tracker import Tracker
from pemviz.types import Signal, StateBatch


@dataclass(frozen=True)
class FamilyScenario(ABC):
    """Encounters of a family; a back end adds ``name``, ``initial`` and ``step``.

    Attributes:
        config: The encounters' parameters.
        chosen: Start values with other distributions than the family's.
        tracker_text: The tracker between perception and controller.
        errors: Of measured places; ``None``: there are none.
    """

    config: EncounterConfig
    chosen: tuple[StartChoice, ...] = ()
    tracker_text: str = NO_TRACKER
    errors: PlaneErrors | None = None

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
    def told_of(self) -> tuple[str, ...]:
        """Names of what perception may report, a slot each: the cars, and a ghost last."""
        return (*self.cars, GHOST) if self.has_ghost else self.cars

    @property
    def has_ghost(self) -> bool:
        """Whether there is a place where a ghost may appear."""
        return self.config.ghost_probability > 0.0

    @property
    def slot_models(self) -> Mapping[str, GhostReports]:
        """How likely the ghost is reported, by its slot's name; nothing without one."""
        if not self.has_ghost:
            return {}
        return {slot_title(GHOST): GhostReports(self.config.ghost_probability)}

    @property
    @abstractmethod
    def name(self) -> str:
        """Back end's name."""

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The ego's, each other car's, and what rules ask for."""
        return self._signals

    @cached_property
    def _signals(self) -> tuple[Signal, ...]:
        return encounter_signals(self.config, self.told_of)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """One for each other car, then the ghost's."""
        return self._slots

    @cached_property
    def _slots(self) -> tuple[Slot, ...]:
        return tuple(
            Slot(slot_title(name), nominal=name != GHOST, signals=slot_signals(name))
            for name in self.told_of
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
        measured = NO_LATENTS if self.measured is None else self.measured.latents
        return LatentCounts(start=self.random_values + measured.start, noise=measured.noise)

    @cached_property
    def random_values(self) -> int:
        """How many start values are not fixed."""
        return sum(not one.fixed for one in self.distributions.values())

    @cached_property
    def measured(self) -> MeasuredPlaces | None:
        """What errors make of places; ``None`` without any."""
        if self.errors is None:
            return None
        return MeasuredPlaces(self.errors, self.told_of, self.config.dt_s)

    def told_errors(
        self, signals: Mapping[str, FloatArray], memory: Mapping[str, AnyArray]
    ) -> Mapping[str, FloatArray]:
        """Errors of measured places at each step ``[T-1]`` of a rollout ``[T]`` [m]."""
        if self.measured is None:
            return {}
        acting = {name: values[:-1] for name, values in signals.items()}
        after = {name: values[1:] for name, values in memory.items()}
        errors_m = self.measured.errors_m(self.salient(acting), after)
        errors_m = np.where(self.present(acting)[..., None], errors_m, np.nan)
        return {
            f"{slot.name}, {direction}": errors_m[:, place, axis]
            for place, slot in enumerate(self.slots)
            for axis, direction in enumerate(("along the line of sight", "across it"))
        }

    def noise_begun(self, given: FloatArray) -> dict[str, AnyArray]:
        """What states remember of errors' noise at the start, for latents ``[N, S]``."""
        if self.measured is None:
            return {}
        return self.measured.begin(len(given), given[:, self.random_values :])

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

    @abstractmethod
    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The states s_0, arrays ``[count]``.

        Args:
            count: Number of rollouts N.
            start: Standard normals ``[N, S]``; ``None``: 0, the medians.
        """

    @abstractmethod
    def step(
        self, states: StateBatch, detected: BoolArray, noise: FloatArray | None = None
    ) -> StateBatch:
        """The next states, for outcomes ``[N, K]`` and, with errors, noise ``[N, 2 K]``."""

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """The slots' salient variables ``[..., K, 11]``."""
        gap_m, aside_m, _, heading_rad = self.of_each(signals)
        found = salient(self.config, seen(self.config, gap_m, aside_m), heading_rad)
        if self.has_ghost:
            own = ghost_salient(self.config, np.asarray(signals[GHOST_SIGNAL]))
            found = np.concatenate([found, own])
        return np.moveaxis(found, 0, -2)

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[..., K]``."""
        gap_m, aside_m, _, _ = self.of_each(signals)
        found = seen(self.config, gap_m, aside_m).present
        if self.has_ghost:
            own = may_appear(self.config, np.asarray(signals[GHOST_SIGNAL]), gap_m, aside_m)
            found = np.concatenate([found, own[None]])
        return np.moveaxis(found, 0, -1)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the ego might do otherwise for each outcome, at once or later, ``[..., K]``.

        Without a tracker: the car is in the path, and to keep a gap to it slows the ego down. With
        errors: it is not too far beside the path to be measured in it.
        """
        config = self.config
        gap_m, aside_m, speed_mps, heading_rad = self.of_told(signals)
        free = signals[COLLIDED] == 0.0
        if self.tracker is not None or self.errors is not None:
            known_s = 0.0
            if self.tracker is not None:
                known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * config.dt_s
            moves = np.append(changes_lane(config), [False] * self.has_ghost)
            wider_m = np.where(moves, FASTEST_ASIDE_MPS * known_s, 0.0)
            wider_m = wider_m + (0.0 if self.errors is None else FARTHEST_ASIDE_M)
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
        return scene_tracks(self.config, self.told_of, self.tracker, states)

    def of_each(
        self, signals: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Gaps, offsets, speeds and headings of the other cars, a row for each."""
        return _rows(self.cars, signals)

    def of_told(
        self, signals: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The same of all slots, ``[K, ...]`` each."""
        return _rows(self.told_of, signals)


def _rows(
    names: Sequence[str], signals: Mapping[str, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    gap_m, aside_m, speed_mps, heading_rad = (of_cars(what, names, signals) for what in OF_EACH)
    return gap_m, aside_m, speed_mps, heading_rad


GHOST_SIGNAL = f"{GAP}_{GHOST}"
NEVER_NEGATIVE = ("ego_speed", "revealed_speed", "deceleration")
"""Start values of which no distribution brings one below 0."""
FASTEST_ASIDE_MPS = 5.0
"""No car changes lanes faster."""
