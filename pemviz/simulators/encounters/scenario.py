"""What all back ends of the logical scenarios share: all but how they begin and step."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
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
from pemviz.simulators.encounters.cars import (
    START_PLANES,
    car_names,
    changes_lane,
)
from pemviz.simulators.encounters.drawing import encounter_cars, lanes, scene_states, scene_tracks
from pemviz.simulators.encounters.encounter_sight import EncounterSight
from pemviz.simulators.encounters.ghost import GhostReports
from pemviz.simulators.encounters.measured import FARTHEST_ASIDE_M, MeasuredPlaces, PlaneErrors
from pemviz.simulators.encounters.names import (
    ASIDE,
    COLLIDED,
    EGO_SPEED,
    GAP,
    GHOST,
    HEADING,
    SPEED,
    Each,
    encounter_signals,
    slot_signals,
    slot_title,
)
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import SeenStates, Slot
from pemviz.simulators.tracking.tracker import Tracker, tracker_of_text
from pemviz.types import Signal, StateBatch


@dataclass(frozen=True)
class LogicalScenario(ABC):
    """Encounters of a logical scenario; a back end adds ``name``, ``initial`` and ``step``.

    Attributes:
        config: The encounters' parameters.
        chosen: Start values with other distributions than the logical scenario's.
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
        return self.sight(signals).salient

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether each is to be seen, or the ghost may appear, ``[..., K]``."""
        return self.sight(signals).present

    def sight(self, signals: Mapping[str, FloatArray]) -> EncounterSight:
        """Both at once, for signals ``[...]``."""
        return self.sight_of(Each.of(self.cars, signals), signals)

    def sight_of(self, each: Each, signals: Mapping[str, FloatArray]) -> EncounterSight:
        """The same, of whose other cars the places are put together already."""
        ghost_gap_m = np.asarray(signals[GHOST_SIGNAL]) if self.has_ghost else None
        return EncounterSight(self.config, each, ghost_gap_m)

    def sight_at(self, states: StateBatch) -> EncounterSight:
        """The same, at states that may know it already."""
        known = states.sight if isinstance(states, SeenStates) else None
        return known if isinstance(known, EncounterSight) else self.sight(states.signals)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Whether the ego might do otherwise for each outcome, at once or later, ``[..., K]``.

        Without a tracker: the car is in the path, and to keep a gap to it slows the ego down. With
        errors: it is not too far beside the path to be measured in it.
        """
        each = [self.reacts_in(slot, signals) for slot in range(len(self.told_of))]
        return np.stack(each, axis=-1)

    def reacts_in(self, slot: int, signals: Mapping[str, FloatArray]) -> BoolArray:
        """The same of one slot, ``[...]``."""
        config, name = self.config, self.told_of[slot]
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
        moves = np.append(changes_lane(self.config), [False] * self.has_ghost)
        wider_m = np.where(moves, FASTEST_ASIDE_MPS * known_s, 0.0)
        return wider_m + (0.0 if self.errors is None else FARTHEST_ASIDE_M)

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


GHOST_SIGNAL = f"{GAP}_{GHOST}"
NEVER_NEGATIVE = ("ego_speed", "revealed_speed", "deceleration")
"""Start values of which no distribution brings one below 0."""
FASTEST_ASIDE_MPS = 5.0
"""No car changes lanes faster."""
