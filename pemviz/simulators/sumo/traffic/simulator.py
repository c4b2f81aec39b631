"""SUMO's traffic with a tracker and a controller in front of it: a simulator with slots.

Each episode is an environment that is reset and stepped in a process of SUMO's own.
"""

import array
import atexit
import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from pemviz.arrays import BoolArray, FloatArray
from pemviz.config import EncounterConfig, ScenarioConfig
from pemviz.config.settings import SumoConfig
from pemviz.errors import ConfigError, RunError
from pemviz.files.shipped import asset_path
from pemviz.latents import SEED_LATENTS, LatentCounts
from pemviz.quantiles import seed_of
from pemviz.simulators.braking.scenario import (
    CAR_CLASS,
    HEADING_AWAY_RAD,
    NOT_OCCLUDED,
    NOT_TRUNCATED,
)
from pemviz.simulators.encounters import ego
from pemviz.simulators.episodic import SideBySide
from pemviz.simulators.scene import Road, SceneCar, SceneStates, SceneTracks
from pemviz.simulators.slots import Slot
from pemviz.simulators.sumo.engine import check_installed
from pemviz.simulators.sumo.traffic import messages
from pemviz.simulators.sumo.traffic.messages import NAMES, NOBODY_M, OF_SLOT, OTHERS, SLOTS
from pemviz.simulators.tracked_cars import SlotSignals
from pemviz.simulators.tracking.tracker import Tracker, tracker_of_text
from pemviz.types import Signal, StateBatch

SHIPPED_TRAFFIC = "free-traffic"
PROCESSES = 16
"""So many rollouts at a time."""
SIDEWAYS_MPS = 2.0
"""Cars do not change lanes faster."""
PROCESS = "pemviz.simulators.sumo.traffic.process"
EGO_SIGNALS = {
    "distance": ("m", 0.0, 10_000.0),
    "ego_speed": ("m/s", 0.0, 60.0),
    "ego_acceleration": ("m/s^2", -15.0, 15.0),
    "clearance": ("m", -20.0, NOBODY_M),
    "safe_distance": ("m", -300.0, NOBODY_M),
    "needless_deceleration": ("m/s^2", 0.0, 20.0),
    "collided": ("", -1.0, 1.0),
    "wanted_speed": ("m/s", 0.0, 100.0),
}
CAR_SIGNALS = {
    "gap": ("m", -150.0, NOBODY_M),
    "aside": ("m", -100.0, 100.0),
    "speed": ("m/s", -60.0, 60.0),
    "heading": ("rad", -4.0, 4.0),
}
KEYS = {"m": "_m", "m/s": "_mps", "m/s^2": "_mps2", "rad": "_rad", "": ""}


def _signal(name: str) -> Signal:
    kind = name.partition("_")[0]
    is_of_car = name not in EGO_SIGNALS and kind in OF_SLOT
    unit, low, high = CAR_SIGNALS[kind] if is_of_car else EGO_SIGNALS[name]
    return Signal(name=name, key=f"{name}{KEYS[unit]}", unit=unit, low=low, high=high)


SIGNALS = tuple(_signal(name) for name in NAMES)
"""Those of the ego, then of the cars around it."""


HOSTS: dict[int, socket.socket] = {}
"""To the process that makes processes, by the process that has episodes."""


def _connected() -> messages.Pipe:
    """A pipe to a new process with libsumo."""
    host = HOSTS.get(os.getpid())
    if host is None:
        check_installed()
        host, theirs = socket.socketpair()
        package = str(Path(__file__).resolve().parents[4])
        paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
        with theirs:
            process = subprocess.Popen(  # noqa: S603  our own module
                [sys.executable, "-m", PROCESS, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            )
        HOSTS[os.getpid()] = host
        atexit.register(_ended, host, process)
    ours, theirs = socket.socketpair()
    with theirs:
        socket.send_fds(host, [b"1"], [theirs.fileno()])
    return messages.Pipe(ours)


def _ended(host: socket.socket, process: "subprocess.Popen[bytes]") -> None:
    """Have the process end, as it does once its socket is closed."""
    host.close()
    process.wait()


class TrafficEpisodes:
    """One episode at a time; a :class:`pemviz.EpisodicSimulator`, given the ego's accelerations."""

    name = "sumo"
    latents = SEED_LATENTS
    signals = SIGNALS

    def __init__(self, settings: messages.TrafficSettings, *, states: int) -> None:
        """Nothing is started yet; ``states`` are those of a rollout."""
        self.settings, self.states, self.dt_s = settings, states, settings.step_s
        self._pipe: messages.Pipe | None = None
        self._is_begun = False

    def begin_reset(self, *given: Any) -> None:
        """Have the next :meth:`reset` begin before it is called."""
        seed = seed_of(given[0][0])
        self._begin(messages.RESET + struct.pack("q", seed))

    def begin_step(self, *given: Any) -> None:
        """Have the next :meth:`step` begin before it is called."""
        self._begin(messages.STEP + struct.pack("d", float(given[0])))

    def reset(self, *given: Any) -> Mapping[str, float]:
        """Begin with SUMO's seed, for standard normals ``[1]``.

        Raises:
            RunError: SUMO fails, or the ego does not enter.
        """
        if not self._is_begun:
            self.begin_reset(*given)
        return self._answer()[0]

    def step(self, *given: Any) -> tuple[Mapping[str, float], bool]:
        """One step with the ego's acceleration [m/s^2].

        Raises:
            RunError: SUMO fails.
        """
        if not self._is_begun:
            self.begin_step(*given)
        return self._answer()

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Speed of the ego; what perception looks at is the simulator's that wraps this."""
        return signals["ego_speed"][..., None]

    def _begin(self, request: bytes) -> None:
        if self._pipe is None:
            self._pipe = _connected()
            self._pipe.send(json.dumps(asdict(self.settings)).encode())
        self._is_begun = True
        with contextlib.suppress(OSError):  # it is gone, which the answer tells
            self._pipe.send(request)

    def _answer(self) -> tuple[Mapping[str, float], bool]:
        assert self._pipe is not None  # noqa: S101  begun before
        self._is_begun = False
        try:
            answer = self._pipe.receive()
        except (EOFError, OSError):
            self._pipe.close()
            self._pipe = None
            answer = messages.WRONG + b"its process ended without a word"
        if answer[:1] == messages.WRONG:
            message = f"sumo.config {self.settings.config}: SUMO: {answer[1:].decode()}"
            raise RunError(message) from None
        values = array.array("d", answer[1:])
        return dict(zip(NAMES, values, strict=True)), answer[:1] == messages.ENDED


@dataclass(frozen=True)
class TrafficSimulator:
    """Processes of SUMO's behind one tracker; a :class:`pemviz.SlotSimulator`, episodic.

    Attributes:
        scenario: SUMO's processes, given the ego's accelerations.
        tracker_text: Between perception and controller.
        driving: How the ego drives, and its camera.
    """

    scenario: SideBySide
    tracker_text: str
    driving: EncounterConfig
    name: str = "sumo"
    signals: tuple[Signal, ...] = SIGNALS
    latents: LatentCounts = SEED_LATENTS
    distance_signal: str = "distance"
    slots: tuple[Slot, ...] = tuple(
        Slot(slot, signals=tuple(f"{what}_{slot}" for what in OF_SLOT)) for slot in SLOTS
    )

    @property
    def states(self) -> int:
        """In a rollout."""
        return self.scenario.states

    @property
    def dt_s(self) -> float:
        """Of a step [s]."""
        return self.driving.dt_s

    @cached_property
    def tracker(self) -> Tracker | None:
        """Of gaps and offsets."""
        return tracker_of_text(self.tracker_text, dt_s=self.dt_s, axes=2)

    def initial(self, *, count: int, start: FloatArray | None = None) -> StateBatch:
        """SUMO's own starts for seeds ``[count, 1]``; no tracks."""
        given = np.zeros((count, self.latents.at_start)) if start is None else start
        states = self.scenario.initial(count=count, start=given)
        none = ego.nothing_reported(self.tracker, SLOTS, count)
        return replace(states, memory={**states.memory, **none})

    def step(self, states: StateBatch, detected: BoolArray) -> StateBatch:
        """One step of SUMO, with the ego acting on what it tracks after outcomes ``[N, K]``."""
        signals = states.signals
        gap_m, aside_m, speed_mps, _ = (of.T for of in slot_signals(signals))
        there, ego_mps = self.present(signals).T, signals["ego_speed"]
        measured = ego.Reported(detected.T & there, gap_m, aside_m, ego_mps - speed_mps)
        memory = dict(states.memory)
        if self.tracker is not None:  # no track outlives its car
            none = self.tracker.memory(self.tracker.start(len(detected), slots=len(SLOTS)))
            for name, blank in none.items():
                slot = int(name.rpartition("_")[2])
                memory[name] = np.where(there[slot], memory[name], blank)
        reported, kept = ego.reported_after(self.tracker, SLOTS, memory, measured)
        acceleration = ego.acceleration(
            self.driving, reported, ego_mps=ego_mps, set_mps=signals["wanted_speed"]
        )
        after = self.scenario.step(states, acceleration)  # pyright: ignore[reportArgumentType]  told accelerations
        return replace(after, memory={**after.memory, **kept})

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Each car as KITTI would label it, all unoccluded, ``[..., K, 11]``."""
        gap_m, aside_m, _, heading_rad = slot_signals(signals)
        car = self.driving
        x_m, z_m = -aside_m, gap_m + car.camera_to_bumper_m + car.car_length_m / 2
        rotation_rad = HEADING_AWAY_RAD - heading_rad
        columns = (
            *(CAR_CLASS, NOT_TRUNCATED, NOT_OCCLUDED, rotation_rad - np.arctan2(x_m, z_m)),
            *(car.car_height_m, car.car_width_m, car.car_length_m),
            *(x_m, car.camera_height_m, z_m, rotation_rad),
        )
        return np.stack(np.broadcast_arrays(*columns), axis=-1)

    def present(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where a slot has a car, ``[..., K]``."""
        return slot_signals(signals)[0] < NOBODY_M

    def reacts(self, signals: Mapping[str, FloatArray]) -> BoolArray:
        """Where the ego might do otherwise for a detection, at once or later, ``[..., K]``."""
        gap_m, aside_m, speed_mps, _ = slot_signals(signals)
        ego_mps = signals["ego_speed"][..., None]
        closing_mps = ego_mps - speed_mps
        free = self.present(signals) & (signals["collided"][..., None] == 0.0)
        if self.tracker is None:
            follow = ego.follow_acceleration(self.driving, gap_m, closing_mps, ego_mps)
            slows = follow < self.driving.maximum_acceleration_mps2
            slows |= ego.is_urgent(self.driving, gap_m, closing_mps)
            return free & slows & ego.in_path(self.driving, gap_m, aside_m)
        known_s = (self.tracker.window - 1 + self.tracker.coast_steps) * self.dt_s
        return free & ego.is_beside(self.driving, aside_m, wider_m=SIDEWAYS_MPS * known_s)

    @staticmethod
    def of_slots(signals: Mapping[str, FloatArray]) -> SlotSignals:
        """Gaps, offsets to the left [m], speeds [m/s] and headings [rad], ``[..., K]``."""
        return slot_signals(signals)

    @property
    def scene_cars(self) -> tuple[SceneCar, ...]:
        """The ego, the cars in slots and those that perception is not about."""
        car = self.driving
        size = (car.car_length_m, car.car_width_m, car.car_height_m)
        seen = (SceneCar(slot, *size, slot=slot) for slot in SLOTS)
        return (SceneCar("ego", *size), *seen, *(SceneCar(other, *size) for other in OTHERS))

    @property
    def road(self) -> Road:
        """Three lanes, the ego's in the middle, whatever the network has."""
        return Road(tuple(self.driving.lane_width_m * place for place in (-1.5, -0.5, 0.5, 1.5)))

    def scene(self, signals: Mapping[str, FloatArray]) -> SceneStates:
        """Where the cars are, for signals ``[...]``; the ego keeps its lane."""
        ego_m, ego_mps = signals["distance"][..., None], signals["ego_speed"][..., None]
        none = np.zeros_like(ego_m)
        gap_m, aside_m, speed_mps = (
            np.stack([signals[f"{what}_{car}"] for car in (*SLOTS, *OTHERS)], axis=-1)
            for what in ("gap", "aside", "speed")
        )
        heading_rad = slot_signals(signals)[3]
        level = np.zeros((*ego_m.shape[:-1], len(OTHERS)))
        there = np.concatenate([none == 0.0, gap_m < NOBODY_M], axis=-1)
        return SceneStates(
            x_m=np.concatenate([ego_m, ego_m + gap_m + self.driving.car_length_m], axis=-1),
            y_m=np.concatenate([none, aside_m], axis=-1),
            heading_rad=np.concatenate([none, heading_rad, level], axis=-1),
            speed_mps=np.concatenate([ego_mps, speed_mps], axis=-1),
            present=there,
            collided=signals["collided"] > 0.0,
        )

    def scene_tracks(self, states: StateBatch) -> SceneTracks:
        """Where the ego believes the cars of slots to be, predicted to states ``[...]``."""
        ego_m = np.asarray(states.signals["distance"])[..., None]
        if self.tracker is None:
            none = np.zeros((*ego_m.shape[:-1], len(SLOTS)))
            return SceneTracks(none, none, none, none, none > 0.0)
        tracks = self.tracker.state(states.memory, slots=len(SLOTS))
        motion = self.tracker.filter.predicted(tracks.motion, dt_s=self.dt_s)
        sd_m = np.sqrt(motion.variances[..., 0])
        return SceneTracks(
            x_m=ego_m + self.driving.car_length_m + motion.position_m[..., 0],
            y_m=motion.position_m[..., 1],
            x_sd_m=sd_m,
            y_sd_m=sd_m,
            confirmed=tracks.confirmed,
        )


def slot_signals(signals: Mapping[str, FloatArray]) -> SlotSignals:
    """Gaps, offsets to the left [m], speeds [m/s] and headings [rad] of slots, ``[..., K]``."""
    gap_m, aside_m, speed_mps, heading_rad = (
        np.stack([signals[f"{what}_{slot}"] for slot in SLOTS], axis=-1) for what in OF_SLOT
    )
    return gap_m, aside_m, speed_mps, heading_rad


def build_traffic(sumo: SumoConfig, scenario: ScenarioConfig) -> TrafficSimulator:
    """The simulator of a ``.sumocfg``, which is loaded once to see that it can be.

    Raises:
        ConfigError: libsumo is not installed, or SUMO refuses the file, or has no such ego.
    """
    path = str(traffic_file(sumo))
    settings = messages.TrafficSettings(path, sumo.ego, sumo.warm_up_s, sumo.step_s)
    make = partial(TrafficEpisodes, settings, states=sumo.states)
    found = TrafficSimulator(
        SideBySide(make=make, count=PROCESSES),
        scenario.tracker,
        EncounterConfig(dt_s=sumo.step_s),
    )
    try:
        found.initial(count=1)
    except RunError as error:
        raise ConfigError(str(error)) from error
    return found


def traffic_file(sumo: SumoConfig) -> Path:
    """The ``.sumocfg`` that is meant.

    Raises:
        ConfigError: There is no such file.
    """
    if sumo.config == SHIPPED_TRAFFIC:
        return asset_path("sumo", f"{SHIPPED_TRAFFIC}.sumocfg")
    path = Path(sumo.config or "")
    if not path.is_file():
        message = f"sumo.config = {sumo.config!r}: must be {SHIPPED_TRAFFIC} or a .sumocfg file"
        raise ConfigError(message)
    return path.resolve()
