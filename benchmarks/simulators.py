"""How fast the scenario's back ends are, side by side in one run."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.figures import Figure, median_ratio
from pemviz.config import ScenarioConfig
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.braking.highway import HighwaySimulator
from pemviz.simulators.braking.vectorized import VectorizedSimulator
from pemviz.types import Simulator

if TYPE_CHECKING:
    from highway_env.road.road import Road


def simulator_figures(
    config: ScenarioConfig | None = None,
    *,
    vectorized_rollouts: int = 10_000,
    highway_rollouts: int = 20,
    repeats: int = 11,
) -> Sequence[Figure]:
    """Replay random outcomes on both back ends, and step two plain highway-env vehicles.

    The three take turns in every repeat, so that what else the machine does meets all of them;
    ratios are formed within a repeat.

    Args:
        config: The scenario; the paper's if ``None``.
        vectorized_rollouts: Size of the vectorized back end's batch.
        highway_rollouts: Rollouts of highway-env in a repeat.
        repeats: Repeats that medians are taken over, after one that is not counted.
    """
    config = ScenarioConfig() if config is None else config
    vectorized = replaying(VectorizedSimulator(config), vectorized_rollouts)
    highway = replaying(HighwaySimulator(config), highway_rollouts)
    bare = _bare_vehicles(config, highway_rollouts)
    turns = [[elapsed_s(work) for work in (vectorized, highway, bare)] for _ in range(repeats + 1)]
    batch_s, slow_s, bare_s = zip(*turns[1:], strict=True)
    vectorized_s = [spent_s / vectorized_rollouts for spent_s in batch_s]
    highway_s = [spent_s / highway_rollouts for spent_s in slow_s]
    plain_s = [spent_s / highway_rollouts for spent_s in bare_s]
    batch = f"vectorized, {vectorized_rollouts:,} rollouts of given outcomes"
    return (
        Figure(batch, 1e3 * statistics.median(batch_s), "ms"),
        Figure("vectorized", 1 / statistics.median(vectorized_s), "rollouts/s"),
        Figure("highway-env", 1 / statistics.median(highway_s), "rollouts/s"),
        Figure(
            "highway-env, bare road.act() and road.step()",
            1 / statistics.median(plain_s),
            "rollouts/s",
        ),
        Figure(
            "vectorized, times faster than highway-env",
            median_ratio(highway_s, vectorized_s),
            goal="at least 1000",
        ),
        Figure(
            "highway-env, times slower than bare",
            median_ratio(highway_s, plain_s),
            goal="at most 2",
        ),
    )


def replaying(simulator: Simulator, rollouts: int) -> Callable[[], object]:
    """Work that replays the same random outcomes each time."""
    detected = np.random.default_rng(0).random((rollouts, simulator.states - 1)) < 0.5
    return lambda: replay(simulator=simulator, detected=detected)


def plain_road(config: ScenarioConfig) -> "Road":
    """Two of highway-env's own vehicles at the scenario's start: the yardstick for our costs."""
    from highway_env.vehicle.kinematics import Vehicle  # noqa: PLC0415  starts pygame

    from pemviz.simulators.highway_env_cars import straight_road  # noqa: PLC0415

    road = straight_road(config)
    distance_m = config.initial_gap_m + Vehicle.LENGTH
    road.vehicles = [
        Vehicle(road, position=[x_m, 0.0], speed=config.initial_speed_mps)
        for x_m in (0.0, distance_m)
    ]
    return road


def _bare_vehicles(config: ScenarioConfig, rollouts: int) -> Callable[[], object]:
    """Work that only steps highway-env's own vehicles, as often as rollouts would."""

    def work() -> None:
        for _ in range(rollouts):
            road = plain_road(config)
            for _ in range(config.states - 1):
                road.act()
                road.step(config.dt_s)

    return work


def elapsed_s(work: Callable[[], object]) -> float:
    """How long some work takes [s]."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
