"""highway-env's ``merge-v0``, reset and stepped; this module imports highway-env, and pygame."""

from collections.abc import Mapping
from typing import Any

from highway_env.envs.merge_env import MergeEnv
from scipy.special import ndtr

from pemviz.arrays import FloatArray
from pemviz.latents import LatentCounts
from pemviz.simulators import merge

CONFIG = {
    "policy_frequency": 5,
    "simulation_frequency": 15,
    "action": {"type": "DiscreteMetaAction", "lateral": False, "target_speeds": range(0, 31, 5)},
    # highway-env's default observation is a table that nothing here looks at
    "observation": {"type": "AttributesObservation", "attributes": ["time"]},
}
REACTION_S, BRAKING_MPS2 = 0.4, 8.0
"""Of the safe distance."""
NOBODY_M = 100.0
"""Distance to a car in front where there is none."""
DRIVEN_INTO_M = -0.01
"""Clearance is no larger from the moment on when highway-env says that the ego has crashed."""


class FromNormals:
    """What merge-v0 samples at its start: given lanes, and all else from standard normals."""

    def __init__(self, normals: FloatArray) -> None:
        self.shares, self.lanes = iter(ndtr(normals).tolist()), iter(merge.LANES)

    def integers(self, count: int) -> int:
        """One of 0 to ``count`` - 1: a lane of the road, unless there is one choice alone."""
        return 0 if count == 1 else next(self.lanes)

    def uniform(self, low: float, high: float) -> float:
        """A value between ``low`` and ``high``, for the next of the normals."""
        return low + (high - low) * next(self.shares)


class MergeEpisodes:
    """One environment as a :class:`pemviz.EpisodicSimulator`, told the ego's actions."""

    name = "merge"
    states = merge.STATES
    dt_s = merge.DT_S
    signals = merge.merge_signals()
    latents = LatentCounts(start=merge.LATENTS)

    def __init__(self) -> None:
        self.environment = MergeEnv(config=CONFIG)

    def reset(self, *given: Any) -> Mapping[str, float]:
        """Begin with what merge-v0 samples, for standard normals ``[6]``."""
        draws: Any = FromNormals(given[0])
        self.environment.np_random = draws
        self.environment.reset()
        return self._signals(self._ego.speed)

    def step(self, *given: Any) -> tuple[Mapping[str, float], bool]:
        """One environment step with the ego's action."""
        before_mps = self._ego.speed
        _, _, terminated, truncated, _ = self.environment.step(given[0])
        return self._signals(before_mps), bool(terminated or truncated)

    def salient(self, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Speed of the ego; what perception looks at is the simulator's that wraps this."""
        return signals["ego_speed"][..., None]

    @property
    def _ego(self) -> Any:
        return self.environment.vehicle

    def _signals(self, before_mps: float) -> Mapping[str, float]:
        ego, *cars = vars(self.environment)["road"].vehicles
        x_m, y_m = ego.position.tolist()
        places = [car.position.tolist() for car in cars]
        ahead_m = [x - x_m for x, _ in places]
        aside_m = [y_m - y for _, y in places]  # highway-env's y grows to the right
        speeds = [float(car.speed) for car in cars]
        apart_m = [
            max(abs(along) - merge.CAR_LENGTH_M, abs(across) - merge.CAR_WIDTH_ROAD_M)
            for along, across in zip(ahead_m, aside_m, strict=True)
        ]
        clearance_m = min(*apart_m, DRIVEN_INTO_M) if ego.crashed else min(apart_m)
        facts = list(zip(ahead_m, aside_m, speeds, strict=True))
        path_m = [x for x, y, _ in facts if x > 0.0 and abs(y) < merge.BESIDE_M + 1.0]
        values = {
            "ego_x": x_m,
            "ego_speed": float(ego.speed),
            "ego_acceleration": (ego.speed - before_mps) / merge.DT_S,
            "clearance": clearance_m,
            "safety_margin": _safety_margin(float(ego.speed), facts),
            "path_gap": min([x - merge.CAR_LENGTH_M for x in path_m] + [NOBODY_M]),
            "collided": float(ego.crashed),
        }
        for car, (along_m, across_m, speed_mps) in zip(merge.CARS, facts, strict=True):
            values[f"gap_{car}"] = along_m - merge.CAR_LENGTH_M
            values[f"aside_{car}"] = across_m
            values[f"speed_{car}"] = speed_mps
        for car, vehicle in zip(merge.CARS, cars, strict=True):
            values[f"heading_{car}"] = -float(vehicle.heading)
        return values


def _safety_margin(ego_mps: float, cars: list[tuple[float, float, float]]) -> float:
    """Gap to the nearest car in front less the safe distance [m] (Maierhofer et al. 2020, R_G1).

    The safe distance is what the ego drives in its reaction time, and until it stands, less what
    the car in front drives until it stands, both braking equally. Of each car there is the distance
    of centres along the road, to the left, and its speed.
    """
    in_lane = [
        (along_m - merge.CAR_LENGTH_M, speed_mps)
        for along_m, across_m, speed_mps in cars
        if along_m > 0.0 and abs(across_m) < merge.CAR_WIDTH_ROAD_M
    ]
    gap_m, lead_mps = min(in_lane, default=(NOBODY_M, ego_mps))
    braking_m = (ego_mps**2 - lead_mps**2) / (2.0 * BRAKING_MPS2)
    return gap_m - max(ego_mps * REACTION_S + braking_m, 0.0)
