"""Violations that a few short runs of chains find, for methods that are to know of all their kinds.

None of the runs has to be precise; they are independent of each other, and each searches all of the
model's probability.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pemviz.arrays import AnyArray, FloatArray
from pemviz.faults import of_no_rollouts
from pemviz.sampling.problem import Problem, score
from pemviz.sampling.subset.moves import RandomNumbers
from pemviz.sampling.subset.rejuvenation import violating
from pemviz.sampling.subset.run import SubsetSimulation, simulated_from
from pemviz.types import ScoredRollouts

RUNS, FEWEST_RUNS = 4, 2
"""Of chains, beside the one that finds their levels; where few rollouts are left."""
APART = 2
"""One in so many of the violations is kept: neighbours in a chain are nearly the same."""
SPAWN_KEY = 2**32 - 3
"""Of the child of a repetition's seed that chains are sampled by."""
KEPT = "explored."
FIGURES = "log_weight", "log_probability", "simulated", "independent"


@dataclass(frozen=True)
class Explored:
    """What the runs found.

    Attributes:
        scored: E violations; ``None``: there are none.
        log_weight: Of each, by what its run found in all, ``[E]`` [nats].
        log_probability: What each run found, without bias, ``[R]`` [nats]; -inf: nothing violated.
        simulated: Rollouts that it took.
        independent: As how large a share of the violations so many independent ones would tell as
            much: those of one ancestor are much alike.
        numbers: Of which the violations come; ``None`` where there are none.
    """

    scored: ScoredRollouts | None
    log_weight: FloatArray
    log_probability: FloatArray
    simulated: int
    independent: float = 1.0
    numbers: RandomNumbers | None = None

    @property
    def kept(self) -> dict[str, AnyArray]:
        """What a run that goes on takes up, by name."""
        own = {f"{KEPT}{name}": np.asarray(getattr(self, name)) for name in FIGURES}
        return own if self.numbers is None else own | self.numbers.kept(KEPT)

    @staticmethod
    def of_kept(problem: Problem, kept: Mapping[str, AnyArray]) -> "Explored | None":
        """What was kept, its violations simulated again; ``None`` if nothing was.

        Raises:
            SimulationError: As :func:`explore`.
        """
        if not all(f"{KEPT}{name}" in kept for name in FIGURES):
            return None
        log_weight, log_probability, simulated, independent = (
            kept[f"{KEPT}{name}"] for name in FIGURES
        )
        scored = numbers = None
        if log_weight.size:
            numbers = RandomNumbers.of_kept(kept, KEPT)
            with of_no_rollouts():  # of the stage that comes after
                rollouts, _ = simulated_from(problem, numbers)
            scored = score(problem, rollouts)
        return Explored(
            scored, log_weight, log_probability, int(simulated), float(independent), numbers
        )


def explore(
    problem: Problem, *, rollouts: int, seed: int, repetition: int, most: float = math.inf
) -> Explored:
    """Runs with ``rollouts`` a level, fewer where ``most`` rollouts are not enough for all.

    If they are not for two beside the one that finds levels, that one is cut off, and nothing is
    found.

    Raises:
        SimulationError: Something raises, is no finite number, or a batch takes too long.
    """
    seeds = np.random.SeedSequence(seed, spawn_key=(repetition, SPAWN_KEY)).spawn(RUNS + 1)
    first, *others = (np.random.default_rng(one) for one in seeds)
    each = most / (1 + FEWEST_RUNS)
    if each < rollouts:
        return Explored(None, np.empty(0), np.empty(0), 0)
    prepared, simulated = SubsetSimulation().prepare(
        problem, count=rollouts, generator=first, most=each
    )
    affordable = (most - simulated) / prepared.most_rollouts(rollouts)
    if prepared.is_cut_off or affordable < FEWEST_RUNS:
        return Explored(None, np.empty(0), np.empty(0), simulated)
    if affordable < RUNS:
        others = others[: int(affordable)]
    with of_no_rollouts():  # of the stage that comes after
        runs = prepared.carry_out(problem, count=rollouts, generators=others)
    simulated += sum(run.simulated for run in runs)
    log_probability = np.array([run.log_probability for run in runs])
    parts: list[ScoredRollouts] = []
    log_weight = [np.empty(0)]
    for run in runs:
        few = np.flatnonzero(run.scored.violated)[::APART]
        if few.size:
            parts.append(run.scored.take(few))
            log_weight.append(np.full(few.size, run.log_probability - math.log(few.size)))
    found = np.concatenate(log_weight)
    if not parts:
        return Explored(None, found, log_probability, simulated)
    families = sum(1.0 / run.common_ancestry for run in runs if run.scored.violated.any())
    scored, independent = ScoredRollouts.concatenate(parts), min(families / found.size, 1.0)
    numbers = violating(problem, scored.rollouts, first).numbers
    return Explored(scored, found, log_probability, simulated, independent, numbers)
