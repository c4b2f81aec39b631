"""How fast the scenario's back ends are, side by side in one run."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import FloatArray
from pemviz.config import ScenarioConfig
from pemviz.sampling.rollout import replay
from pemviz.simulators.highway import HighwaySimulator
from pemviz.simulators.vectorized import VectorizedSimulator
from pemviz.types import Simulator


@dataclass(frozen=True)
class BenchRow:
    """A line of a benchmark's table.

    Attributes:
        name: Short and stable, for other programs.
        what: What was measured, for people.
        figure: The median of the repeats, in ``unit``.
        unit: E.g. ``rollouts/s``; ``x`` for ratios.
    """

    name: str
    what: str
    figure: float
    unit: str


def bench_simulators(
    config: ScenarioConfig,
    *,
    vectorized_rollouts: int = 10_000,
    highway_rollouts: int = 20,
    repeats: int = 11,
) -> tuple[BenchRow, ...]:
    """Replay random outcomes on both back ends, and step two plain highway-env vehicles.

    The three take turns in every repeat, so that what else the machine does meets all of them;
    ratios are formed within a repeat.

    Args:
        config: The scenario.
        vectorized_rollouts: Size of the vectorized back end's batch.
        highway_rollouts: Rollouts of highway-env in a repeat.
        repeats: Repeats that medians are taken over, after one to warm up.

    Returns:
        Rollouts per second of each, and what is required of their ratios.
    """
    vectorized = _replaying(VectorizedSimulator(config), vectorized_rollouts)
    highway = _replaying(HighwaySimulator(config), highway_rollouts)
    works = (vectorized, highway, _bare_vehicles(config, highway_rollouts))
    counts = (vectorized_rollouts, highway_rollouts, highway_rollouts)
    cost_s = _interleaved_s(works, repeats) / np.array(counts)
    vectorized_s, highway_s, bare_s = cost_s.T
    batch = f"{vectorized_rollouts:,} rollouts of {config.states} states"
    return (
        _rate("vectorized", f"vectorized back end, outcomes given, {batch}", vectorized_s),
        _rate("highway-env", "highway-env back end, outcomes given", highway_s),
        _rate("bare-highway-env", "road.act() and road.step(), two plain vehicles", bare_s),
        _ratio("vectorized-gain", "vectorized against highway-env", highway_s / vectorized_s),
        _ratio("highway-env-cost", "highway-env back end against bare", highway_s / bare_s),
    )


def _replaying(simulator: Simulator, rollouts: int) -> Callable[[], object]:
    """Work that replays the same random outcomes each time."""
    detected = np.random.default_rng(0).random((rollouts, simulator.states - 1)) < 0.5
    return lambda: replay(simulator=simulator, detected=detected)


def _bare_vehicles(config: ScenarioConfig, rollouts: int) -> Callable[[], object]:
    """Work that only steps highway-env's own vehicles, as often as rollouts would."""
    from pemviz.simulators.highway_env_scenario import plain_road  # noqa: PLC0415  pygame

    def work() -> None:
        for _ in range(rollouts):
            road = plain_road(config)
            for _ in range(config.states - 1):
                road.act()
                road.step(config.dt_s)

    return work


def _interleaved_s(works: tuple[Callable[[], object], ...], repeats: int) -> FloatArray:
    """Wall times ``[repeats, works]`` [s]."""
    spent_s = np.empty((repeats + 1, len(works)))
    for repeat in range(repeats + 1):
        for index, work in enumerate(works):
            began = time.perf_counter()
            work()
            spent_s[repeat, index] = time.perf_counter() - began
    return spent_s[1:]


def _rate(name: str, what: str, cost_s: FloatArray) -> BenchRow:
    return BenchRow(name=name, what=what, figure=float(np.median(1 / cost_s)), unit="rollouts/s")


def _ratio(name: str, what: str, ratios: FloatArray) -> BenchRow:
    return BenchRow(name=name, what=what, figure=float(np.median(ratios)), unit="x")
