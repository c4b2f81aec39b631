"""The merge with a tracker and a controller in front of it: a simulator with slots.

highway-env is imported when an environment is made.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy.special import ndtr

from pemviz.arrays import BoolArray, FloatArray, IntArray
from pemviz.config import ScenarioConfig
from pemviz.latents import LatentCounts
from pemviz.simulators import merge
from pemviz.simulators.braking.scenario import CAR_HEIGHT_M, CAR_WIDTH_M, car_salient
from pemviz.simulators.episodic import SideBySide
from pemviz.simulators.scene import Ramp, Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot
from pemviz.simulators.tracked_cars import SlotSignals
from pemviz.simulators.tracking.tracker import (
    Tracker,
    TrackerState,
    scene_tracks,
    tracker_of_text,
)
from pemviz.types import Signal, StateBatch

if TYPE_CHECKING:
    from pemviz.simulators.merge.highway_env_merge import MergeEpisodes

ENVIRONMENTS = 20
SIGHT_M = 100.0
VIEW_SLOPE = np.tan(np.radians(60.0))
SIDEWAYS_MPS = 2.5
"""No car comes nearer by the side faster."""
ANTICIPATION_S = 1.0
STANDSTILL_M, BRAKE_S, KEEP_S = 10.0, 1.2, 1.6
SLOWER, IDLE, FASTER = 0, 1, 2
"""The environment's actions."""
LANE_EDGES_M = (-6.0, -2.0, 2.0)
"""The ego's lane and the left one."""
EGO_LANE_M, LANE_WIDTH_M = -4.0, 4.0
APPROACH_M, JOINED_M = -14.5, -8.0
"""y of the ramp's centre where it begins, and from where cars merge."""
BENDS_AT_M, MERGING_AT_M, RAMP_ENDS_AT_M = 150.0, 230.0, 310.0
BEND_PLACES = 17


def make_environment() -> "MergeEpisodes":
    """An environment of its own."""
    from pemviz.simulators.merge.highway_env_merge import MergeEpisodes  # noqa: PLC0415  pygame

    return MergeEpisodes()


@dataclass(frozen=True)
class MergeSimulator:
    """Environments side by side behind one tracker; a :class:`pemviz.SlotSimulator` with latents.

    Attributes:
        config: Gives the tracker and the camera's height; the rest is the braking scenario's.
        scenario: The environments, which are told the ego's action.
    """

    config: ScenarioConfig
    scenario: SideBySide = field(
        default_factory=lambda: SideBySide(make=make_environment, count=ENVIRONMENTS)
    )
    name: str = "merge"
    states: int = merge.STATES
    dt_s: float = merge.DT_S
    signals: tuple[Signal, ...] = field(default_factory=merge.merge_signals)
    slots: tuple[Slot, ...] = tuple(
        Slot(car, signals=tuple(f"{name}_{car}" for name in merge.OWN_SIGNALS))
        for car in merge.CARS
    )
    latents: LatentCounts = field(default_factory=lambda: LatentCounts(start=merge.LATENTS))

    @cached_property
    def tracker(self) -> Tracker:
        """Of places relative to the ego, ahead and to the left; without one chosen, of one step."""
        chosen = tracker_of_text(self.config.tracker, dt_s=self.dt_s, axes=2)
        return Tracker(dt_s=self.dt_s, hits=1, window=1, axes=2) if chosen is None else chosen

    @property
    def starts(self) -> tuple[Signal, ...]:
        """Gaps and speeds of the cars on the road."""
        return merge.merge_starts()

    @property
    def start_plane(self) -> tuple[str, str]:
        """Those of the car ahead in the ego's lane."""
        return "middle_gap", "middle_speed"

    def start_values(self, start: FloatArray) -> Mapping[str, FloatArray]:
        """Standard normals ``[N, 6]`` to gaps [m] and speeds [m/s] by name, ``[N]``."""
        shares = ndtr(np.asarray(start, dtype=np.float64)).T
        return {
            one.name: one.low + (one.high - one.low) * share
            for one, share in zip(self.starts, shares, strict=True)
        }

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """The environments' own starts for standard normals ``[count, 6]``; no tracks."""
        given = np.zeros((count, merge.LATENTS)) if start is None else start
        states = self.scenario.initial(count=count, start=given)
        return self._with(states, self.tracker.start(count, slots=len(merge.CARS)))

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """One environment step each, with the ego acting on what it tracks after ``[N, 4]``."""
        signals = states.signals
        hits = detected & self.present(signals)
        gap_m, aside_m, _, _ = self.of_slots(signals)
        before = self.tracker.state(states.memory, slots=len(merge.CARS))
        tracks = self.tracker.update(before, hits, np.stack([gap_m, aside_m], axis=-1))
        action = ego_action(
            tracks.confirmed, tracks.position_m, tracks.speed_mps, signals["ego_speed"]
        )
        return self._with(self.scenario.step(states, cast(Any, action)), tracks)

    def _with(self, states: StateBatch, tracks: TrackerState) -> StateBatch:
        return replace(states, memory={**states.memory, **self.tracker.memory(tracks)})

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Each car as KITTI would label it, all unoccluded, ``[..., 4, 11]``."""
        gap_m, aside_m, _, heading_rad = self.of_slots(signals)
        return car_salient(
            x_m=-aside_m,
            y_m=self.config.camera_height_m,
            z_m=gap_m + merge.CAR_LENGTH_M / 2,
            heading_rad=heading_rad,
            size_m=(CAR_HEIGHT_M, CAR_WIDTH_M, merge.CAR_LENGTH_M),
        )

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where a car is in the camera's view, ``[..., 4]``."""
        gap_m, aside_m, _, _ = self.of_slots(signals)
        seen_m = VIEW_SLOPE * (gap_m + merge.CAR_LENGTH_M / 2)
        return (gap_m > 0.0) & (gap_m < SIGHT_M) & (np.abs(aside_m) < seen_m)

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where a detection may matter, at once or while the tracker knows of it, ``[..., 4]``."""
        gap_m, aside_m, _, _ = self.of_slots(signals)
        known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * self.dt_s
        ego_mps = signals["ego_speed"][..., None]
        near = gap_m < STANDSTILL_M + (KEEP_S + known_s) * ego_mps
        beside = np.abs(aside_m) < merge.BESIDE_M + SIDEWAYS_MPS * (known_s + (known_s > 0.0))
        return self.present(signals) & near & beside & (signals["collided"][..., None] < 0.5)

    def of_slots(self, signals: Mapping[str, FloatArray]) -> SlotSignals:
        """Gaps, offsets to the left [m], speeds [m/s] and headings [rad], ``[..., 4]``."""
        gap_m, aside_m, speed_mps, heading_rad = (
            np.stack([signals[f"{name}_{car}"] for car in merge.CARS], axis=-1)
            for name in merge.OWN_SIGNALS
        )
        return gap_m, aside_m, speed_mps, heading_rad

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The ego and the other cars, all of highway-env's size."""
        size = (merge.CAR_LENGTH_M, merge.CAR_WIDTH_ROAD_M)
        return (SceneCar("ego", *size), *(SceneCar(car, *size, slot=car) for car in merge.CARS))

    @property
    def road(self) -> Road:
        """The road's two lanes, and the ramp."""
        return Road(LANE_EDGES_M, (ramp(),))

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Where the cars are, for signals ``[...]``; the ego keeps its lane."""
        gap_m, aside_m, speed_mps, heading_rad = self.of_slots(signals)
        ego_m, ego_mps = signals["ego_x"][..., None], signals["ego_speed"][..., None]
        none = np.zeros_like(ego_m)
        x_m = np.concatenate([ego_m, ego_m + gap_m + merge.CAR_LENGTH_M], axis=-1)
        return SceneStates(
            x_m=x_m,
            y_m=np.concatenate([none, aside_m], axis=-1) + EGO_LANE_M,
            heading_rad=np.concatenate([none, heading_rad], axis=-1),
            speed_mps=np.concatenate([ego_mps, speed_mps], axis=-1),
            present=np.ones(x_m.shape, dtype=np.bool_),
            collided=signals["collided"] > 0.0,
        )

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        """Where the ego believes the cars to be, predicted to states ``[...]``."""
        ego_m, length_m = states.signals["ego_x"], merge.CAR_LENGTH_M
        tracks = scene_tracks(
            self.tracker, states, slots=len(merge.CARS), ego_m=ego_m, length_m=length_m
        )
        return replace(tracks, y_m=tracks.y_m + EGO_LANE_M)


def ramp() -> Ramp:
    """merge-v0's: it comes nearer along half a period of a cosine, and ends beside the road."""
    shares = np.linspace(0.0, 1.0, BEND_PLACES)
    x_m = [0.0, *(BENDS_AT_M + (MERGING_AT_M - BENDS_AT_M) * shares), RAMP_ENDS_AT_M]
    bend_m = JOINED_M + (APPROACH_M - JOINED_M) * (1.0 + np.cos(np.pi * shares)) / 2.0
    centre_m = np.array([APPROACH_M, *bend_m, JOINED_M])
    right_m, left_m = centre_m - LANE_WIDTH_M / 2, centre_m + LANE_WIDTH_M / 2
    return Ramp(tuple(map(float, x_m)), tuple(right_m.tolist()), tuple(left_m.tolist()))


def ego_action(
    tracked: BoolArray, position_m: FloatArray, speed_mps: FloatArray, ego_speed_mps: FloatArray
) -> IntArray:
    """The environment's action ``[N]``, given whom it tracks ``[N, K]``.

    A track's position is its gap and its offset to the left, ``[N, K, 2]``.
    """
    gap_m, aside_m = position_m[..., 0], position_m[..., 1]
    later_m = aside_m + ANTICIPATION_S * speed_mps[..., 1]
    in_path = tracked & (np.minimum(np.abs(aside_m), np.abs(later_m)) < merge.BESIDE_M)
    ego_mps = ego_speed_mps[..., None]
    brakes = np.any(in_path & (gap_m < STANDSTILL_M + BRAKE_S * ego_mps), axis=-1)
    keeps = np.any(in_path & (gap_m < STANDSTILL_M + KEEP_S * ego_mps), axis=-1)
    return np.where(brakes, SLOWER, np.where(keeps, IDLE, FASTER))
