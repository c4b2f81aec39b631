"""highway-env's intersection-v0: a car turns left through three others that it may not perceive."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.special import expit

from benchmarks.external.quadrature import Known
from benchmarks.trust_systems import LinearLogit
from pemviz import FloatArray, GymnasiumSlotEpisodes, Signal, Slot

CARS, STEPS, COURSE, SEED = 3, 32, 0, 20261126
"""Others, steps of 0.2 s, the seed of the environment's course, and of what is sampled here."""
SLOWER, FASTER = 0, 2
AHEAD_S, TOO_NEAR_M, LEAST_SPEED_MPS = 3.0, 6.0, 4.5
CONFIG = {
    "initial_vehicle_count": 6, "spawn_probability": 0.0, "duration": 1e9,
    "simulation_frequency": 5, "policy_frequency": 5,
    "observation": {"type": "AttributesObservation", "attributes": ["time"]},
}  # fmt: skip
SLOTS = tuple(Slot(f"car {n}", signals=(f"away_{n}", f"closest_{n}")) for n in range(1, CARS + 1))
SIGNALS = (
    Signal(name="room", key="room_m", unit="m", low=-1.0, high=100.0),
    Signal(name="speed", key="speed_mps", unit="m/s", low=0.0, high=10.0),
    *(
        Signal(name=name, key=f"{name}_m", unit="m", low=0.0, high=100.0)
        for slot in SLOTS
        for name in slot.signals
    ),
)
DETECTOR = LinearLogit(at_zero=2.0, slope=-0.02)
"""The farther a car is, the more often it is missed."""


class PerceivingEgo(gym.Wrapper[Any, Any, Any, Any]):
    """Its action: which of the cars the ego perceives; it slows down for those it would meet.

    Observations are the signals: the distance to the nearest car, below 0 once the environment says
    that the ego has crashed, its speed, and of each car how far it is and will be at the closest,
    at today's velocities, within three seconds.
    """

    def reset(self, **options: Any) -> tuple[Mapping[str, float], dict[str, Any]]:
        """With the environment's own cars."""
        self.env.reset(**options)
        inner: Any = self.unwrapped
        self._ego = inner.vehicle
        self._cars = [car for car in inner.road.vehicles if car is not self._ego]
        return self._look(), {}

    def step(self, action: Any) -> tuple[Mapping[str, float], float, bool, bool, dict[str, Any]]:
        """0.2 s on."""
        brakes = np.any(in_the_way(self._look()) & (np.asarray(action) > 0))
        _, _, terminated, _, _ = self.env.step(SLOWER if brakes else FASTER)
        return self._look(), 0.0, bool(terminated), False, {}

    def _look(self) -> Mapping[str, float]:
        away = np.array([car.position - self._ego.position for car in self._cars])
        own = self._ego.direction * max(self._ego.speed, LEAST_SPEED_MPS)
        closing = np.array([car.velocity for car in self._cars]) - own
        squares = np.maximum((closing**2).sum(axis=1), 1e-9)
        when_s = np.clip(-(away * closing).sum(axis=1) / squares, 0.0, AHEAD_S)
        away_m = np.linalg.norm(away, axis=1)
        closest_m = np.linalg.norm(away + closing * when_s[:, None], axis=1)
        room_m = -1.0 if self._ego.crashed else away_m.min()
        values = np.stack([away_m, closest_m], axis=-1).ravel()
        names = (signal.name for signal in SIGNALS)
        return dict(zip(names, (room_m, self._ego.speed, *values), strict=True))


def in_the_way(signals: Mapping[str, Any]) -> Any:
    """The cars for which the ego slows down if it perceives them, ``[..., K]``."""
    return np.stack([signals[slot.signals[1]] for slot in SLOTS], axis=-1) < TOO_NEAR_M


def system() -> GymnasiumSlotEpisodes:
    """The environment for pemviz: reset and stepped; nothing of it need be saved."""
    environment = gym.make("highway_env:intersection-v0", config=CONFIG).unwrapped
    return GymnasiumSlotEpisodes(
        environment=PerceivingEgo(environment),
        signals=SIGNALS,
        slots=SLOTS,
        observe=dict,
        salient_of=distances,
        reacts_of=in_the_way,
        states=STEPS + 1,
        dt_s=0.2,
        seed=COURSE,
        fixed_randomness=True,
        name="intersection-v0",
    )


def distances(signals: Mapping[str, FloatArray]) -> FloatArray:
    """How far each car is, which is what detecting it depends on, ``[..., K, 1]``."""
    return np.stack([signals[slot.signals[0]] for slot in SLOTS], axis=-1)[..., None]


def plain(count: int = 500, seed: int = SEED) -> Known:
    """Plain rollouts, one after the other."""
    rng, cars, failing = np.random.default_rng(seed), system(), 0
    for _ in range(count):
        values = cars.reset()
        for _ in range(STEPS):
            shown = {name: np.float64(value) for name, value in values.items()}
            detected = rng.random(CARS) < expit(DETECTOR.logit(cars.salient(shown)))
            values, ended = cars.step(detected)
            if ended:
                break
        failing += values["room"] < 0.0
    return Known.counted(failing, count, "one after the other")
