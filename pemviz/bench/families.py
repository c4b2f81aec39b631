"""How fast the families' back ends are, side by side in one run."""

import statistics
from collections.abc import Callable, Sequence

import numpy as np

from pemviz.bench.figures import Figure, median_ratio
from pemviz.bench.simulators import elapsed_s
from pemviz.config import FAMILIES, EncounterConfig
from pemviz.config.encounters import FamilyName
from pemviz.sampling.rollouts.draw import replay
from pemviz.simulators.families.highway import HighwayFamily
from pemviz.simulators.families.scenario import FamilyScenario
from pemviz.simulators.families.vectorized import VectorizedFamily


def family_figures(
    *,
    vectorized_rollouts: int = 1000,
    highway_rollouts: int = 4,
    repeats: int = 5,
    states: int = 91,
    families: Sequence[FamilyName] = FAMILIES,
) -> Sequence[Figure]:
    """Replay random starts and outcomes on both back ends, family by family.

    The two take turns in every repeat; a ratio is formed within a repeat.

    Args:
        vectorized_rollouts: Size of the vectorized back end's batch.
        highway_rollouts: Rollouts of highway-env in a repeat.
        repeats: Repeats that medians are taken over, after one that is not counted.
        states: States in a rollout.
        families: Which ones.
    """
    found: list[Figure] = []
    for family in families:
        config = EncounterConfig(family=family, states=states)
        vectorized = _replaying(VectorizedFamily(config), vectorized_rollouts)
        highway = _replaying(HighwayFamily(config), highway_rollouts)
        turns = [(elapsed_s(vectorized), elapsed_s(highway)) for _ in range(repeats + 1)]
        fast_s, slow_s = zip(*turns[1:], strict=True)
        per_fast_s = [spent_s / vectorized_rollouts for spent_s in fast_s]
        per_slow_s = [spent_s / highway_rollouts for spent_s in slow_s]
        found += [
            Figure(f"{family}, vectorized", 1 / statistics.median(per_fast_s), "rollouts/s"),
            Figure(f"{family}, highway-env", 1 / statistics.median(per_slow_s), "rollouts/s"),
            Figure(
                f"{family}, vectorized, times faster than highway-env",
                median_ratio(per_slow_s, per_fast_s),
            ),
        ]
    return tuple(found)


def _replaying(scenario: FamilyScenario, rollouts: int) -> Callable[[], object]:
    """Work that replays the same random starts and outcomes each time."""
    generator = np.random.default_rng(0)
    start = generator.standard_normal((rollouts, scenario.latents.start))
    detected = generator.random((rollouts, scenario.states - 1, len(scenario.slots))) < 0.5
    return lambda: replay(simulator=scenario, detected=detected, start=start)
