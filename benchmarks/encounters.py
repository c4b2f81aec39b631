"""How fast the logical scenarios' back ends are, side by side in one run."""

import statistics
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.figures import Figure, median_ratio
from benchmarks.simulators import elapsed_s
from pemviz.config import LOGICAL_SCENARIOS, EncounterConfig
from pemviz.config.encounters import LogicalScenarioName
from pemviz.sampling.rollouts.simulate import replay
from pemviz.simulators.encounters.highway import HighwayEncounters
from pemviz.simulators.encounters.vectorized import VectorizedEncounters
from pemviz.simulators.sumo.engine import is_installed
from pemviz.simulators.sumo.scenarios import SumoEncounters


def scenario_figures(
    *,
    vectorized_rollouts: int = 1000,
    highway_rollouts: int = 4,
    sumo_rollouts: int = 128,
    repeats: int = 5,
    states: int = 91,
    logical_scenarios: Sequence[LogicalScenarioName] = LOGICAL_SCENARIOS,
) -> Sequence[Figure]:
    """Replay random starts and outcomes on all back ends; SUMO if it is there.

    They take turns in every repeat; a ratio is formed within a repeat.

    Args:
        vectorized_rollouts: Size of the vectorized back end's batch.
        highway_rollouts: Rollouts of highway-env in a repeat.
        sumo_rollouts: Size of SUMO's batch.
        repeats: Repeats that medians are taken over, after one that is not counted.
        states: States in a rollout.
        logical_scenarios: Which ones.
    """
    found: list[Figure] = []
    for logical_scenario in logical_scenarios:
        config = EncounterConfig(logical_scenario=logical_scenario, states=states)
        sizes = {"vectorized": vectorized_rollouts, "highway-env": highway_rollouts}
        kinds: list[VectorizedEncounters] = [
            VectorizedEncounters(config),
            HighwayEncounters(config),
        ]
        if is_installed():
            kinds.append(SumoEncounters(config))
            sizes["sumo"] = sumo_rollouts
        works = [_replaying(one, sizes[one.name]) for one in kinds]
        turns = [[elapsed_s(work) for work in works] for _ in range(repeats + 1)]
        each_s = {
            one.name: [spent_s / sizes[one.name] for spent_s in column]
            for one, column in zip(kinds, zip(*turns[1:], strict=True), strict=True)
        }
        for name, per_rollout_s in each_s.items():
            typical_s = statistics.median(per_rollout_s)
            found += [
                Figure(f"{logical_scenario}, {name}", 1 / typical_s, "rollouts/s"),
                Figure(
                    f"{logical_scenario}, {name}, all of its cars",
                    (states - 1) / typical_s,
                    "steps/s",
                ),
            ]
        found.append(
            Figure(
                f"{logical_scenario}, vectorized, times faster than highway-env",
                median_ratio(each_s["highway-env"], each_s["vectorized"]),
            )
        )
    return tuple(found)


def _replaying(scenario: VectorizedEncounters, rollouts: int) -> Callable[[], object]:
    """Work that replays the same random starts and outcomes each time."""
    generator = np.random.default_rng(0)
    start = generator.standard_normal((rollouts, scenario.latents.start))
    detected = generator.random((rollouts, scenario.states - 1, len(scenario.slots))) < 0.5
    return lambda: replay(simulator=scenario, detected=detected, start=start)
