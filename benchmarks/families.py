"""How fast the families' back ends are, side by side in one run."""

import statistics
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.figures import Figure, median_ratio
from benchmarks.simulators import elapsed_s
from pemviz.config import FAMILIES, EncounterConfig
from pemviz.config.encounters import FamilyName
from pemviz.sampling.rollouts.draw import replay
from pemviz.simulators.families.highway import HighwayFamily
from pemviz.simulators.families.scenario import FamilyScenario
from pemviz.simulators.families.vectorized import VectorizedFamily
from pemviz.simulators.sumo.engine import is_installed
from pemviz.simulators.sumo.families import SumoFamily


def family_figures(
    *,
    vectorized_rollouts: int = 1000,
    highway_rollouts: int = 4,
    sumo_rollouts: int = 128,
    repeats: int = 5,
    states: int = 91,
    families: Sequence[FamilyName] = FAMILIES,
) -> Sequence[Figure]:
    """Replay random starts and outcomes on all back ends, family by family; SUMO if it is there.

    They take turns in every repeat; a ratio is formed within a repeat.

    Args:
        vectorized_rollouts: Size of the vectorized back end's batch.
        highway_rollouts: Rollouts of highway-env in a repeat.
        sumo_rollouts: Size of SUMO's batch.
        repeats: Repeats that medians are taken over, after one that is not counted.
        states: States in a rollout.
        families: Which ones.
    """
    found: list[Figure] = []
    for family in families:
        config = EncounterConfig(family=family, states=states)
        sizes = {"vectorized": vectorized_rollouts, "highway-env": highway_rollouts}
        kinds: list[FamilyScenario] = [VectorizedFamily(config), HighwayFamily(config)]
        if is_installed():
            kinds.append(SumoFamily(config))
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
                Figure(f"{family}, {name}", 1 / typical_s, "rollouts/s"),
                Figure(
                    f"{family}, {name}, all of its cars",
                    (states - 1) / typical_s,
                    "steps/s",
                ),
            ]
        found.append(
            Figure(
                f"{family}, vectorized, times faster than highway-env",
                median_ratio(each_s["highway-env"], each_s["vectorized"]),
            )
        )
    return tuple(found)


def _replaying(scenario: FamilyScenario, rollouts: int) -> Callable[[], object]:
    """Work that replays the same random starts and outcomes each time."""
    generator = np.random.default_rng(0)
    start = generator.standard_normal((rollouts, scenario.latents.start))
    detected = generator.random((rollouts, scenario.states - 1, len(scenario.slots))) < 0.5
    return lambda: replay(simulator=scenario, detected=detected, start=start)
